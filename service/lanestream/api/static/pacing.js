/** Chooses the size, the quality and the pace of the frames that are sent, by what they cost. */

const STEPS = [
  { width: 480, quality: 0.7 },
  { width: 640, quality: 0.75 },
  { width: 800, quality: 0.8 },
  { width: 960, quality: 0.8 },
  { width: 1280, quality: 0.85 },
];
const FIRST_STEP = 3;
const FASTEST_MS = 1000 / 30;
// The milliseconds of a frame that depend on its size (encoding, network, decoding): above the first number frames get
// smaller, below the second one larger.
const TOO_SLOW_MS = 60;
const FAST_MS = 22;
const REVIEW_MS = 1000;
// Frames get larger only after this many good reviews in a row, and after ten times as many if that failed before.
const GOOD_REVIEWS = 4;
const CAUTION = 10;

/** Starts in the middle and adapts once per second. */
export class Pacing {
  #step = FIRST_STEP;
  #good = 0;
  #needed = GOOD_REVIEWS;
  #hasGrown = false;
  /** @type {number[]} */
  #costs = [];
  #bytes = 0;
  #reviewed = 0;
  /** @type {import("./client/index.js").Limits | null} */
  limits = null;

  /** What the capture worker should do now. */
  get plan() {
    return { ...STEPS[this.#step], intervalMs: this.#intervalMs };
  }

  /**
   * Returns whether the service accepts a frame of this size. If not, the next ones are smaller.
   * @param {{blob: Blob, width: number, height: number}} frame
   * @param {number} now in milliseconds
   */
  accepts(frame, now) {
    if (this.limits === null || this.#step === 0) return true;
    if (frame.blob.size <= this.limits.max_bytes && frame.width * frame.height <= this.limits.max_pixels) return true;
    this.#needed = Infinity;
    this.#goTo(this.#step - 1, now);
    return false;
  }

  /**
   * Considers an answered frame. Returns whether the plan may have changed.
   * @param {{encode: number, network: number, decode: number}} stages in milliseconds
   * @param {{blob: Blob, width: number, height: number}} frame
   * @param {number} now in milliseconds
   */
  answered(stages, frame, now) {
    this.#costs.push(stages.encode + stages.network + stages.decode);
    this.#bytes = frame.blob.size;
    if (now - this.#reviewed < REVIEW_MS || this.#costs.length < 5) return false;
    const cost = this.#costs.sort((a, b) => a - b)[this.#costs.length >> 1];
    if (cost > TOO_SLOW_MS) {
      if (this.#hasGrown) this.#needed = CAUTION * GOOD_REVIEWS;
      this.#hasGrown = false;
      return this.#goTo(this.#step - 1, now);
    }
    this.#good = cost < FAST_MS ? this.#good + 1 : 0;
    if (this.#good >= this.#needed && this.#step + 1 < STEPS.length && frame.width >= STEPS[this.#step].width) {
      this.#hasGrown = true;
      return this.#goTo(this.#step + 1, now);
    }
    return this.#goTo(this.#step, now, this.#good);
  }

  get #intervalMs() {
    if (this.limits === null) return FASTEST_MS;
    return Math.max(FASTEST_MS, 1000 / this.limits.frames_per_s, (1000 * this.#bytes) / this.limits.bytes_per_s);
  }

  /**
   * Ends a review. Returns true: the size or the pace may have changed.
   * @param {number} step
   * @param {number} now
   * @param {number} good reviews in a row at this step
   */
  #goTo(step, now, good = 0) {
    this.#step = Math.max(0, step);
    this.#costs = [];
    this.#good = good;
    this.#reviewed = now;
    return true;
  }
}
