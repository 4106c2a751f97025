/**
 * Draws lanes on their own picture: the ego lane as an area, boundaries as ribbons that taper with distance.
 *
 * Coordinates are pixels of the image that the service has answered; the canvas is scaled to them.
 */

import { laneX } from "./client/index.js";
import { EGO_LANE, lineStyle, positionColor } from "./lane-styles.js";

/** @typedef {import("./client/index.js").LaneModel} LaneModel */
/** @typedef {import("./client/index.js").LanesMessage} LanesMessage */

const SAMPLES = 40;
const FORESHORTENING = 1.6;
const CORE = 0.45;
const TICKS = 12;
const TICK_LENGTH = 6;
// The opacity of the ego lane from its far end to its near one, where a hood may hide the road.
const FILL = [
  [0, 0],
  [0.35, 0.18],
  [0.78, 0.36],
  [1, 0.06],
];
// A boundary that ends in this share of the picture at its side leaves it there.
const SIDE = 0.01;
const DARK = "rgba(12, 16, 20, 0.85)";

/**
 * Draws a frame and its lanes; without an answer, the frame alone.
 * @param {CanvasRenderingContext2D} context
 * @param {ImageBitmap} picture
 * @param {LanesMessage | null} answer the `lanes` message of this very frame
 * @param {(lane: LaneModel) => number} unseen seconds since a boundary was last detected
 * @param {number} shownWidth of the canvas on the page; on a small one, lines and labels are relatively larger
 */
export function drawFrame(context, picture, answer, unseen, shownWidth) {
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.globalAlpha = 1;
  context.drawImage(picture, 0, 0);
  if (answer === null) return;
  // Pixel centers are at integers in answers, and at halves on a canvas.
  const zoom = picture.width / answer.width;
  context.setTransform(zoom, 0, 0, zoom, 0.5 * zoom, 0.5 * zoom);
  const scale = answer.width / Math.min(1280, Math.max(320, 1.5 * shownWidth));
  fillEgoLane(context, answer);
  for (const lane of answer.lanes) drawBoundary(context, lane, lineStyle(lane, unseen(lane)), answer, scale);
  for (const lane of answer.lanes) drawLabel(context, lane, answer, scale);
  context.globalAlpha = 1;
}

/**
 * Draws a horizontal line at a fraction of the picture's height.
 * @param {CanvasRenderingContext2D} context
 * @param {number} fraction
 */
export function drawHorizon(context, fraction) {
  const { width, height } = context.canvas;
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.save();
  context.setLineDash([width / 80, width / 80]);
  for (const [color, lineWidth] of /** @type {[string, number][]} */ ([
    [DARK, 4],
    ["#ffffff", 2],
  ])) {
    context.strokeStyle = color;
    context.lineWidth = (lineWidth * width) / 1280;
    context.beginPath();
    context.moveTo(0, fraction * height);
    context.lineTo(width, fraction * height);
    context.stroke();
  }
  context.restore();
}

/**
 * Fills the ego lane where both of its boundaries are reported. The area fades out at both ends.
 * @param {CanvasRenderingContext2D} context
 * @param {LanesMessage} answer
 */
function fillEgoLane(context, answer) {
  const left = answer.lanes.find((lane) => lane.track_id === answer.ego.left);
  const right = answer.lanes.find((lane) => lane.track_id === answer.ego.right);
  if (!left || !right) return;
  const [[leftX, leftY], [rightX, rightY]] = [left.line.bottom, right.line.bottom];
  const top = Math.max(left.line.top[1], right.line.top[1]);
  // Where a boundary leaves the picture sideways, the lane goes on along the picture's edge, as low as the other one.
  const leavesLeft = leftX < SIDE * answer.width && leftY < rightY;
  const leavesRight = rightX > (1 - SIDE) * answer.width && rightY < leftY;
  const bottom = leavesLeft || leavesRight ? Math.max(leftY, rightY) : Math.min(leftY, rightY);
  if (Math.min(leftY, rightY) - top < 2) return;
  const fading = context.createLinearGradient(0, top, 0, bottom);
  for (const [share, opacity] of FILL) fading.addColorStop(share, `rgba(${EGO_LANE}, ${opacity})`);
  context.globalAlpha = 1;
  context.fillStyle = fading;
  context.beginPath();
  if (leavesLeft) for (const y of [bottom, leftY]) context.lineTo(-1, y);
  for (const y of rowsBetween(Math.min(leftY, bottom), top, SAMPLES)) context.lineTo(laneX(left, y), y);
  for (const y of rowsBetween(top, Math.min(rightY, bottom), SAMPLES)) context.lineTo(laneX(right, y), y);
  if (leavesRight) for (const y of [rightY, bottom]) context.lineTo(answer.width, y);
  context.fill();
}

/**
 * Returns evenly spaced rows, with both ends.
 * @param {number} first
 * @param {number} last
 * @param {number} count
 */
function rowsBetween(first, last, count) {
  return Array.from({ length: count }, (_, n) => first + ((last - first) * n) / (count - 1));
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {LaneModel} lane
 * @param {import("./lane-styles.js").LineStyle} style
 * @param {LanesMessage} answer
 * @param {number} scale
 */
function drawBoundary(context, lane, style, answer, scale) {
  const road = { height: Math.max(1, answer.height - 1 - lane.horizon), scale };
  context.globalAlpha = style.alpha;
  if (style.ticks !== 0) drawTicks(context, lane, style, road);
  const samples = Math.max(3, Math.round(SAMPLES / style.pieces.length));
  for (const [start, end] of style.pieces) {
    const rows = rowsBetween(rowAt(lane, start), rowAt(lane, end), samples);
    for (const strand of style.strands) {
      fillRibbon(context, lane, rows, strand, DARK, 1.3 * scale, road);
      fillRibbon(context, lane, rows, strand, style.color, 0, road);
      if (style.core !== null) {
        fillRibbon(context, lane, rows, { ...strand, width: CORE * strand.width }, style.core, 0, road);
      }
    }
  }
}

/**
 * Returns the row at a share of a boundary's length. Equal shares get shorter with distance, as on a road.
 * @param {LaneModel} lane
 * @param {number} share
 */
function rowAt(lane, share) {
  const [bottom, top] = [lane.line.bottom[1], lane.line.top[1]];
  return top + (bottom - top) * (1 - share) ** FORESHORTENING;
}

/**
 * @param {LaneModel} lane
 * @param {number} y
 * @param {{height: number, scale: number}} road
 */
function halfWidth(lane, y, road) {
  const nearness = Math.min(1, Math.max(0, (y - lane.horizon) / road.height));
  return (1.2 + 4.3 * nearness) * road.scale;
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {LaneModel} lane
 * @param {number[]} rows
 * @param {{middle: number, width: number}} strand
 * @param {string} color
 * @param {number} rim
 * @param {{height: number, scale: number}} road
 */
function fillRibbon(context, lane, rows, strand, color, rim, road) {
  /** @type {[number, number, number][]} */
  const edges = rows.map((y) => {
    // The width is measured across the ribbon, so that oblique boundaries do not shrink to hairlines.
    const u = Math.max(y - lane.horizon, 1);
    const obliquity = Math.min(3, Math.hypot(1, lane.coefficients[1] - lane.coefficients[2] / (u * u)));
    const half = halfWidth(lane, y, road);
    const middle = laneX(lane, y) + 2 * strand.middle * half * obliquity;
    const reach = (strand.width * half + rim) * obliquity;
    return [middle - reach, middle + reach, y];
  });
  context.fillStyle = color;
  context.beginPath();
  for (const [left, , y] of edges) context.lineTo(left, y);
  for (const [, right, y] of edges.reverse()) context.lineTo(right, y);
  context.fill();
}

/**
 * Draws short ticks along a road edge, away from the vehicle.
 * @param {CanvasRenderingContext2D} context
 * @param {LaneModel} lane
 * @param {import("./lane-styles.js").LineStyle} style
 * @param {{height: number, scale: number}} road
 */
function drawTicks(context, lane, style, road) {
  for (let tick = 0; tick < TICKS; tick += 1) {
    const y = rowAt(lane, (tick + 0.5) / TICKS);
    const half = halfWidth(lane, y, road);
    const length = style.ticks * TICK_LENGTH * half;
    for (const [height, color] of /** @type {[number, string][]} */ ([
      [0.4 * half + 1.3 * road.scale, DARK],
      [0.4 * half, style.color],
    ])) {
      context.fillStyle = color;
      context.fillRect(laneX(lane, y), y - height, length, 2 * height);
    }
  }
}

/**
 * Writes the track id on a small label, a third of the way up the boundary.
 * @param {CanvasRenderingContext2D} context
 * @param {LaneModel} lane
 * @param {LanesMessage} answer
 * @param {number} scale
 */
function drawLabel(context, lane, answer, scale) {
  const text = String(lane.track_id);
  const y = lane.line.bottom[1] + 0.3 * (lane.line.top[1] - lane.line.bottom[1]);
  context.font = `600 ${17 * scale}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  const width = Math.max(context.measureText(text).width + 14 * scale, 24 * scale);
  const height = 25 * scale;
  const left = Math.min(Math.max(0, laneX(lane, y) - width / 2), answer.width - width);
  context.globalAlpha = lane.state === "predicted" ? 0.6 : 1;
  for (const [inset, color] of /** @type {[number, string][]} */ ([
    [0, DARK],
    [2 * scale, lane.kind === "road_edge" ? "#f5f5f5" : positionColor(lane.position)],
  ])) {
    context.fillStyle = color;
    context.beginPath();
    context.roundRect(left + inset, y + inset, width - 2 * inset, height - 2 * inset, 7 * scale - inset);
    context.fill();
  }
  context.fillStyle = "#14181c";
  context.fillText(text, left + width / 2, y + height / 2 + 0.5 * scale);
}
