import assert from "node:assert/strict";
import { test } from "node:test";
import { LaneError } from "../dist/index.js";
import { State, StreamProtocol } from "../dist/protocol.js";

const IMAGE = new Uint8Array(10);

/** Returns a protocol whose stream is open. */
function opened(options = {}, limits = {}) {
  const protocol = new StreamProtocol({ mode: "all", ...options }, () => 0);
  protocol.receiveReady(ready({ limits }));
  return protocol;
}

function ready({ limits = {}, ...fields } = {}) {
  const all = { max_bytes: 1000, credits: 2, ...limits };
  const message = { type: "ready", session: "s", resume_token: "token", resumed: false, last_seq: null };
  return JSON.stringify({ ...message, ...fields, limits: all });
}

const lanes = (seq) => JSON.stringify({ type: "lanes", seq, lanes: [] });
const error = (fields) => JSON.stringify({ type: "error", code: "busy", message: "m", hint: "h", ...fields });
const draining = JSON.stringify({ type: "draining", resume_token: "newer", deadline_s: 10 });
const summary = JSON.stringify({ type: "summary", frames: 0, answered: 0, failed: 0, dropped: 0, duration_s: 0 });

function add(protocol, count) {
  for (let index = 0; index < count; index++) {
    protocol.add(IMAGE);
  }
}

/** Returns the numbers of the frames that the protocol sends now, and `end`. */
function sent(protocol) {
  const sent = [];
  for (let messages = protocol.messagesToSend(); messages.length; messages = protocol.messagesToSend()) {
    const message = JSON.parse(messages[0]);
    assert.equal(messages.length, message.type === "frame" ? 2 : 1);
    sent.push(message.type === "frame" ? message.seq : message.type);
  }
  return sent;
}

/** Returns the outcomes since the last call: numbers with `lanes`, the code of an error, or `dropped`. */
function outcomes(protocol) {
  return protocol.takeOutcomes().map(({ seq, result }) => {
    return `${seq} ${result === null ? "dropped" : result instanceof LaneError ? result.code : result.type}`;
  });
}

const isError = (code, extra = {}) => (thrown) => {
  assert.ok(thrown instanceof LaneError);
  assert.equal(thrown.code, code);
  for (const [name, value] of Object.entries(extra)) {
    assert.equal(thrown[name], value);
  }
  return true;
};

test("mode all sends as many frames as there are credits, and answers renew them", () => {
  const protocol = opened();
  add(protocol, 4);
  assert.deepEqual(sent(protocol), [0, 1]);
  protocol.receive(lanes(0));
  assert.deepEqual(sent(protocol), [2]);
  protocol.receive(error({ code: "bad_image", seq: 1 }));
  assert.deepEqual(sent(protocol), [3]);
  assert.deepEqual(outcomes(protocol), ["0 lanes", "1 bad_image"]);
});

test("mode latest keeps the newest of the frames that wait", () => {
  const protocol = opened({ mode: "latest" }, { credits: 8 });
  add(protocol, 1);
  assert.deepEqual(sent(protocol), [0]);
  add(protocol, 1);
  assert.deepEqual(sent(protocol), [1]);
  assert.equal(protocol.wantsFrame, false);
  add(protocol, 3);
  assert.deepEqual(sent(protocol), []);
  protocol.receive(lanes(0));
  assert.deepEqual(sent(protocol), [4]);
  protocol.receive(lanes(1));
  assert.equal(protocol.wantsFrame, true);
  protocol.receive(lanes(4));
  assert.deepEqual(outcomes(protocol), ["0 lanes", "1 lanes", "2 dropped", "3 dropped", "4 lanes"]);
  assert.equal(protocol.dropped, 2);
});

test("a frame that the service did not answer before a later one was dropped", () => {
  const protocol = opened({ mode: "latest" });
  add(protocol, 1);
  sent(protocol);
  add(protocol, 1);
  sent(protocol);
  protocol.receive(lanes(1));
  assert.deepEqual(outcomes(protocol), ["0 dropped", "1 lanes"]);
});

test("before the stream is open, mode latest keeps one frame and mode all keeps all", () => {
  for (const [mode, expected] of [["latest", [2]], ["all", [0, 1]]]) {
    const protocol = new StreamProtocol({ mode });
    add(protocol, 3);
    assert.deepEqual(sent(protocol), []);
    protocol.receiveReady(ready());
    assert.deepEqual(sent(protocol), expected);
  }
});

test("start holds the options, and the token of the session after a reconnect", () => {
  const protocol = new StreamProtocol({ mode: "all", horizon: 0.4, session: undefined });
  assert.deepEqual(JSON.parse(protocol.startMessage()), { type: "start", mode: "all", horizon: 0.4 });
  protocol.receiveReady(ready());
  protocol.connectionLost();
  const start = { type: "start", mode: "all", horizon: 0.4, resume_token: "token" };
  assert.deepEqual(JSON.parse(protocol.startMessage()), start);
  protocol.receiveReady(ready());
  protocol.receive(draining);
  assert.equal(JSON.parse(protocol.startMessage()).resume_token, "newer");
  assert.equal(protocol.reconnects, 1);
});

test("a restart changes the given options only", () => {
  const protocol = opened({ horizon: 0.4, kinds: ["marking"] });
  protocol.restart({ detector: "regression", kinds: undefined });
  const start = { type: "start", mode: "all", horizon: 0.4, detector: "regression", resume_token: "token" };
  assert.deepEqual(JSON.parse(protocol.startMessage()), start);
});

test("a restart in mode latest keeps the newest frame of mode all", () => {
  const protocol = opened();
  add(protocol, 5);
  sent(protocol);
  protocol.restart({ mode: "latest" });
  protocol.connectionLost();
  assert.deepEqual(outcomes(protocol), ["0 dropped", "1 dropped", "2 dropped", "3 dropped"]);
  protocol.receiveReady(ready({ resumed: true }));
  assert.deepEqual(sent(protocol), [4]);
});

test("a resumed session does not process a frame twice", () => {
  const protocol = opened();
  add(protocol, 3);
  assert.deepEqual(sent(protocol), [0, 1]);
  protocol.connectionLost();
  assert.deepEqual(outcomes(protocol), []);
  protocol.receiveReady(ready({ resumed: true, last_seq: 0 }));
  assert.deepEqual(outcomes(protocol), ["0 lost"]);
  assert.deepEqual(sent(protocol), [1, 2]);
});

test("a new session gets all unanswered frames", () => {
  const protocol = opened();
  add(protocol, 3);
  sent(protocol);
  protocol.connectionLost();
  protocol.receiveReady(ready({ last_seq: 5 }));
  assert.deepEqual(sent(protocol), [0, 1]);
  assert.deepEqual(outcomes(protocol), []);
});

test("mode latest drops the unanswered frames of a lost connection", () => {
  const protocol = opened({ mode: "latest" });
  add(protocol, 1);
  sent(protocol);
  protocol.connectionLost();
  add(protocol, 1);
  assert.deepEqual(outcomes(protocol), ["0 dropped"]);
  protocol.receiveReady(ready({ resumed: true, last_seq: 0 }));
  assert.deepEqual(sent(protocol), [1]);
});

test("nothing is sent to a draining service", () => {
  const protocol = opened();
  protocol.receive(draining);
  add(protocol, 1);
  assert.deepEqual(sent(protocol), []);
  assert.equal(protocol.expectsMessage, true);
  protocol.receiveReady(ready({ resumed: true }));
  assert.equal(protocol.draining, false);
  assert.deepEqual(sent(protocol), [0]);
});

test("a frame that a draining service refused is sent again in mode all", () => {
  const protocol = opened();
  add(protocol, 2);
  sent(protocol);
  protocol.receive(lanes(0));
  protocol.receive(error({ code: "draining", seq: 1 }));
  protocol.connectionLost();
  assert.deepEqual(outcomes(protocol), ["0 lanes"]);
  protocol.receiveReady(ready({ resumed: true, last_seq: 0 }));
  assert.deepEqual(sent(protocol), [1]);
});

test("a frame that a draining service refused is dropped in mode latest", () => {
  const protocol = opened({ mode: "latest" });
  add(protocol, 1);
  sent(protocol);
  protocol.receive(error({ code: "draining", seq: 0 }));
  assert.deepEqual(outcomes(protocol), ["0 dropped"]);
});

test("the end follows the last frame, and the summary counts all of them", () => {
  const protocol = opened();
  add(protocol, 3);
  protocol.end();
  assert.deepEqual(sent(protocol), [0, 1]);
  protocol.receive(lanes(0));
  assert.deepEqual(sent(protocol), [2, "end"]);
  assert.equal(protocol.state, State.Ending);
  protocol.receive(error({ seq: 1 }));
  protocol.receive(lanes(2));
  protocol.receive(summary);
  assert.equal(protocol.state, State.Finished);
  const expected = { frames: 3, answered: 2, failed: 1, dropped: 0, lost: 0, duration_s: 0 };
  assert.deepEqual(protocol.summary, expected);
  assert.throws(() => protocol.add(IMAGE), isError("bad_message"));
});

test("frames without an answer before the summary are lost in mode all", () => {
  const protocol = opened();
  add(protocol, 1);
  protocol.end();
  sent(protocol);
  protocol.receive(summary);
  assert.deepEqual(outcomes(protocol), ["0 lost"]);
});

test("a stream without unanswered frames has ended when its connection is lost after the end", () => {
  const protocol = opened();
  add(protocol, 1);
  sent(protocol);
  protocol.receive(lanes(0));
  protocol.connectionLost();
  protocol.end();
  assert.equal(protocol.state, State.Finished);
});

test("a stream that has ended reconnects for its unanswered frames", () => {
  const protocol = opened();
  add(protocol, 1);
  protocol.end();
  sent(protocol);
  protocol.connectionLost();
  assert.equal(protocol.state, State.Disconnected);
  protocol.receiveReady(ready());
  assert.deepEqual(sent(protocol), [0, "end"]);
});

test("a stream that ends before it is open still opens, so that its options are checked", () => {
  const protocol = new StreamProtocol();
  protocol.end();
  protocol.connectionLost();
  assert.equal(protocol.state, State.Disconnected);
  protocol.receiveReady(ready());
  assert.deepEqual(sent(protocol), ["end"]);
});

test("a stream that gives up settles all frames", () => {
  const protocol = opened();
  add(protocol, 3);
  sent(protocol);
  protocol.giveUp(new LaneError("connection_failed", "gone"));
  const expected = ["0 connection_failed", "1 connection_failed", "2 connection_failed"];
  assert.deepEqual(outcomes(protocol), expected);
  assert.equal(protocol.summary.lost, 3);
});

test("an image that is too large fails in its turn, and is not sent", () => {
  const protocol = opened({}, { credits: 8, max_bytes: 20 });
  protocol.add(new Blob([new Uint8Array(20)]));
  protocol.add(new Blob([new Uint8Array(21)]));
  protocol.add(new ArrayBuffer(21));
  protocol.add(IMAGE);
  assert.deepEqual(sent(protocol), [0, 3]);
  assert.deepEqual(outcomes(protocol), []);
  protocol.receive(lanes(0));
  assert.deepEqual(outcomes(protocol), ["0 lanes", "1 image_too_large", "2 image_too_large"]);
});

test("the values of a frame are sent, and numbers count up from the last one", () => {
  const protocol = opened();
  protocol.add(IMAGE, { seq: 5, timestamp: 0.2, speed: 20, indicator: "left" });
  assert.equal(protocol.add(IMAGE), 6);
  const frame = { type: "frame", seq: 5, timestamp: 0.2, speed: 20, indicator: "left" };
  assert.deepEqual(JSON.parse(protocol.messagesToSend()[0]), frame);
});

const BAD_META = [
  { seq: 3 },
  { seq: -1 },
  { seq: 7.5 },
  { seq: 2 ** 53 },
  { timestamp: NaN },
  { timestamp: 1e16 },
  { speed: -1 },
  { speed: 151 },
  { indicator: "both" },
];

for (const meta of BAD_META) {
  test(`a frame with ${JSON.stringify(meta)} is refused, and the stream continues`, () => {
    const protocol = opened();
    protocol.add(IMAGE, { seq: 3 });
    assert.throws(() => protocol.add(IMAGE, meta), isError("bad_message"));
    assert.equal(protocol.add(IMAGE), 4);
  });
}

test("errors end the stream unless they are about a frame", () => {
  assert.throws(() => opened().receive(error({ fatal: true })), isError("busy", { hint: "h", fatal: true }));
  assert.throws(() => opened().receive(error({ code: "bad_message" })), isError("bad_message", { seq: null }));
});

test("messages that are not valid here are errors", () => {
  const wrong = [lanes(0), ready(), summary, "no JSON", "[]", "null", '"lanes"', "{}", error({ seq: 4 })];
  for (const text of wrong) {
    assert.throws(() => opened().receive(text), isError("bad_message"), text);
  }
});

test("messages of a later version are ignored", () => {
  const protocol = opened();
  assert.equal(protocol.receive('{"type": "weather"}').type, "weather");
});

test("only ready opens a stream", () => {
  assert.throws(() => new StreamProtocol().receiveReady(lanes(0)), isError("bad_message"));
  assert.throws(() => new StreamProtocol().receiveReady(draining), isError("draining"));
  assert.throws(() => new StreamProtocol().receiveReady(error({ code: "no_detector" })), isError("no_detector"));
});
