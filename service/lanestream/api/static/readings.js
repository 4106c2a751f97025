/** The numbers and the table beside the picture: the vehicle in its lane, and the tracked boundaries. */

import { lineName, positionColor, positionName } from "./lane-styles.js";

/** @typedef {import("./client/index.js").LanesMessage} LanesMessage */

// A weaker curvature, in 1/m, counts as straight.
const STRAIGHT = 1 / 3000;
// The bar shows this many lane widths; 95 % of a normal distribution lie within this many sigmas.
const BAR_LANES = 1.28;
const SIGMAS = 1.96;
// Numbers that change more often can't be read.
const REFRESH_MS = 150;

export class Readings {
  #root;
  #refreshed = -Infinity;

  /** @param {ParentNode} root */
  constructor(root) {
    this.#root = root;
  }

  /** @param {LanesMessage} answer */
  show({ ego, lanes, departure }) {
    this.#showOffset(ego, departure?.state ?? "none");
    if (performance.now() - this.#refreshed < REFRESH_MS) return;
    this.#refreshed = performance.now();
    this.#text("reading-offset", offsetText(ego));
    this.#text("reading-width", ego.lane_width_m === null ? "–" : `${ego.lane_width_m.toFixed(2)} m`);
    this.#text("reading-radius", radiusText(ego.curvature));
    this.#find("offset").setAttribute("aria-label", `Position in the lane: ${offsetText(ego)}`);
    this.#showLanes(lanes);
  }

  clear() {
    for (const id of ["reading-offset", "reading-width", "reading-radius"]) this.#text(id, "–");
    for (const mark of this.#find("offset").querySelectorAll("i.spread, i.vehicle"))
      /** @type {HTMLElement} */ (mark).hidden = true;
    this.#find("lanes").querySelector("tbody")?.replaceChildren();
  }

  /**
   * @param {LanesMessage["ego"]} ego
   * @param {string} state
   */
  #showOffset(ego, state) {
    const bar = this.#find("offset");
    bar.dataset.state = state;
    const [spread, vehicle] = /** @type {HTMLElement[]} */ ([
      bar.querySelector(".spread"),
      bar.querySelector(".vehicle"),
    ]);
    spread.hidden = vehicle.hidden = ego.offset === null;
    if (ego.offset === null) return;
    const sigma = ego.offset_sigma ?? 0;
    vehicle.style.insetInlineStart = `${share(ego.offset)}%`;
    const [low, high] = [share(ego.offset - SIGMAS * sigma), share(ego.offset + SIGMAS * sigma)];
    spread.style.insetInlineStart = `${low}%`;
    spread.style.inlineSize = `${high - low}%`;
  }

  /** @param {LanesMessage["lanes"]} lanes */
  #showLanes(lanes) {
    const body = this.#find("lanes").querySelector("tbody");
    if (!body) return;
    const sorted = lanes.toSorted((a, b) => a.position - b.position);
    while (body.rows.length > sorted.length) body.deleteRow(-1);
    sorted.forEach((lane, index) => {
      const row = body.rows[index] ?? newRow(body);
      const [id, position, kind, probability] = row.cells;
      /** @type {HTMLElement} */ (id.firstElementChild).style.background =
        lane.kind === "road_edge" ? "" : positionColor(lane.position);
      setText(/** @type {HTMLElement} */ (id.firstElementChild), String(lane.track_id));
      setText(position, positionName(lane.position));
      setText(kind, lineName(lane));
      setText(probability, lane.state === "detected" ? `${(100 * lane.probability).toFixed(0)} %` : lane.state);
      row.dataset.state = lane.state;
    });
  }

  /**
   * @param {string} id
   * @param {string} text
   */
  #text(id, text) {
    setText(this.#find(id), text);
  }

  /** @param {string} id */
  #find(id) {
    return /** @type {HTMLElement} */ (this.#root.querySelector(`#${id}`));
  }
}

/** @param {number} offset */
function share(offset) {
  return 100 * Math.min(1, Math.max(0, 0.5 + offset / BAR_LANES));
}

/** @param {LanesMessage["ego"]} ego */
function offsetText(ego) {
  if (ego.offset_m !== null) return `${Math.abs(ego.offset_m).toFixed(2)} m ${side(ego.offset_m, 0.005)}`.trim();
  if (ego.offset !== null) return `${Math.abs(100 * ego.offset).toFixed(0)} % ${side(ego.offset, 0.005)}`.trim();
  return "unknown";
}

/** @param {number | null} curvature */
function radiusText(curvature) {
  if (curvature === null) return "–";
  if (Math.abs(curvature) < STRAIGHT) return "straight";
  return `${Math.round(1 / Math.abs(curvature) / 10) * 10} m ${curvature > 0 ? "left" : "right"}`;
}

/**
 * @param {number} value
 * @param {number} least
 */
function side(value, least) {
  return Math.abs(value) < least ? "" : value > 0 ? "right" : "left";
}

/** @param {HTMLTableSectionElement} body */
function newRow(body) {
  const row = body.insertRow();
  row.insertCell().append(document.createElement("b"));
  for (let cell = 0; cell < 3; cell += 1) row.insertCell();
  return row;
}

/**
 * @param {HTMLElement} element
 * @param {string} text
 */
function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
