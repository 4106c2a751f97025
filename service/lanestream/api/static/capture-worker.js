/**
 * Turns frames into JPEG images in a worker, and paces them with its own timer: in hidden pages, browsers slow timers.
 *
 * Messages in: `track` (read this stream of VideoFrames), `pull` (ask the page for frames), `frame` (the page's reply),
 * `plan` (size, quality and pace), `room` (whether the service can take another frame) and `pause`.
 * Messages out: `tick` (the page should reply with a frame if it has a new one), `image` (an encoded frame), `ended`
 * (the track has no more frames) and `failed`.
 */

// Pictures on the page are at most this wide, however wide the source is.
const MOST_VIEW_WIDTH = 1280;
const TICK_MS = 8;

/** A canvas that is drawn on again and again. */
class Surface {
  #canvas = new OffscreenCanvas(1, 1);
  #context;

  /** @param {boolean} isRead whether its pixels are encoded, and not shown */
  constructor(isRead) {
    const context = this.#canvas.getContext("2d", { alpha: false, willReadFrequently: isRead });
    if (context === null) throw new Error("no canvas in a worker");
    this.#context = context;
  }

  get canvas() {
    return this.#canvas;
  }

  /**
   * @param {CanvasImageSource} picture
   * @param {number} width
   * @param {number} height
   */
  draw(picture, width, height) {
    if (this.#canvas.width !== width || this.#canvas.height !== height) {
      this.#canvas.width = width;
      this.#canvas.height = height;
    }
    this.#context.imageSmoothingQuality = "medium";
    this.#context.drawImage(picture, 0, 0, width, height);
  }
}

class FrameEncoder {
  #plan = { width: 960, quality: 0.8, intervalMs: 33 };
  #hasRoom = false;
  #isPaused = false;
  #isBusy = false;
  #lastCaptured = -Infinity;
  #seq = 0;
  #view = new Surface(false);
  #sent = new Surface(true);
  /** @type {{source: VideoFrame, captured: number} | null} the newest frame of a track, which replaces older ones */
  #waiting = null;

  /** @param {MessageEvent["data"]} message */
  receive(message) {
    if (message.type === "track") void this.#readTrack(message.readable);
    if (message.type === "pull") setInterval(() => this.#isReady() && self.postMessage({ type: "tick" }), TICK_MS);
    if (message.type === "frame") void this.#encode(message.source, message.captured, message.timestamp);
    if (message.type === "plan") this.#plan = message.plan;
    if (message.type === "pause") this.#isPaused = message.isPaused;
    if (message.type === "room") this.#hasRoom = message.hasRoom;
    this.#takeWaiting();
  }

  #isReady() {
    // Half a tick of slack, so that a camera at the very pace of the plan does not lose every other frame.
    const isDue = now() - this.#lastCaptured >= this.#plan.intervalMs - TICK_MS / 2;
    return this.#hasRoom && !this.#isPaused && !this.#isBusy && isDue;
  }

  /** @param {ReadableStream<VideoFrame>} readable */
  async #readTrack(readable) {
    const reader = readable.getReader();
    for (let next = await reader.read(); !next.done; next = await reader.read()) {
      this.#waiting?.source.close();
      this.#waiting = { source: next.value, captured: now() };
      this.#takeWaiting();
    }
    self.postMessage({ type: "ended" });
  }

  #takeWaiting() {
    if (this.#waiting === null || !this.#isReady()) return;
    const { source, captured } = this.#waiting;
    this.#waiting = null;
    void this.#encode(source, captured, source.timestamp / 1e6);
  }

  /**
   * @param {VideoFrame | ImageBitmap} source
   * @param {number} captured milliseconds since 1970
   * @param {number} timestamp seconds on the source's clock
   */
  async #encode(source, captured, timestamp) {
    if (this.#isBusy) {
      source.close();
      return;
    }
    this.#isBusy = true;
    const started = now();
    this.#lastCaptured = captured;
    try {
      const [width, height] =
        "displayWidth" in source ? [source.displayWidth, source.displayHeight] : [source.width, source.height];
      const viewSize = fitted(width, height, MOST_VIEW_WIDTH);
      const sentSize = fitted(width, height, this.#plan.width);
      this.#view.draw(source, ...viewSize);
      source.close();
      const isSameSize = sentSize[0] === viewSize[0];
      if (!isSameSize) this.#sent.draw(this.#view.canvas, ...sentSize);
      const { canvas } = isSameSize ? this.#view : this.#sent;
      const blob = await canvas.convertToBlob({ type: "image/jpeg", quality: this.#plan.quality });
      const picture = this.#view.canvas.transferToImageBitmap();
      const frame = {
        seq: this.#seq,
        timestamp,
        captured,
        started,
        encoded: now(),
        picture,
        blob,
        width: sentSize[0],
        height: sentSize[1],
      };
      this.#seq += 1;
      self.postMessage({ type: "image", frame }, { transfer: [picture] });
    } catch (error) {
      self.postMessage({ type: "failed", message: String(error) });
    } finally {
      this.#isBusy = false;
    }
    this.#takeWaiting();
  }
}

/** Returns milliseconds since 1970, on a clock that the page shares. */
function now() {
  return performance.timeOrigin + performance.now();
}

/**
 * Returns a size of the same shape that is at most `most` wide and as high as wide.
 * @param {number} width
 * @param {number} height
 * @param {number} most
 * @returns {[number, number]}
 */
function fitted(width, height, most) {
  const factor = Math.min(1, most / Math.max(width, height));
  return [Math.max(1, Math.round(width * factor)), Math.max(1, Math.round(height * factor))];
}

const encoder = new FrameEncoder();
self.onmessage = (event) => encoder.receive(event.data);
