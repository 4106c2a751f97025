/** Problems that a visitor can meet, each in one clear line of what happened and what to do. */

export class Problem extends Error {
  /**
   * @param {string} message what happened
   * @param {string} hint what to do
   */
  constructor(message, hint) {
    super(message);
    this.hint = hint;
  }

  get line() {
    return this.hint === "" ? `${this.message}.` : `${this.message}. ${this.hint}.`;
  }
}

/** @type {Record<string, [string, string]>} */
const BY_CODE = {
  unauthorized: ["The service does not accept this key or token", "Enter a valid API key"],
  forbidden: [
    "The service does not accept this page's address",
    "Add it to LANESTREAM_ALLOWED_ORIGINS, or open the page under the service's own address",
  ],
  busy: ["The service is busy", "Close other streams, or try again in a moment"],
  draining: ["The service is about to stop", "The page goes on by itself once it is back"],
  not_ready: ["The service is still starting", "The page goes on by itself once it is ready"],
  evicted: ["Another page has taken over this session", "Start again to open a new one"],
  idle: ["The stream was idle for too long", "Start again to open a new one"],
  session_too_old: ["The session has reached its maximum age", "Start again to open a new one"],
  no_detector: ["The service has not loaded this detector", "Choose the other one"],
  too_fast: ["The service accepts fewer frames per second", "The page slows down"],
  connection_failed: ["The service can't be reached", "Check that it runs; the page tries again by itself"],
};

/** @type {Record<string, [string, string]>} by the name of the exception */
const CAMERA = {
  NotAllowedError: [
    "The browser may not use the camera",
    "Allow it in the browser's settings of this site, then try again",
  ],
  NotFoundError: ["No camera was found", "Connect one, or play a video file"],
  OverconstrainedError: ["No suitable camera was found", "Connect another one, or play a video file"],
  NotReadableError: ["The camera can't be read", "Close other programs that use it, then try again"],
  AbortError: ["The camera can't be read", "Connect it again, then try again"],
};
/** @type {Record<string, [string, string]>} */
const SCREEN = {
  NotAllowedError: ["No screen was shared", "Choose a screen, a window or a tab, and allow the browser to share it"],
  NotFoundError: ["This device has no screen to share", "Play a video file instead"],
  NotReadableError: ["This screen can't be read", "Choose another window or tab"],
  AbortError: ["This screen can't be read", "Choose another window or tab"],
};

/**
 * Returns the line that explains an error of the client library to a visitor.
 * @param {{code: string, message: string, hint?: string}} error
 */
export function explain(error) {
  const known = BY_CODE[error.code];
  if (known) return new Problem(...known).line;
  return new Problem(sentence(error.message), sentence(error.hint ?? "")).line;
}

/**
 * Returns the problem behind an exception of getUserMedia or getDisplayMedia.
 * @param {unknown} error
 * @param {"camera" | "screen"} kind
 */
export function captureProblem(error, kind) {
  const name = error instanceof DOMException ? error.name : "";
  const problems = { camera: CAMERA, screen: SCREEN }[kind];
  if (name in problems) return new Problem(...problems[name]);
  const reason = error instanceof Error ? error.message : String(error);
  return new Problem(`The ${kind} can't be used: ${reason}`, "Play a video file instead");
}

/** Returns the problem of a page that may not use cameras because its connection is not secure. */
export function insecureProblem() {
  return new Problem(
    "Browsers allow cameras and screens on https:// and localhost only",
    "Open the page under one of these, or play a video file",
  );
}

/**
 * Returns the problem of a video that can't be played.
 * @param {MediaError | null} error
 * @param {string} name
 */
export function videoProblem(error, name) {
  if (error?.code === 2) return new Problem(`${name} could not be loaded`, "Check the connection, then try again");
  return new Problem(
    `This browser can't play ${name}`,
    "Convert it to H.264 in MP4 or to VP9 in WebM, for example with ffmpeg",
  );
}

/** @param {string} text */
function sentence(text) {
  return text === "" ? "" : (text[0].toUpperCase() + text.slice(1)).replace(/\.$/, "");
}
