/** Shows where the time of a frame goes, from its capture to its drawing. */

/** @typedef {import("./client/index.js").LanesMessage} LanesMessage */
/** @typedef {import("./capture.js").CapturedFrame} CapturedFrame */

/** @type {[name: string, label: string, place: "page" | "network" | "service"][]} */
const STAGES = [
  ["capture", "Capture", "page"],
  ["encode", "Encode", "page"],
  ["network", "Network", "network"],
  ["queue", "Queue", "service"],
  ["decode", "Decode", "service"],
  ["propose", "Propose", "service"],
  ["infer", "Infer", "service"],
  ["fit", "Fit", "service"],
  ["track", "Track", "service"],
  ["draw", "Draw", "page"],
];
const WINDOW = 90;
const RATE_MS = 2000;
const REFRESH_MS = 250;

/**
 * Returns the milliseconds of each stage; together they are the time from capture to drawing. `network` is both ways.
 * @param {CapturedFrame} frame
 * @param {number} sent when the page gave it to the client, like the other times in milliseconds since 1970
 * @param {number} answered
 * @param {number} drawn
 * @param {LanesMessage["timing_ms"]} timing
 */
export function stagesOf(frame, sent, answered, drawn, timing) {
  return {
    capture: frame.started - frame.captured,
    encode: sent - frame.started,
    network: Math.max(0, answered - sent - timing.total),
    queue: timing.queue,
    decode: timing.decode,
    propose: timing.propose,
    infer: timing.infer,
    fit: timing.fit,
    track: timing.track,
    draw: drawn - answered,
    total: drawn - frame.captured,
  };
}

/** @typedef {ReturnType<typeof stagesOf>} Stages */

/**
 * Returns the value below which a share of the values lies.
 * @param {number[]} values
 * @param {number} share
 */
export function quantile(values, share) {
  const sorted = values.toSorted((a, b) => a - b);
  return sorted.length === 0 ? NaN : sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

export class LatencyView {
  #root;
  #cells;
  /** @type {Stages[]} */
  #frames = [];
  /** @type {number[]} */
  #drawnAt = [];
  #dropped = 0;
  #refreshed = 0;

  /** @param {ParentNode} root */
  constructor(root) {
    this.#root = root;
    const body = /** @type {HTMLTableSectionElement} */ (root.querySelector("#waterfall tbody"));
    this.#cells = new Map(STAGES.map(([name, label, place]) => [name, stageRow(body, label, place)]));
  }

  /**
   * Adds a drawn frame.
   * @param {Stages} stages
   * @param {number} drawn
   * @param {number} dropped frames that were not answered so far
   * @returns {boolean} whether the numbers were shown anew
   */
  add(stages, drawn, dropped) {
    this.#frames.push(stages);
    if (this.#frames.length > WINDOW) this.#frames.shift();
    this.#drawnAt.push(drawn);
    this.#dropped = dropped;
    if (drawn - this.#refreshed < REFRESH_MS) return false;
    this.#refreshed = drawn;
    this.#show();
    return true;
  }

  /** What the numbers on the page are: frames per second, and milliseconds from capture to drawing. */
  get summary() {
    const newest = this.#drawnAt.at(-1) ?? 0;
    while (this.#drawnAt.length > 2 && newest - this.#drawnAt[0] > RATE_MS) this.#drawnAt.shift();
    const span = newest - this.#drawnAt[0];
    const totals = this.#frames.map((frame) => frame.total);
    return {
      fps: span > 0 ? (1000 * (this.#drawnAt.length - 1)) / span : NaN,
      median: quantile(totals, 0.5),
      p95: quantile(totals, 0.95),
      dropped: this.#dropped,
    };
  }

  reset() {
    this.#frames = [];
    this.#drawnAt = [];
  }

  #show() {
    const { fps, median, p95, dropped } = this.summary;
    for (const [id, text] of [
      ["rate-fps", Number.isNaN(fps) ? "–" : fps.toFixed(0)],
      ["rate-median", median.toFixed(0)],
      ["rate-p95", p95.toFixed(0)],
      ["rate-dropped", String(dropped)],
    ]) {
      const element = this.#root.querySelector(`#${id}`);
      if (element) element.textContent = text;
    }
    const medians = STAGES.map(([name]) =>
      quantile(
        this.#frames.map((frame) => frame[/** @type {keyof Stages} */ (name)]),
        0.5,
      ),
    );
    const whole = Math.max(
      1,
      medians.reduce((sum, value) => sum + value, 0),
    );
    let start = 0;
    STAGES.forEach(([name], index) => {
      const cell = this.#cells.get(name);
      if (!cell) return;
      cell.bar.style.insetInlineStart = `${(100 * start) / whole}%`;
      cell.bar.style.inlineSize = `${(100 * medians[index]) / whole}%`;
      cell.value.textContent = medians[index].toFixed(1);
      start += medians[index];
    });
  }
}

/**
 * @param {HTMLTableSectionElement} body
 * @param {string} label
 * @param {string} place
 */
function stageRow(body, label, place) {
  const row = body.insertRow();
  const header = document.createElement("th");
  header.scope = "row";
  header.textContent = label;
  const bar = document.createElement("i");
  bar.dataset.place = place;
  const value = document.createElement("td");
  value.textContent = "–";
  row.append(header);
  row.insertCell().append(bar);
  row.append(value);
  return { bar, value };
}
