import assert from "node:assert/strict";
import { test } from "node:test";
import { lanePoints, laneX } from "../dist/index.js";

const LANE = { horizon: 100, coefficients: [320, 0.5, 40], line: { bottom: [480.2, 359], top: [340, 140] } };

test("x(y) = v + b u + k / u", () => {
  assert.equal(laneX(LANE, 180), 320 + 0.5 * 80 + 40 / 80);
});

test("rows above the horizon count as one row below it", () => {
  assert.equal(laneX(LANE, 50), 320 + 0.5 + 40);
});

test("points go from the lowest row to the highest, both included", () => {
  const points = lanePoints(LANE);
  assert.equal(points[0][1], 359);
  assert.equal(points.at(-1)[1], 140);
  for (const [index, [x, y]] of points.entries()) {
    assert.equal(x, laneX(LANE, y));
    assert.ok(index === 0 || (points[index - 1][1] > y && points[index - 1][1] - y <= 8));
  }
});

test("points between other rows", () => {
  assert.deepEqual(lanePoints(LANE, { from: 200, to: 230, step: 10 }).map(([, y]) => y), [200, 210, 220, 230]);
  assert.deepEqual(lanePoints(LANE, { from: 200, to: 200 }).map(([, y]) => y), [200, 200]);
});
