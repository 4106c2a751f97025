/** The streams of one source: one per detector, each drawn on its own canvas. */

import { drawFrame, drawHorizon } from "./drawing.js";
import { FrameStore } from "./frames.js";
import { stagesOf } from "./latency.js";
import { Pacing } from "./pacing.js";

/**
 * @typedef {import("./capture.js").CapturedFrame} CapturedFrame
 * @typedef {import("./client/index.js").LaneClient} LaneClient
 * @typedef {import("./client/index.js").LaneError} LaneError
 * @typedef {import("./client/index.js").LanesMessage} LanesMessage
 * @typedef {import("./client/index.js").StateChange} StateChange
 * @typedef {import("./client/index.js").StreamOptions} StreamOptions
 * @typedef {import("./latency.js").Stages} Stages
 *
 * @typedef {object} Return what became of a session whose connection was lost
 * @property {boolean} resumed whether it goes on
 * @property {number} seconds from the loss to the first answer
 * @property {number[]} kept the track ids that are still there
 *
 * @typedef {object} SessionListener
 * @property {(pane: LanePane, stages: Stages, drawn: number) => void} onDrawn
 * @property {(pane: LanePane) => void} onState
 * @property {(pane: LanePane, back: Return) => void} onReturn
 * @property {(pane: LanePane, error: LaneError) => void} onError
 * @property {(hasRoom: boolean) => void} onRoom
 * @property {() => void} onPlan
 */

// One frame that the service processes, and one that comes when it is done. More would only make the answers older.
const MOST_UNANSWERED = 2;
// The share of the newest frame in the expected times.
const NEWEST = 0.2;

/** One stream and its canvas. */
export class LanePane {
  canvas = document.createElement("canvas");
  /** @type {import("./client/index.js").StreamState} */
  state = "connecting";
  /** How often the stream has tried to connect again, and why. */
  attempt = 0;
  reason = "";
  /** @type {boolean | null} whether the session goes on that had lost its connection; null if it never did */
  resumed = null;
  /** @type {CapturedFrame | null} the frame that is shown */
  frame = null;
  /** @type {LanesMessage | null} its lanes */
  answer = null;
  /** @type {number | null} a horizon to draw, as a fraction of the height */
  horizon = null;
  #context;
  #stream;
  #frames;
  #listener;
  /** @type {Map<number, number>} when frames were sent that are not answered yet */
  #sent = new Map();
  /** @type {Map<number, number>} the timestamps at which boundaries were last detected, by track id */
  #detected = new Map();
  /** @type {{ids: number[], at: number} | null} what was tracked when the connection was lost, and when that was */
  #lost = null;
  #isRestarting = false;
  #shownWidth = 1280;
  // How much longer the service usually takes for a frame than the page for the next one.
  #pauseMs = 0;

  /**
   * @param {LaneClient} client
   * @param {StreamOptions} options
   * @param {FrameStore} frames
   * @param {SessionListener} listener
   */
  constructor(client, options, frames, listener) {
    this.#frames = frames;
    this.#listener = listener;
    this.#context = /** @type {CanvasRenderingContext2D} */ (this.canvas.getContext("2d", { alpha: false }));
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute(
      "aria-label",
      `The picture with its lanes${options.detector ? `, detector ${options.detector}` : ""}`,
    );
    // Asking for the width at every frame would have the browser lay out the page each time.
    new ResizeObserver(([{ contentRect }]) => (this.#shownWidth = contentRect.width)).observe(this.canvas);
    this.#stream = client.stream({ ...options, mode: "latest" });
    this.#stream.on("lanes", (answer) => this.#answered(answer));
    this.#stream.on("error", (error) => listener.onError(this, error));
    this.#stream.on("state", (change) => this.#changed(change));
  }

  /** @returns {import("./client/index.js").ReadyMessage | null} */
  get ready() {
    return this.#stream.ready;
  }

  /** Whether a frame that is captured now would arrive when the service has answered the one before it. */
  get hasRoom() {
    if (this.state !== "open" || this.#sent.size >= MOST_UNANSWERED) return false;
    const [latest = -Infinity] = this.#sent.values();
    return now() - latest >= this.#pauseMs;
  }

  /** @param {CapturedFrame} frame */
  send(frame) {
    this.#sent.set(frame.seq, now());
    if (this.#pauseMs > 0) setTimeout(() => this.#listener.onRoom(this.hasRoom), this.#pauseMs);
    const settled = () => {
      this.#sent.delete(frame.seq);
      this.#listener.onRoom(this.hasRoom);
    };
    // Whether it was answered, dropped, refused or lost.
    this.#stream.send(frame.blob, { seq: frame.seq, timestamp: frame.timestamp }).then(settled, settled);
  }

  /** @param {StreamOptions} options */
  restart(options) {
    this.#isRestarting = true;
    this.#stream.restart(options);
  }

  breakConnection() {
    this.#stream.breakConnection();
  }

  close() {
    this.#stream.close();
  }

  /** Draws the frame that is shown again. */
  redraw() {
    if (this.frame === null) return;
    drawFrame(this.#context, this.frame.picture, this.answer, this.unseen, this.#shownWidth);
    if (this.horizon !== null) drawHorizon(this.#context, this.horizon);
  }

  /**
   * Returns the seconds since a boundary was last detected.
   * @param {LanesMessage["lanes"][number]} lane
   */
  unseen = (lane) => {
    const at = this.answer?.timestamp ?? 0;
    return at - (this.#detected.get(lane.track_id) ?? at);
  };

  /** @param {LanesMessage} answer */
  #answered(answer) {
    const answered = now();
    const sent = this.#sent.get(answer.seq);
    const frame = this.#frames.get(answer.seq);
    if (frame === undefined || sent === undefined) return;
    this.frame = frame;
    this.answer = answer;
    this.#remember(answer);
    if (this.canvas.width !== frame.picture.width || this.canvas.height !== frame.picture.height) {
      this.canvas.width = frame.picture.width;
      this.canvas.height = frame.picture.height;
    }
    this.redraw();
    const drawn = now();
    const stages = stagesOf(frame, sent, answered, drawn, answer.timing_ms);
    const pauseMs = answered - sent - stages.queue - stages.encode;
    this.#pauseMs += NEWEST * (pauseMs - this.#pauseMs);
    this.#publish(answer, frame, stages);
    this.#listener.onDrawn(this, stages, drawn);
    if (this.#lost === null) return;
    const kept = answer.lanes
      .map((lane) => lane.track_id)
      .filter((id) => this.#lost?.ids.includes(id))
      .sort((a, b) => a - b);
    const back = { resumed: this.resumed === true, seconds: (answered - this.#lost.at) / 1000, kept };
    this.#lost = null;
    this.#listener.onReturn(this, back);
  }

  /** @param {StateChange} change */
  #changed({ state, resumed, reason }) {
    this.state = state;
    this.reason = reason;
    this.attempt += 1;
    if (state === "reconnecting") {
      if (!this.#isRestarting) this.#lost ??= { ids: this.answer?.lanes.map((lane) => lane.track_id) ?? [], at: now() };
    }
    if (state === "open") {
      if (this.#lost !== null) this.resumed = resumed;
      this.attempt = 0;
      this.#isRestarting = false;
    }
    this.#listener.onState(this);
  }

  /** @param {LanesMessage} answer */
  #remember(answer) {
    const ids = new Set(answer.lanes.map((lane) => lane.track_id));
    for (const id of this.#detected.keys()) if (!ids.has(id)) this.#detected.delete(id);
    for (const lane of answer.lanes)
      if (lane.state !== "predicted") this.#detected.set(lane.track_id, answer.timestamp);
  }

  /**
   * Says in attributes what is shown, for tests and for whoever looks.
   * @param {LanesMessage} answer
   * @param {CapturedFrame} frame
   * @param {Stages} stages
   */
  #publish(answer, frame, stages) {
    Object.assign(this.canvas.dataset, {
      seq: answer.seq,
      frame: frame.seq,
      latency: stages.total.toFixed(1),
      timestamp: answer.timestamp,
      ids: answer.lanes.map((lane) => lane.track_id).join(" "),
      ego: `${answer.ego.left ?? ""} ${answer.ego.right ?? ""}`.trim(),
      detector: this.ready?.detector ?? "",
      sent: `${frame.width}x${frame.height}`,
    });
  }
}

/** All streams of one source. They get the same frames. */
export class LiveSession {
  panes;
  pacing = new Pacing();
  #frames = new FrameStore();
  #listener;

  /**
   * @param {LaneClient} client
   * @param {StreamOptions[]} options of each stream
   * @param {SessionListener} listener
   */
  constructor(client, options, listener) {
    this.#listener = listener;
    /** @type {SessionListener} */
    const forPanes = {
      ...listener,
      onDrawn: (pane, stages, drawn) => this.#drawn(pane, stages, drawn),
      onState: (pane) => {
        if (pane.ready !== null) this.pacing.limits = pane.ready.limits;
        listener.onState(pane);
        listener.onRoom(this.hasRoom);
      },
      onRoom: () => listener.onRoom(this.hasRoom),
    };
    this.panes = options.map((each) => new LanePane(client, each, this.#frames, forPanes));
  }

  get hasRoom() {
    return this.panes.every((pane) => pane.hasRoom);
  }

  /** @param {CapturedFrame} frame */
  send(frame) {
    if (!this.panes.every((pane) => pane.state === "open")) {
      frame.picture.close();
      return;
    }
    if (!this.pacing.accepts(frame, now())) {
      frame.picture.close();
      this.#listener.onPlan();
      return;
    }
    this.#frames.add(frame);
    for (const pane of this.panes) pane.send(frame);
    this.#listener.onRoom(this.hasRoom);
  }

  /** @param {StreamOptions[]} options of each stream */
  restart(options) {
    this.panes.forEach((pane, index) => pane.restart(options[index]));
  }

  breakConnection() {
    for (const pane of this.panes) pane.breakConnection();
  }

  close() {
    for (const pane of this.panes) pane.close();
    this.#frames.clear();
  }

  /**
   * @param {LanePane} pane
   * @param {Stages} stages
   * @param {number} drawn
   */
  #drawn(pane, stages, drawn) {
    this.#frames.releaseBefore(Math.min(...this.panes.map(({ frame }) => frame?.seq ?? -1)));
    const frame = /** @type {CapturedFrame} */ (pane.frame);
    if (pane === this.panes[0] && this.pacing.answered(stages, frame, drawn)) this.#listener.onPlan();
    this.#listener.onDrawn(pane, stages, drawn);
  }
}

/** Returns milliseconds since 1970, on the clock of the capture worker. */
function now() {
  return performance.timeOrigin + performance.now();
}
