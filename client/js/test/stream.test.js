// Deadlines and pauses of a stream: with a scripted WebSocket and a clock that only the test moves.

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { setImmediate as turn } from "node:timers/promises";
import { LaneClient } from "../dist/index.js";

const IMAGE = new Uint8Array(10);
const READY = {
  type: "ready",
  session: "s",
  resume_token: "token",
  resumed: true,
  last_seq: null,
  limits: { max_bytes: 1000, credits: 8 },
};

let sockets;

/** A socket that does what the test says. */
class ScriptedSocket {
  static handshake = "accepted";
  bufferedAmount = 0;
  sent = [];
  closed = false;

  constructor(url, subprotocols) {
    Object.assign(this, { url, subprotocols });
    sockets.push(this);
    queueMicrotask(() => {
      if (ScriptedSocket.handshake === "accepted") {
        this.onopen?.();
      } else if (ScriptedSocket.handshake === "refused") {
        this.break();
      }
    });
  }

  send(message) {
    this.sent.push(typeof message === "string" ? JSON.parse(message).type : "image");
  }

  close() {
    this.closed = true;
  }

  receive(message) {
    this.onmessage?.({ data: JSON.stringify(message) });
  }

  break(code = 1006, reason = "") {
    this.onclose?.({ code, reason });
  }
}

beforeEach(() => {
  sockets = [];
  ScriptedSocket.handshake = "accepted";
});

/** Lets everything happen that needs no time. */
async function settle() {
  for (let index = 0; index < 5; index++) {
    await turn();
  }
}

/** Returns a stream with what it reports, and a function that lets seconds pass. */
function newStream(t, { client = {}, ...options } = {}) {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const refuse = () => Promise.reject(new TypeError("refused"));
  const all = { WebSocket: ScriptedSocket, fetch: refuse, reconnectS: 10, ...client };
  const stream = new LaneClient(client.urls ?? "http://a", all).stream(options);
  const states = [];
  stream.on("state", ({ state, resumed, reason }) => states.push([state, resumed, reason].join(" ")));
  const advance = async (seconds) => {
    await settle();
    t.mock.timers.tick(1000 * seconds);
    await settle();
  };
  return { stream, states, advance };
}

async function openStream(t, options) {
  const parts = newStream(t, options);
  await settle();
  sockets[0].receive(READY);
  await settle();
  parts.states.length = 0;
  return parts;
}

const failure = (promise) => promise.then(() => null, (error) => error);

test("a key is offered as a subprotocol, never in the URL", async (t) => {
  newStream(t, { client: { apiKey: "secret" } });
  await settle();
  assert.deepEqual(sockets[0].subprotocols, ["lanestream.v1", "bearer.secret"]);
  assert.equal(sockets[0].url, "ws://a/v1/stream");
});

test("a token is fetched for each connection", async (t) => {
  let count = 0;
  const token = async () => `token${(count += 1)}`;
  const { advance } = await openStream(t, { client: { token } });
  sockets[0].break();
  await advance(0);
  assert.deepEqual(sockets.map((socket) => socket.subprotocols[1]), ["bearer.token1", "bearer.token2"]);
});

test("a token that can't be fetched fails the attempt, and the reason is shown", async (t) => {
  const token = async () => {
    throw new Error("no backend");
  };
  const { stream } = newStream(t, { client: { token, reconnectS: 0 } });
  const error = await failure(stream.end());
  assert.equal(error.code, "connection_failed");
  assert.match(error.message, /no backend/);
  assert.equal(sockets.length, 0);
});

test("a function for tokens that never answers is a failure in time", async (t) => {
  const { stream, advance } = newStream(t, { client: { token: () => new Promise(() => {}), reconnectS: 0 } });
  await advance(31);
  assert.match((await failure(stream.end())).message, /token took longer/);
});

test("a connection that is never opened is given up in time", async (t) => {
  ScriptedSocket.handshake = "unanswered";
  const { states, advance } = newStream(t);
  await advance(1.9);
  assert.deepEqual(states, []);
  await advance(0.2);
  assert.deepEqual(states, ["connecting  connecting to http://a took longer than 2 s"]);
  assert.equal(sockets[0].closed, true);
});

test("a service that never answers start is left in time", async (t) => {
  const { states, advance } = newStream(t);
  await advance(4.9);
  assert.equal(sockets[0].closed, false);
  await advance(0.2);
  assert.equal(sockets[0].closed, true);
  assert.match(states[0], /^connecting  the answer of the service took longer than 5 s/);
  await advance(0);
  assert.equal(sockets.length, 2);
});

test("a service that owes an answer is taken for gone in time", async (t) => {
  const { stream, states, advance } = await openStream(t, { mode: "all" });
  void stream.send(IMAGE);
  await advance(14.9);
  void stream.send(IMAGE); // does not extend the deadline of the first one
  assert.deepEqual(states, []);
  await advance(0.2);
  assert.match(states[0], /^reconnecting  the answer of the service took longer than 15 s/);
  await advance(0);
  sockets[1].receive({ ...READY, last_seq: null });
  await settle();
  assert.deepEqual(sockets[1].sent, ["start", "frame", "image", "frame", "image"]);
});

test("a stream without unanswered frames has no deadline", async (t) => {
  const { stream, states, advance } = await openStream(t, { mode: "all" });
  const answer = stream.send(IMAGE);
  sockets[0].receive({ type: "lanes", seq: 0 });
  await answer;
  await advance(1000);
  assert.deepEqual(states, []);
});

test("a service that does not send the summary is left in time", async (t) => {
  const { stream, advance } = await openStream(t);
  const ended = stream.end();
  await advance(16);
  assert.equal((await ended).frames, 0);
  assert.equal(stream.state, "ended");
});

test("a draining service gets the time that it announced", async (t) => {
  const { states, advance } = await openStream(t);
  sockets[0].receive({ type: "draining", resume_token: "token", deadline_s: 20 });
  await advance(24);
  assert.deepEqual(states, []);
  await advance(2);
  assert.match(states[0], /^reconnecting/);
});

test("pauses grow while the service is gone, and then the stream fails with the reason", async (t) => {
  t.mock.method(Math, "random", () => 1);
  const { stream, states, advance } = await openStream(t, { mode: "all" });
  const frame = failure(stream.send(IMAGE));
  ScriptedSocket.handshake = "refused";
  sockets[0].break(1012, "restarting");
  const attempts = [];
  for (let tenth = 0; tenth < 35; tenth++) {
    await advance(0.1);
    attempts.push(sockets.length);
  }
  assert.equal(states[0], "reconnecting  the service closed the stream with code 1012: restarting");
  // The first one at once, the others 0.1, 0.2, 0.4, 0.8 and 1.6 seconds after the one before.
  const changes = attempts.flatMap((count, tenth) => (count === attempts[tenth - 1] ? [] : [tenth]));
  assert.deepEqual(changes, [0, 1, 3, 7, 15, 31]);
  stream.close();
  assert.equal((await frame).code, "closed");
});

for (const [code, expected] of [[1008, "bad_message"], [1009, "image_too_large"], [4001, "evicted"], [4003, "session_too_old"]]) {
  test(`a close with ${code} ends the stream as ${expected}`, async (t) => {
    const { stream, states } = await openStream(t);
    const errors = [];
    stream.on("error", (error) => errors.push([error.code, error.fatal]));
    sockets[0].break(code);
    await settle();
    assert.equal(stream.state, "failed");
    assert.deepEqual(errors, [[expected, true]]);
    assert.equal((await failure(stream.send(IMAGE))).code, expected);
    assert.equal((await failure(stream.end())).code, expected);
  });
}

for (const code of [1000, 1005, 1006, 1011, 1012, 1013, 4002]) {
  test(`a close with ${code} is followed by a new connection`, async (t) => {
    const { stream, advance } = await openStream(t);
    sockets[0].break(code);
    await advance(0);
    sockets[1].receive({ ...READY, resumed: false });
    await settle();
    assert.equal(stream.state, "open");
    assert.equal(stream.reconnects, 1);
    assert.equal(stream.ready.resumed, false);
  });
}

test("in mode latest nothing is sent while the socket still holds a frame", async (t) => {
  const { stream, advance } = await openStream(t);
  sockets[0].bufferedAmount = 5000;
  const results = [stream.send(IMAGE), stream.send(IMAGE), stream.send(IMAGE)];
  assert.equal(stream.wantsFrame, false);
  await advance(1);
  assert.deepEqual(sockets[0].sent, ["start"]);
  assert.deepEqual(await Promise.all(results.slice(0, 2)), [null, null]);
  sockets[0].bufferedAmount = 0;
  await advance(0.1);
  assert.deepEqual(sockets[0].sent, ["start", "frame", "image"]);
  assert.equal(stream.dropped, 2);
});

test("a restart during a pause does not wait for its end", async (t) => {
  const { stream, advance } = await openStream(t);
  ScriptedSocket.handshake = "refused";
  sockets[0].break();
  await advance(0);
  await advance(0.2);
  const before = sockets.length;
  ScriptedSocket.handshake = "accepted";
  stream.restart({ horizon: 0.4 });
  stream.restart({ horizon: 0.45 });
  await advance(0);
  assert.ok(sockets.length > before);
  sockets.at(-1).receive(READY);
  await settle();
  assert.equal(stream.state, "open");
});

test("nothing follows a close", async (t) => {
  const { stream, states, advance } = await openStream(t);
  const frame = failure(stream.send(IMAGE));
  stream.close();
  stream.close();
  await advance(100);
  assert.equal((await frame).code, "closed");
  assert.equal((await failure(stream.send(IMAGE))).code, "closed");
  assert.deepEqual(states, ["ended  the stream was closed"]);
  assert.equal(sockets.length, 1);
  assert.equal(sockets[0].closed, true);
});

test("a page that may not open a WebSocket gets one clear line at once", async (t) => {
  class Forbidden {
    constructor() {
      throw new DOMException("insecure", "SecurityError");
    }
  }
  const { stream } = newStream(t, { client: { WebSocket: Forbidden } });
  const error = await failure(stream.end());
  assert.equal(error.code, "bad_settings");
  assert.match(error.message, /SecurityError/);
});

test("a handshake that fails although it would be accepted points to a proxy", async (t) => {
  ScriptedSocket.handshake = "refused";
  const fetch = async () => new Response('{"code": "upgrade_required", "message": "m", "hint": "h"}', { status: 426 });
  const { stream } = newStream(t, { client: { fetch, reconnectS: 0 } });
  assert.match((await failure(stream.end())).hint, /proxy/);
});

test("replicas are tried in turn", async (t) => {
  ScriptedSocket.handshake = "refused";
  const { stream, advance } = newStream(t, { client: { urls: ["http://a", "http://b"], reconnectS: 0 } });
  await advance(0);
  const error = await failure(stream.end());
  assert.deepEqual(sockets.map((socket) => socket.url), ["ws://a/v1/stream", "ws://b/v1/stream"]);
  assert.match(error.message, /http:\/\/b can't be reached/);
});

test("iterating returns the lanes until the end, and throws what ended the stream", async (t) => {
  const { stream } = await openStream(t, { mode: "all" });
  const seen = [];
  const reading = (async () => {
    for await (const { seq } of stream) {
      seen.push(seq);
    }
  })();
  await settle();
  void stream.send(IMAGE);
  void stream.send(IMAGE);
  sockets[0].receive({ type: "lanes", seq: 0 });
  sockets[0].receive({ type: "lanes", seq: 1 });
  await settle();
  sockets[0].break(4001, "elsewhere");
  assert.equal((await failure(reading)).code, "evicted");
  assert.deepEqual(seen, [0, 1]);
});

test("a slow reader of mode latest gets the newest lanes", async (t) => {
  const { stream } = await openStream(t);
  const iterator = stream[Symbol.asyncIterator]();
  const first = iterator.next();
  await settle();
  for (let seq = 0; seq < 3; seq++) {
    void stream.send(IMAGE);
    sockets[0].receive({ type: "lanes", seq });
    await settle();
  }
  assert.equal((await first).value.seq, 0);
  assert.equal((await iterator.next()).value.seq, 2);
});

test("a frame with a value that is not valid rejects, and is an event, too", async (t) => {
  const { stream } = await openStream(t, { mode: "all" });
  const errors = [];
  stream.on("error", ({ code, seq, fatal }) => errors.push([code, seq, fatal]));
  assert.equal((await failure(stream.send(IMAGE, { seq: 4, speed: -1 }))).code, "bad_message");
  assert.deepEqual(errors, [["bad_message", 4, false]]);
  assert.deepEqual(sockets[0].sent, ["start"]);
});

test("a stream that has ended can't be restarted", async (t) => {
  const { stream, advance } = await openStream(t);
  const ended = stream.end();
  sockets[0].receive({ type: "summary" });
  await ended;
  stream.restart({ horizon: 0.4 });
  stream.breakConnection();
  await advance(10);
  assert.equal(sockets.length, 1);
  assert.equal(stream.state, "ended");
  assert.equal((await failure(stream.send(IMAGE))).code, "bad_message");
});

test("an answered frame renews the attempts that come without a pause", async (t) => {
  const { stream, advance } = await openStream(t, { mode: "all" });
  for (let seq = 0; seq < 3; seq++) {
    sockets.at(-1).break();
    await advance(0);
    assert.equal(sockets.length, seq + 2);
    sockets.at(-1).receive(READY);
    await settle();
    void stream.send(IMAGE);
    sockets.at(-1).receive({ type: "lanes", seq });
    await settle();
  }
});

test("connections without an answered frame are opened again with pauses", async (t) => {
  const { advance } = await openStream(t);
  sockets[0].break();
  await advance(0);
  sockets[1].receive(READY);
  await settle();
  sockets[1].break();
  await advance(0);
  assert.equal(sockets.length, 2);
  await advance(0.1);
  assert.equal(sockets.length, 3);
});
