import { isRetryable, type LaneError } from "./errors.js";

const FIRST_PAUSE_S = 0.1;
const MOST_PAUSE_S = 2;
const FIRST_ATTEMPT_S = 2;
const LEAST_ATTEMPT_S = 0.1;

/**
 * Decides which of `count` replicas a stream tries next, when, and when it gives up.
 *
 * A stream gives up after `totalS` without a connection. If that is 0, it only tries each replica once at first. One round tries every replica once. The
 * first round starts immediately; before each later one there is a pause, doubled each round, which a random part
 * shortens so that the clients of a lost replica do not all come back at the same moment. An attempt may take twice as
 * long in each round, because a replica that is gone may not even refuse the connection.
 */
export class FailoverPolicy {
  /** The number of the replica that is connected, or that will be tried next. */
  index = 0;

  readonly #count: number;
  readonly #totalS: number;
  readonly #timeoutS: number;
  readonly #clock: () => number;
  readonly #random: () => number;
  #attempts = 0; // since the last progress
  #pastOutagesS = 0; // time without a connection since the last progress, the present outage excluded
  #outageStarted: number | null;
  #wasConnected = false;

  constructor(
    count: number,
    totalS: number,
    timeoutS: number,
    clock: () => number = () => performance.now() / 1000,
    random: () => number = Math.random,
  ) {
    this.#count = count;
    this.#totalS = totalS;
    this.#timeoutS = timeoutS;
    this.#clock = clock;
    this.#random = random;
    this.#outageStarted = clock();
  }

  /** How long the next attempt may take, in seconds. */
  get attemptS(): number {
    if (this.#totalS === 0) {
      return this.#timeoutS / this.#count;
    }
    const round = Math.floor(this.#attempts / this.#count);
    return Math.min(this.#timeoutS, FIRST_ATTEMPT_S * 2 ** round, Math.max(this.#remainingS(), LEAST_ATTEMPT_S));
  }

  /** Records that a replica has opened the stream. */
  connected(): void {
    if (this.#outageStarted !== null) {
      this.#pastOutagesS += this.#clock() - this.#outageStarted;
      this.#outageStarted = null;
    }
    if (!this.#wasConnected) {
      this.progressed();
    }
    this.#wasConnected = true;
  }

  /**
   * Records that a frame was answered, and resets the time and the attempts that retries may use. Connecting alone does
   * not reset them: the connection may be lost again for the same reason.
   */
  progressed(): void {
    this.#attempts = 0;
    this.#pastOutagesS = 0;
  }

  /**
   * Returns the seconds to wait before the next attempt after `error`, or null if the stream should give up. `draining`
   * says whether the replica had announced that it is about to stop.
   */
  pauseAfter(error: LaneError, draining: boolean): number | null {
    if (!isRetryable(error)) {
      return null;
    }
    if (error.code === "idle") {
      this.progressed();
    }
    if (this.#outageStarted !== null || draining) {
      this.index = (this.index + 1) % this.#count;
    }
    this.#outageStarted ??= this.#clock();
    const round = Math.floor(this.#attempts / this.#count);
    const pause = this.#attempts % this.#count ? 0 : this.#pauseS(round);
    this.#attempts += 1;
    if (this.#totalS === 0) {
      return !this.#wasConnected && this.#attempts < this.#count ? 0 : null;
    }
    return pause < this.#remainingS() ? pause : null;
  }

  #pauseS(round: number): number {
    if (round === 0) {
      return 0;
    }
    return Math.min(MOST_PAUSE_S, FIRST_PAUSE_S * 2 ** (round - 1)) * (0.5 + 0.5 * this.#random());
  }

  #remainingS(): number {
    const outageS = this.#outageStarted === null ? 0 : this.#clock() - this.#outageStarted;
    return this.#totalS - this.#pastOutagesS - outageS;
  }
}
