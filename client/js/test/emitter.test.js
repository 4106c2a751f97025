import assert from "node:assert/strict";
import { test } from "node:test";
import { Emitter } from "../dist/emitter.js";

class Counter extends Emitter {
  count(value) {
    this.emit("count", value);
  }
}

test("listeners get the values until they are removed", () => {
  const counter = new Counter();
  const seen = [];
  const stop = counter.on("count", (value) => seen.push(value));
  counter.on("other", () => assert.fail());
  counter.count(1);
  stop();
  counter.count(2);
  assert.deepEqual(seen, [1]);
});

test("a listener that fails does not disturb the others, and its error is reported", (t) => {
  const reports = [];
  t.mock.method(globalThis, "setTimeout", (report) => reports.push(report));
  const counter = new Counter();
  const seen = [];
  counter.on("count", () => {
    throw new Error("a mistake");
  });
  counter.on("count", (value) => seen.push(value));
  counter.count(1);
  assert.deepEqual(seen, [1]);
  assert.throws(reports[0], /a mistake/);
});
