import assert from "node:assert/strict";
import { test } from "node:test";
import { LaneError } from "../dist/index.js";
import { FailoverPolicy } from "../dist/failover.js";

const LOST = new LaneError("connection_failed", "lost");

/** Returns a policy with a clock that only `advance` moves, and without a random part in its pauses. */
function policy({ replicas = 1, totalS = 30, timeoutS = 30 } = {}) {
  let now = 0;
  const failover = new FailoverPolicy(replicas, totalS, timeoutS, () => now, () => 1);
  return { failover, advance: (seconds) => (now += seconds) };
}

function pauses(failover, count, error = LOST) {
  return Array.from({ length: count }, () => failover.pauseAfter(error, false));
}

test("pauses double up to two seconds", () => {
  const { failover } = policy();
  failover.connected();
  assert.deepEqual(pauses(failover, 8), [0, 0.1, 0.2, 0.4, 0.8, 1.6, 2, 2]);
});

test("each replica is tried once before the first pause", () => {
  const { failover } = policy({ replicas: 3 });
  failover.connected();
  const tried = [];
  for (let index = 0; index < 5; index++) {
    const pause = failover.pauseAfter(LOST, false);
    tried.push([failover.index, pause]);
  }
  assert.deepEqual(tried, [[0, 0], [1, 0], [2, 0], [0, 0.1], [1, 0]]);
});

test("another replica is first if one drains", () => {
  const { failover } = policy({ replicas: 2 });
  failover.connected();
  failover.pauseAfter(LOST, true);
  assert.equal(failover.index, 1);
});

test("attempts may take longer in each round, but not longer than the time that is left", () => {
  const { failover, advance } = policy({ totalS: 10 });
  assert.equal(failover.attemptS, 2);
  pauses(failover, 2);
  assert.equal(failover.attemptS, 8);
  advance(6);
  assert.equal(failover.attemptS, 4);
});

test("it gives up when the time is over", () => {
  const { failover, advance } = policy({ totalS: 10 });
  failover.connected();
  assert.equal(failover.pauseAfter(LOST, false), 0);
  advance(9.95);
  assert.equal(failover.pauseAfter(LOST, false), null);
});

test("connections without an answered frame do not renew the time", () => {
  const { failover, advance } = policy({ totalS: 10 });
  failover.connected();
  for (let index = 0; index < 3; index++) {
    assert.notEqual(failover.pauseAfter(LOST, false), null);
    advance(3);
    failover.connected();
  }
  failover.pauseAfter(LOST, false);
  advance(1.5);
  assert.equal(failover.pauseAfter(LOST, false), null);
});

test("an answered frame renews the time and the pauses", () => {
  const { failover, advance } = policy({ totalS: 10 });
  failover.connected();
  pauses(failover, 3);
  advance(9);
  failover.connected();
  failover.progressed();
  assert.deepEqual(pauses(failover, 2), [0, 0.1]);
});

test("a first connection is retried, too", () => {
  const { failover, advance } = policy({ totalS: 10 });
  assert.deepEqual(pauses(failover, 2), [0, 0.1]);
  advance(10);
  assert.equal(failover.pauseAfter(LOST, false), null);
});

test("without reconnecting, each replica is tried once at first", () => {
  const { failover } = policy({ replicas: 2, totalS: 0 });
  assert.equal(failover.attemptS, 15);
  assert.deepEqual(pauses(failover, 2), [0, null]);
  const connected = policy({ replicas: 2, totalS: 0 }).failover;
  connected.connected();
  assert.equal(connected.pauseAfter(LOST, false), null);
});

for (const code of ["unauthorized", "forbidden", "no_detector", "evicted", "session_too_old", "bad_message"]) {
  test(`retrying can't fix ${code}`, () => {
    assert.equal(policy().failover.pauseAfter(new LaneError(code, ""), false), null);
  });
}

for (const code of ["busy", "not_ready", "draining", "idle", "internal", "connection_failed", "not_found"]) {
  test(`${code} is retried`, () => {
    assert.equal(policy().failover.pauseAfter(new LaneError(code, ""), false), 0);
  });
}
