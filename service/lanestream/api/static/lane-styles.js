/** How boundaries are drawn: their shape shows what they are, their color where they are. */

/** @typedef {import("./client/index.js").LaneModel} LaneModel */

/** Colors that people with any kind of color blindness can tell apart (Okabe and Ito). */
const POSITIONS = new Map([
  [-2, { color: "#cc79a7", name: "next left" }],
  [-1, { color: "#e69f00", name: "ego left" }],
  [1, { color: "#56b4e9", name: "ego right" }],
  [2, { color: "#f0e442", name: "next right" }],
]);
const OTHER = { color: "#bdbdbd", name: "further out" };
export const EDGE = "#f5f5f5";
export const YELLOW = "#ffeb00";
export const EGO_LANE = "0, 158, 115";

/** @type {Record<string, [number, number]>} the number of dashes, and the painted share of a dash and its gap */
const BY_STATE = { detected: [1, 1], inferred: [4, 0.8], predicted: [8, 0.5] };
/** @type {Record<string, [number, number]>} */
const BY_TYPE = { dashed: [7, 0.5], dots: [18, 0.3] };
const SINGLE = [{ middle: 0, width: 1 }];
const DOUBLE = [
  { middle: -0.65, width: 0.5 },
  { middle: 0.65, width: 0.5 },
];
const THIN = [{ middle: 0, width: 0.5 }];
/** A predicted boundary fades to a third of its strength within this many seconds. */
const FADING_S = 1.5;

/**
 * @typedef {object} LineStyle
 * @property {[number, number][]} pieces starts and ends of the drawn pieces, as shares of the line's length
 * @property {{middle: number, width: number}[]} strands parallel stripes, in widths of a usual line
 * @property {string} color
 * @property {string | null} core color of a narrow stripe in its middle
 * @property {number} ticks side of the ticks of a road edge, -1 left, 1 right, 0 for none
 * @property {number} alpha
 */

/** @param {number} position */
export function positionColor(position) {
  return (POSITIONS.get(position) ?? OTHER).color;
}

/** @param {number} position */
export function positionName(position) {
  return (POSITIONS.get(position) ?? OTHER).name;
}

/**
 * Returns what a boundary is, such as "dashed white".
 * @param {LaneModel} lane
 */
export function lineName(lane) {
  if (lane.kind === "road_edge") return "road edge";
  return lane.marking === null ? "marking" : `${lane.marking.type} ${lane.marking.color}`;
}

/**
 * Returns how a boundary is drawn that was last detected `unseen` seconds ago.
 * @param {LaneModel} lane
 * @param {number} unseen
 * @returns {LineStyle}
 */
export function lineStyle(lane, unseen) {
  const isEdge = lane.kind === "road_edge";
  const type = lane.marking === null || isEdge ? "solid" : lane.marking.type;
  const [count, painted] = lane.state === "predicted" ? BY_STATE.predicted : (BY_TYPE[type] ?? BY_STATE[lane.state]);
  const length = count - 1 + painted;
  return {
    pieces: Array.from({ length: count }, (_, n) => [n / length, (n + painted) / length]),
    strands: isEdge ? THIN : type === "double" ? DOUBLE : SINGLE,
    color: isEdge ? EDGE : positionColor(lane.position),
    core: !isEdge && lane.marking?.color === "yellow" ? YELLOW : null,
    ticks: isEdge ? Math.sign(lane.position) : 0,
    alpha: strength(lane, unseen),
  };
}

/**
 * @param {LaneModel} lane
 * @param {number} unseen
 */
function strength(lane, unseen) {
  if (lane.state === "detected") return 1;
  if (lane.state === "inferred") return 0.85;
  return Math.max(0.25, 0.8 * lane.probability * Math.exp(-unseen / FADING_S));
}
