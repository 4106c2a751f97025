import type { ErrorMessage } from "./messages.js";

/** What a LaneError may hold beside its code, its message and its hint. */
export interface ErrorDetails {
  seq?: number | null;
  fatal?: boolean;
  httpStatus?: number | null;
  requestId?: string | null;
}

/**
 * Every error of this library. `code` is for programs; docs/protocol.md lists those of the service. `message` says what
 * was wrong, `hint` what is accepted or what to do. An error with a `seq` is about that frame only; a `fatal` one ended
 * the stream. `requestId` is what the log of the service calls a refused request.
 */
export class LaneError extends Error {
  readonly code: string;
  readonly hint: string;
  readonly seq: number | null;
  readonly fatal: boolean;
  readonly httpStatus: number | null;
  readonly requestId: string | null;

  constructor(code: string, message: string, hint = "", details: ErrorDetails = {}) {
    super(message);
    this.name = "LaneError";
    this.code = code;
    this.hint = hint;
    this.seq = details.seq ?? null;
    this.fatal = details.fatal ?? false;
    this.httpStatus = details.httpStatus ?? null;
    this.requestId = details.requestId ?? null;
  }

  static fromMessage(message: ErrorMessage): LaneError {
    return new LaneError(message.code, message.message, message.hint, message);
  }

  /** Returns `error` if it is a LaneError, else one that names it. */
  static from(error: unknown): LaneError {
    return error instanceof LaneError ? error : new LaneError("internal", String(error));
  }

  /** Returns this error as the one that ended the stream. */
  asFatal(): LaneError {
    const details = { seq: this.seq, fatal: true, httpStatus: this.httpStatus, requestId: this.requestId };
    return new LaneError(this.code, this.message, this.hint, details);
  }
}

/** Another attempt would meet these errors again. Any other may be gone at another replica, or later. */
const FINAL: ReadonlySet<string> = new Set([
  "bad_image",
  "bad_message",
  "bad_settings",
  "closed",
  "evicted",
  "forbidden",
  "image_too_large",
  "no_detector",
  "overrun",
  "session_too_old",
  "too_fast",
  "unauthorized",
  "worker_lost",
]);

/** Returns whether another attempt may succeed after `error`. */
export function isRetryable(error: LaneError): boolean {
  return !FINAL.has(error.code);
}

/** Returns the error for a request that took longer than `seconds`. */
export function timeoutError(what: string, seconds: number): LaneError {
  const problem = `${what} took longer than ${Math.round(10 * seconds) / 10} s`;
  return new LaneError("connection_failed", problem, "check the network and the service");
}

/** Returns a signal that is aborted after `seconds`. */
export function timeoutSignal(seconds: number): AbortSignal {
  // Node accepts only whole milliseconds.
  return AbortSignal.timeout(Math.ceil(1000 * seconds));
}
