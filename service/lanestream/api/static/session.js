/** The streams of one source: one per detector, each drawn on its own canvas. */

import { drawFrame, drawHorizon } from "./drawing.js";
import { FrameStore } from "./frames.js";
import { stagesOf } from "./latency.js";
import { Pacing } from "./pacing.js";

/**
 * @typedef {import("./capture.js").CapturedFrame} CapturedFrame
 * @typedef {import("./client/index.js").LaneClient} LaneClient
 * @typedef {import("./client/index.js").LaneStream} LaneStream
 * @typedef {import("./client/index.js").LaneError} LaneError
 * @typedef {import("./client/index.js").LanesMessage} LanesMessage
 * @typedef {import("./client/index.js").ReadyMessage} ReadyMessage
 * @typedef {import("./latency.js").Stages} Stages
 *
 * @typedef {object} SessionListener
 * @property {(pane: LanePane, answer: LanesMessage, stages: Stages, frame: CapturedFrame) => void} onDrawn
 * @property {(pane: LanePane) => void} onState
 * @property {(pane: LanePane, back: {resumed: boolean, seconds: number, kept: number[], lost: number[]}) => void} onBack
 *   the first answer after a lost connection has come
 * @property {(pane: LanePane, error: LaneError) => void} onError
 * @property {() => void} onRoom the session may have room for another frame, or has none any more
 */

// One frame that the service processes, and one on its way. More would only make the answers older.
const MOST_UNANSWERED = 2;

/** One stream and its canvas. */
export class LanePane {
  canvas = document.createElement("canvas");
  /** The stream's state: connecting, open, reconnecting, closed. */
  state = "connecting";
  /** How often the present reconnection was tried. */
  attempt = 0;
  /** Whether the session before a lost connection goes on; null if none was lost. */
  /** @type {boolean | null} */
  resumed = null;
  /** @type {LanesMessage | null} */
  answer = null;
  /** @type {CapturedFrame | null} */
  frame = null;
  #context;
  #stream;
  #frames;
  #listener;
  #sentAt = new Map();
  #lastSent = -1;
  #lastSettled = -1;
  /** @type {Map<number, number>} when each boundary was last detected */
  #seen = new Map();
  /** @type {{ids: number[], at: number} | null} what was tracked when the connection was lost */
  #before = null;
  #isRestarting = false;
  /** @type {number | null} */
  horizon = null;

  /**
   * @param {LaneClient} client
   * @param {string | null} detector
   * @param {object} options of `start`
   * @param {FrameStore} frames
   * @param {SessionListener} listener
   */
  constructor(client, detector, options, frames, listener) {
    this.detector = detector;
    this.#frames = frames;
    this.#listener = listener;
    this.#context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d", { alpha: false }));
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "The picture with its lanes");
    this.#stream = client.stream({ mode: "latest", ...options });
    this.#stream.on("ready", (ready) => this.#ready(ready));
    this.#stream.on("lanes", (answer) => this.#answered(answer));
    this.#stream.on("error", (error) => this.#failed(error));
    this.#stream.on("state", (change) => this.#changed(change));
  }
}
