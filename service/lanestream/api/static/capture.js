/** Frames of a video file, a camera or a screen, encoded in a worker. */

import { Problem, captureProblem, insecureProblem, videoProblem } from "./problems.js";

/**
 * @typedef {object} CapturedFrame
 * @property {number} seq
 * @property {number} timestamp seconds on the source's clock
 * @property {number} captured milliseconds since 1970, like the two that follow
 * @property {number} started when the worker began to encode it
 * @property {number} encoded
 * @property {ImageBitmap} picture what is shown
 * @property {Blob} blob what is sent, a JPEG image
 * @property {number} width of what is sent
 * @property {number} height
 *
 * @typedef {"demo" | "camera" | "file" | "screen"} SourceKind
 * @typedef {object} Listener
 * @property {(frame: CapturedFrame) => void} onFrame
 * @property {(problem: Problem | null) => void} onEnd the source has ended, with a problem or without
 */

// A video that presents no frame for this long is looked at by the worker's timer, for example in a hidden page.
const SILENCE_MS = 150;
// A video whose time falls by more than this has started again.
const LEAST_JUMP_S = 0.5;

/** A running source. */
export class Capture {
  #worker;
  #listener;
  /** @type {HTMLVideoElement | null} */
  #video = null;
  /** @type {MediaStream | null} */
  #stream = null;
  #objectUrl = "";
  // Times of a video that starts again go on.
  #offset = 0;
  #lastTime = -1;
  #presented = { at: -Infinity, time: 0, isNew: false };
  // Whether the worker waits for a frame that the video has yet to present.
  #isAsked = false;
  #isPaused = false;
  #isOver = false;

  /**
   * @param {SourceKind} kind
   * @param {Listener} listener
   */
  constructor(kind, listener) {
    this.kind = kind;
    this.#listener = listener;
    this.#worker = new Worker(new URL("capture-worker.js", import.meta.url), { type: "module" });
    this.#worker.onmessage = ({ data }) => this.#receive(data);
    this.#worker.onerror = () =>
      this.#end(
        new Problem("Frames can't be encoded in this browser", "Use a current Chrome, Edge, Firefox or Safari"),
      );
  }

  /**
   * Opens the source. Raises Problem if it can't be used.
   * @param {string | File | null} video its address or file, for `demo` and `file`
   */
  async open(video = null) {
    try {
      if (video !== null) await this.#openVideo(video);
      else await this.#openStream(this.kind === "screen" ? "screen" : "camera");
    } catch (error) {
      this.close();
      throw error;
    }
  }

  /** @param {{width: number, quality: number, intervalMs: number}} plan */
  set plan(plan) {
    this.#worker.postMessage({ type: "plan", plan });
  }

  /** @param {boolean} hasRoom whether the service can take another frame */
  set hasRoom(hasRoom) {
    this.#worker.postMessage({ type: "room", hasRoom });
  }

  /** @param {boolean} isPaused whether no frames are wanted now; a video file stands still meanwhile */
  set paused(isPaused) {
    if (isPaused === this.#isPaused) return;
    this.#isPaused = isPaused;
    this.#worker.postMessage({ type: "pause", isPaused });
    if (this.#video === null || this.#stream !== null) return;
    if (isPaused) this.#video.pause();
    else void play(this.#video);
  }

  close() {
    this.#isOver = true;
    this.#worker.terminate();
    for (const track of this.#stream?.getTracks() ?? []) track.stop();
    if (this.#video !== null) {
      this.#video.pause();
      this.#video.removeAttribute("src");
      this.#video.srcObject = null;
      this.#video.load();
    }
    if (this.#objectUrl !== "") URL.revokeObjectURL(this.#objectUrl);
  }

  /** @param {Problem | null} problem */
  #end(problem) {
    if (this.#isOver) return;
    this.close();
    this.#listener.onEnd(problem);
  }

  /** @param {any} message */
  #receive(message) {
    if (this.#isOver) return;
    if (message.type === "image") this.#listener.onFrame(message.frame);
    if (message.type === "tick") void this.#reply();
    if (message.type === "ended") this.#end(null);
    if (message.type === "failed")
      this.#end(new Problem(`A frame can't be encoded: ${message.message}`, "Try a smaller video"));
  }

  /** @param {string | File} source */
  async #openVideo(source) {
    const name = typeof source === "string" ? "the demo clip" : source.name;
    if (source instanceof File) this.#objectUrl = URL.createObjectURL(source);
    const video = quietVideo();
    video.loop = true;
    video.src = source instanceof File ? this.#objectUrl : source;
    this.#video = video;
    await new Promise((resolve, reject) => {
      video.addEventListener("loadeddata", resolve, { once: true });
      video.addEventListener("error", () => reject(videoProblem(video.error, name)), { once: true });
    });
    if (video.videoWidth === 0) throw videoProblem(null, name);
    video.addEventListener("error", () => this.#end(videoProblem(video.error, name)));
    await this.#play(video);
  }

  /** @param {"camera" | "screen"} kind */
  async #openStream(kind) {
    if (!window.isSecureContext || !navigator.mediaDevices) throw insecureProblem();
    try {
      this.#stream =
        kind === "camera"
          ? await navigator.mediaDevices.getUserMedia({
              video: {
                facingMode: "environment",
                width: { ideal: 1280 },
                height: { ideal: 720 },
                frameRate: { ideal: 30 },
              },
            })
          : await navigator.mediaDevices.getDisplayMedia({ video: { frameRate: { ideal: 30 } } });
    } catch (error) {
      throw captureProblem(error, kind);
    }
    const [track] = this.#stream.getVideoTracks();
    track.addEventListener("ended", () =>
      this.#end(
        kind === "screen" ? null : new Problem("The camera was disconnected", "Connect it, then start it again"),
      ),
    );
    const Processor = /** @type {any} */ (window).MediaStreamTrackProcessor;
    if (Processor) {
      const { readable } = new Processor({ track, maxBufferSize: 2 });
      this.#worker.postMessage({ type: "track", readable }, [readable]);
      return;
    }
    const video = quietVideo();
    video.srcObject = this.#stream;
    this.#video = video;
    await this.#play(video);
  }

  /** @param {HTMLVideoElement} video */
  async #play(video) {
    if ("requestVideoFrameCallback" in video) this.#watch(video);
    await play(video);
    this.#worker.postMessage({ type: "pull" });
  }

  /** @param {HTMLVideoElement} video */
  #watch(video) {
    video.requestVideoFrameCallback((at, { mediaTime }) => {
      if (this.#isOver) return;
      this.#presented = { at, time: mediaTime, isNew: true };
      this.#watch(video);
      if (this.#isAsked) void this.#reply();
    });
  }

  /** Replies to the worker with the frame that the video shows, if it has not been taken yet. */
  async #reply() {
    const video = /** @type {HTMLVideoElement} */ (this.#video);
    const isWatched = performance.now() - this.#presented.at < SILENCE_MS;
    const isNew = isWatched ? this.#presented.isNew : video.currentTime !== this.#lastTime;
    this.#isAsked = !isNew;
    if (this.#isAsked) return;
    this.#presented.isNew = false;
    const captured = performance.timeOrigin + (isWatched ? this.#presented.at : performance.now());
    const source = await pictureOf(video);
    if (source === null) {
      this.#isAsked = true;
      return;
    }
    const about = isWatched ? this.#presented.time : video.currentTime;
    // Its own time is the exact one. Firefox 153 reports it in whole seconds, not in microseconds.
    const hasTime = "timestamp" in source && Math.abs(source.timestamp - about) > 1;
    const time = hasTime ? source.timestamp / 1e6 : about;
    const hasStartedAgain = time < this.#lastTime - LEAST_JUMP_S;
    if (time <= this.#lastTime && !hasStartedAgain) {
      source.close();
      this.#isAsked = true;
      return;
    }
    if (hasStartedAgain) this.#offset += Number.isFinite(video.duration) ? video.duration : this.#lastTime;
    this.#lastTime = time;
    this.#worker.postMessage({ type: "frame", source, captured, timestamp: time + this.#offset }, [source]);
  }
}

/**
 * Returns what a video shows; null if it shows nothing at the moment, for example while it starts again.
 * @param {HTMLVideoElement} video
 */
async function pictureOf(video) {
  try {
    // A VideoFrame refers to the decoded picture, copies nothing and knows its time. It needs a secure context.
    return "VideoFrame" in window ? new VideoFrame(video) : await createImageBitmap(video);
  } catch (error) {
    if (error instanceof DOMException && error.name === "InvalidStateError") return null;
    throw error;
  }
}

/** @param {HTMLVideoElement} video */
async function play(video) {
  try {
    await video.play();
  } catch (error) {
    // A pause or the end that came while it was about to start.
    if (!(error instanceof DOMException && error.name === "AbortError")) throw error;
  }
}

function quietVideo() {
  const video = document.createElement("video");
  video.muted = true;
  video.playsInline = true;
  return video;
}
