/** Draws the road from above, in meters, with 95 % bands of uncertainty; ahead is up. */

import { lineStyle } from "./lane-styles.js";

/** @typedef {import("./client/index.js").LaneModel} LaneModel */

// The part of the road that the map shows in meters: ahead, behind and on either side of the vehicle.
const AHEAD = 45;
const BEHIND = 5;
const SIDE = 7.5;
const GRID = [10, 20, 30, 40];
const VEHICLE = { length: 4.4, width: 1.8 };
const SAMPLES = 40;
// A normal distribution has 95 % within this many sigmas.
const SIGMAS = 1.96;
const LINE_M = 0.35;
const TICKS_M = 4;
const TICK_M = 0.6;

/**
 * Draws the lanes that have meters, and nothing but the grid if none has.
 * @param {HTMLCanvasElement} canvas
 * @param {LaneModel[]} lanes
 * @param {(lane: LaneModel) => number} unseen seconds since a boundary was last detected
 */
export function drawMap(canvas, lanes, unseen) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (width === 0 || height === 0) return;
  if (canvas.width !== Math.round(width * ratio)) canvas.width = Math.round(width * ratio);
  if (canvas.height !== Math.round(height * ratio)) canvas.height = Math.round(height * ratio);
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const map = {
    context,
    /** @param {number} y */
    column: (y) => width * (0.5 - (0.5 * y) / SIDE),
    /** @param {number} x */
    row: (x) => (height * (AHEAD - x)) / (AHEAD + BEHIND),
  };
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  drawGrid(map, width);
  const known = lanes.filter((lane) => lane.ground !== null);
  for (const lane of known) drawBand(map, lane, lineStyle(lane, unseen(lane)));
  for (const lane of known) drawLine(map, lane, lineStyle(lane, unseen(lane)));
  context.globalAlpha = 1;
  context.fillStyle = "#e8ecf0";
  const half = VEHICLE.width / 2;
  context.beginPath();
  context.roundRect(
    map.column(half),
    map.row(0),
    map.column(-half) - map.column(half),
    map.row(-VEHICLE.length) - map.row(0),
    5,
  );
  context.fill();
}

/**
 * @typedef {object} RoadMap
 * @property {CanvasRenderingContext2D} context
 * @property {(y: number) => number} column
 * @property {(x: number) => number} row
 */

/**
 * @param {RoadMap} map
 * @param {number} width
 */
function drawGrid({ context, row }, width) {
  context.globalAlpha = 1;
  context.font = "11px system-ui, sans-serif";
  context.textBaseline = "bottom";
  context.lineWidth = 1;
  for (const distance of GRID) {
    const y = Math.round(row(distance)) + 0.5;
    context.strokeStyle = "rgba(255, 255, 255, 0.13)";
    context.beginPath();
    context.moveTo(0, y);
    context.lineTo(width, y);
    context.stroke();
    context.fillStyle = "rgba(255, 255, 255, 0.6)";
    context.fillText(`${distance} m`, 6, y - 2);
  }
}

/**
 * Returns how far left of the vehicle a boundary is that has meters.
 * @param {LaneModel} lane
 * @param {number} x ahead
 */
function lateral(lane, x) {
  const [a, b, c] = /** @type {[number, number, number]} */ (lane.ground);
  return a * x * x + b * x + c;
}

/**
 * @param {RoadMap} map
 * @param {LaneModel} lane
 * @param {import("./lane-styles.js").LineStyle} style
 */
function drawBand({ context, column, row }, lane, style) {
  const covariance = lane.ground_covariance;
  if (covariance === null) return;
  /** @type {[number, number, number][]} */
  const band = Array.from({ length: SAMPLES + 1 }, (_, n) => {
    const x = (AHEAD * n) / SAMPLES;
    const powers = [x * x, x, 1];
    let variance = 0;
    for (let i = 0; i < 3; i += 1) for (let j = 0; j < 3; j += 1) variance += powers[i] * covariance[i][j] * powers[j];
    return [x, lateral(lane, x), Math.min(SIGMAS * Math.sqrt(Math.max(variance, 0)), 2 * SIDE)];
  });
  context.globalAlpha = 0.3 * style.alpha;
  context.fillStyle = style.color;
  context.beginPath();
  for (const [x, y, half] of band) context.lineTo(column(y + half), row(x));
  for (const [x, y, half] of band.reverse()) context.lineTo(column(y - half), row(x));
  context.fill();
}

/**
 * @param {RoadMap} map
 * @param {LaneModel} lane
 * @param {import("./lane-styles.js").LineStyle} style
 */
function drawLine({ context, column, row }, lane, style) {
  context.globalAlpha = style.alpha;
  for (const [start, end] of style.pieces) {
    for (const strand of style.strands) {
      for (const [color, width] of /** @type {[string | null, number][]} */ ([
        [style.color, 3 * strand.width],
        [style.core, 1],
      ])) {
        if (color === null) continue;
        context.strokeStyle = color;
        context.lineWidth = width;
        context.beginPath();
        for (let n = 0; n <= SAMPLES; n += 1) {
          const x = AHEAD * (start + ((end - start) * n) / SAMPLES);
          context.lineTo(column(lateral(lane, x) - strand.middle * LINE_M), row(x));
        }
        context.stroke();
      }
    }
  }
  if (style.ticks === 0) return;
  context.strokeStyle = style.color;
  context.lineWidth = 1.5;
  for (let x = 1; x < AHEAD; x += TICKS_M) {
    context.beginPath();
    context.moveTo(column(lateral(lane, x)), row(x));
    context.lineTo(column(lateral(lane, x) - style.ticks * TICK_M), row(x));
    context.stroke();
  }
}
