/** Records the drawn picture as a video and the answers as lines of JSON. */

const TYPES = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/mp4;codecs=avc1.42E01E", "video/webm"];
const FPS = 30;
const BITS_PER_S = 6_000_000;

/** @typedef {import("./session.js").LanePane} LanePane */

/**
 * @typedef {object} RecordedFile
 * @property {string} name
 * @property {Blob} blob
 */

class Recording {
  #recorder;
  #name;
  /** @type {Blob[]} */
  #chunks = [];
  /** @type {string[]} */
  #lines = [];

  /**
   * Starts at once.
   * @param {HTMLCanvasElement} canvas
   * @param {string} name of the files, without their endings
   */
  constructor(canvas, name) {
    this.#name = name;
    const mimeType = TYPES.find((type) => MediaRecorder.isTypeSupported(type));
    this.#recorder = new MediaRecorder(canvas.captureStream(FPS), { mimeType, videoBitsPerSecond: BITS_PER_S });
    this.#recorder.ondataavailable = ({ data }) => data.size > 0 && this.#chunks.push(data);
    this.#recorder.start(1000);
  }

  /** @param {import("./client/index.js").LanesMessage} answer */
  add(answer) {
    this.#lines.push(`${JSON.stringify(answer)}\n`);
  }

  /** @returns {Promise<RecordedFile[]>} the video and the answers */
  async stop() {
    const stopped = new Promise((resolve) => this.#recorder.addEventListener("stop", resolve, { once: true }));
    this.#recorder.stop();
    await stopped;
    for (const track of this.#recorder.stream.getTracks()) track.stop();
    const type = this.#recorder.mimeType;
    return [
      {
        name: `${this.#name}.${type.startsWith("video/mp4") ? "mp4" : "webm"}`,
        blob: new Blob(this.#chunks, { type }),
      },
      { name: `${this.#name}.jsonl`, blob: new Blob(this.#lines, { type: "application/jsonl" }) },
    ];
  }
}

/** The recordings of all panes, which start and stop together. */
export class Recordings {
  /** @type {Map<LanePane, Recording>} */
  #running = new Map();

  /** Whether this browser can record a canvas. */
  static get areSupported() {
    return "MediaRecorder" in window && TYPES.some((type) => MediaRecorder.isTypeSupported(type));
  }

  get areRunning() {
    return this.#running.size > 0;
  }

  /** @param {LanePane[]} panes */
  start(panes) {
    const name = nameNow();
    for (const pane of panes) {
      const suffix = panes.length > 1 ? `-${pane.ready?.detector}` : "";
      this.#running.set(pane, new Recording(pane.canvas, name + suffix));
    }
  }

  /**
   * Adds the answer that a pane shows.
   * @param {LanePane} pane
   */
  add(pane) {
    if (pane.answer) this.#running.get(pane)?.add(pane.answer);
  }

  /** @returns {Promise<RecordedFile[]>} the files of all panes */
  async stop() {
    const recordings = [...this.#running.values()];
    this.#running.clear();
    return (await Promise.all(recordings.map((recording) => recording.stop()))).flat();
  }
}

/**
 * Saves a file as a download.
 * @param {RecordedFile} file
 */
export function download(file) {
  const link = downloadLink(file);
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/**
 * Returns a link that saves a file, named with its size.
 * @param {RecordedFile} file
 */
export function downloadLink({ name, blob }) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.textContent = `${name} (${sizeText(blob.size)})`;
  return link;
}

/** Returns a name for files of this moment. */
export function nameNow() {
  const now = new Date(Date.now() - 60_000 * new Date().getTimezoneOffset());
  return `lanestream-${now.toISOString().slice(0, 19).replaceAll(":", "").replace("T", "-")}`;
}

/** @param {number} bytes */
function sizeText(bytes) {
  return bytes < 1e6 ? `${Math.max(1, Math.round(bytes / 1e3))} KB` : `${(bytes / 1e6).toFixed(1)} MB`;
}
