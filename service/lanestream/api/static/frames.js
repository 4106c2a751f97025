/** Keeps sent frames until they are answered, so that lanes are drawn on their own frame and on no other. */

/** @typedef {import("./capture.js").CapturedFrame} CapturedFrame */

// Far more than can be on their way; the oldest are given up.
const MOST_FRAMES = 16;

export class FrameStore {
  /** @type {Map<number, CapturedFrame>} in the order of their numbers */
  #frames = new Map();

  /** @param {CapturedFrame} frame */
  add(frame) {
    this.#frames.set(frame.seq, frame);
    for (const seq of this.#frames.keys()) {
      if (this.#frames.size <= MOST_FRAMES) break;
      this.#remove(seq);
    }
  }

  /**
   * Returns the frame with this number, or undefined if it is not kept any more.
   * @param {number} seq
   */
  get(seq) {
    return this.#frames.get(seq);
  }

  /**
   * Forgets the frames before `seq`.
   * @param {number} seq
   */
  releaseBefore(seq) {
    for (const earlier of this.#frames.keys()) {
      if (earlier >= seq) break;
      this.#remove(earlier);
    }
  }

  clear() {
    this.releaseBefore(Infinity);
  }

  /** @param {number} seq */
  #remove(seq) {
    this.#frames.get(seq)?.picture.close();
    this.#frames.delete(seq);
  }
}
