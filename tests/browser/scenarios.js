// What the tests do with the JavaScript client, in a page and in Node alike. Each function gets the library in `lib`, and
// images in `frames`. `report(value)` lets the test know how far it is; what it returns is what the test asserts.

const sleep = (seconds) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
const ids = (lanes) => lanes.lanes.map((lane) => lane.track_id).sort();

const describe = (error) => {
  const { code, message, hint, seq, fatal, httpStatus } = error;
  return { code, message, hint, seq, fatal, httpStatus };
};

/** Returns the lanes of a promise as [seq, ids], or null, or the code of its error. */
const outcome = (result) => result.then((lanes) => lanes && [lanes.seq, ids(lanes)], (error) => error.code);

function watch(stream) {
  const events = { states: [], errors: [], answers: [] };
  stream.on("state", ({ state, resumed, reason }) => events.states.push([state, resumed, reason]));
  stream.on("error", (error) => events.errors.push(describe(error)));
  stream.on("lanes", ({ seq }) => events.answers.push(seq));
  return events;
}

export async function detect({ lib, frames, url, options }) {
  const client = new lib.LaneClient(url, options);
  const image = new Blob([frames[0]]);
  const all = await client.detect(image, { horizon: 0.4, camera: { height: 1.4, field_of_view: 60 } });
  const edges = await client.detect(frames[0], { kinds: ["road_edge"], detector: "candidates" });
  const refused = await client.detect(new Uint8Array([1, 2, 3])).catch(describe);
  const wrong = await client.detect(frames[0], { horizon: 3 }).catch(describe);
  const { models } = await client.models();
  const [lane] = all.lanes;
  const [bottom] = lib.lanePoints(lane, { from: lane.line.bottom[1], to: lane.line.top[1] });
  return { all, edges, refused, wrong, detectors: models.map(({ detector }) => detector), bottom };
}

/** Sends all frames `rounds` times at once in mode `all`. Breaks the connection after the answers to `breakAfter`. */
export async function streamAll({ lib, frames, url, count, breakAfter = [], junk = [] }) {
  const stream = new lib.LaneClient(url).stream({ mode: "all", session: "test" });
  const events = watch(stream);
  stream.on("lanes", ({ seq }) => breakAfter.includes(seq) && stream.breakConnection());
  const images = Array.from({ length: count }, (_, seq) => {
    const turn = Math.floor(seq / frames.length) % 2;
    const index = seq % frames.length;
    return junk.includes(seq) ? new Uint8Array(100) : frames[turn ? frames.length - 1 - index : index];
  });
  const outcomes = await Promise.all(images.map((image, seq) => outcome(stream.send(image, { timestamp: seq / 25 }))));
  const summary = await stream.end();
  const { reconnects, lastSeq, state, dropped } = stream;
  return { outcomes, summary, reconnects, lastSeq, state, dropped, ...events };
}

/** Sends frames in mode `latest` faster than the service answers, and reads the answers by iterating. */
export async function streamLatest({ lib, frames, url }) {
  const stream = new lib.LaneClient(url).stream();
  const read = [];
  const reading = (async () => {
    for await (const { seq } of stream) {
      read.push(seq);
    }
  })();
  const outcomes = frames.map((image, seq) => outcome(stream.send(image, { timestamp: seq / 25 })));
  await stream.send(frames[0], { timestamp: frames.length / 25 });
  for (const [seq, image] of frames.entries()) {
    outcomes.push(outcome(stream.send(image, { timestamp: (frames.length + 1 + seq) / 25 })));
    await sleep(0.004);
  }
  const summary = await stream.end();
  await reading;
  return { outcomes: await Promise.all(outcomes), summary, read, dropped: stream.dropped, ready: stream.ready };
}

/** Sends frames one after another until the test says `stop`, and reports each answer and each state. */
export async function streamUntilStopped({ lib, frames, url, options, mode, stopped, report }) {
  const stream = new lib.LaneClient(url, options).stream({ mode });
  const events = watch(stream);
  stream.on("state", ({ state, resumed }) => report([state, resumed]));
  stream.on("draining", () => report("draining"));
  const outcomes = [];
  for (let seq = 0; !(await stopped()) && stream.state !== "failed"; seq++) {
    const index = seq % (2 * frames.length);
    const image = frames[index < frames.length ? index : 2 * frames.length - 1 - index];
    outcomes.push(await outcome(stream.send(image, { timestamp: seq / 25 })));
    report("answer");
    if (mode === "latest") {
      await sleep(0.01);
    }
  }
  const summary = await stream.end().catch(describe);
  return { outcomes, summary, ready: stream.ready, reconnects: stream.reconnects, ...events };
}

/** Opens a stream that is expected to fail, and returns why. */
export async function fail({ lib, frames, url, options, start }) {
  const client = new lib.LaneClient(url, options);
  const stream = client.stream(start);
  const events = watch(stream);
  const frame = await stream.send(frames[0]).catch(describe);
  const end = await stream.end().catch(describe);
  const detect = await client.detect(frames[0]).catch(describe);
  return { frame, end, detect, state: stream.state, ...events };
}

/** Streams with tokens that a function returns. */
export async function streamWithTokens({ lib, frames, url, tokens }) {
  const used = [];
  const token = async () => {
    used.push(tokens[used.length]);
    return used.at(-1);
  };
  const stream = new lib.LaneClient(url, { token }).stream({ mode: "all" });
  const events = watch(stream);
  const first = await outcome(stream.send(frames[0], { timestamp: 0 }));
  stream.breakConnection();
  const second = await outcome(stream.send(frames[1], { timestamp: 0.04 }));
  await stream.end();
  return { first, second, used: used.length, ...events };
}

/** Takes the session of a stream over with another socket. */
export async function evict({ lib, frames, url }) {
  const client = new lib.LaneClient(url);
  const stream = client.stream({ mode: "all" });
  const events = watch(stream);
  const first = await outcome(stream.send(frames[0], { timestamp: 0 }));
  const other = new WebSocket(`${url.replace("http", "ws")}/v1/stream`, ["lanestream.v1"]);
  await new Promise((resolve) => (other.onopen = resolve));
  const answer = new Promise((resolve) => (other.onmessage = ({ data }) => resolve(JSON.parse(data))));
  other.send(JSON.stringify({ type: "start", resume_token: stream.ready.resume_token }));
  const { resumed } = await answer;
  const failed = await outcome(stream.send(frames[1]));
  await sleep(0.5); // in which a stream would reconnect
  other.close();
  return { first, resumed, failed, reconnects: stream.reconnects, state: stream.state, ...events };
}

/** Restarts a stream with other options, while frames are on their way. */
export async function restart({ lib, frames, url }) {
  const stream = new lib.LaneClient(url).stream({ mode: "all" });
  const events = watch(stream);
  const horizons = [];
  stream.on("lanes", ({ horizon, height }) => horizons.push(horizon / height));
  const send = (seq) => outcome(stream.send(frames[seq], { timestamp: seq / 25 }));
  const before = await Promise.all(frames.slice(0, 20).map((_, seq) => send(seq)));
  const inFlight = send(20);
  stream.restart({ horizon: 0.25, detector: "candidates" });
  const after = [await inFlight, await send(21)];
  await stream.end();
  return { before, after, horizons, detector: stream.ready.detector, ...events };
}

/** Opens a stream whose `start` is not valid. */
export async function badStart({ lib, url }) {
  const stream = new lib.LaneClient(url).stream({ horizon: 7 });
  return { end: await stream.end().catch(describe), state: stream.state };
}
