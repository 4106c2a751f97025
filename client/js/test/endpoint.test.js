import assert from "node:assert/strict";
import { afterEach, test } from "node:test";
import { LaneClient } from "../dist/index.js";
import { parseEndpoints, refusalError, unreachableError } from "../dist/endpoint.js";

afterEach(() => {
  delete globalThis.document;
  delete globalThis.location;
});

const URLS = [
  ["http://127.0.0.1:8000", "http://127.0.0.1:8000", "ws://127.0.0.1:8000/v1/stream"],
  ["https://lanes.example.com/", "https://lanes.example.com", "wss://lanes.example.com/v1/stream"],
  ["wss://lanes.example.com/v1/stream", "https://lanes.example.com", "wss://lanes.example.com/v1/stream"],
  ["https://example.com/lanes/", "https://example.com/lanes", "wss://example.com/lanes/v1/stream"],
  ["10.0.0.5:8000", "http://10.0.0.5:8000", "ws://10.0.0.5:8000/v1/stream"],
  ["localhost:8000", "http://localhost:8000", "ws://localhost:8000/v1/stream"],
  ["http://[::1]:8000?a=b", "http://[::1]:8000", "ws://[::1]:8000/v1/stream"],
  [new URL("http://a"), "http://a", "ws://a/v1/stream"],
];

for (const [url, http, stream] of URLS) {
  test(`the endpoint at ${url}`, () => {
    assert.deepEqual(parseEndpoints(url), [{ base: http, http, stream }]);
  });
}

test("in a page, a URL may be relative", () => {
  globalThis.document = { baseURI: "https://example.com/app/index.html" };
  assert.equal(parseEndpoints("/lanes")[0].http, "https://example.com/lanes");
});

for (const url of ["", "ftp://a", "http://", "http://user:secret@a", "/lanes", []]) {
  test(`${JSON.stringify(url)} is refused`, () => {
    assert.throws(() => new LaneClient(url), { code: "bad_settings" });
  });
}

test("an error does not show the login in a URL", () => {
  assert.throws(() => parseEndpoints("http://user:secret@a"), (error) => !error.message.includes("secret"));
});

const BAD_OPTIONS = [
  { apiKey: "" },
  { apiKey: "a b" },
  { apiKey: "a/b" },
  { token: "a\n" },
  { apiKey: "a", token: "b" },
  { reconnectS: -1 },
  { reconnectS: "soon" },
  { timeoutS: 0 },
];

for (const options of BAD_OPTIONS) {
  test(`the options ${JSON.stringify(options)} are refused`, () => {
    assert.throws(() => new LaneClient("http://a", options), { code: "bad_settings" });
  });
}

test("a version of Node without WebSocket gets one clear line", (t) => {
  const builtIn = globalThis.WebSocket;
  delete globalThis.WebSocket;
  t.after(() => (globalThis.WebSocket = builtIn));
  assert.throws(() => new LaneClient("http://a"), { code: "bad_settings", message: /no WebSocket/ });
});

const [endpoint] = parseEndpoints("http://a");

test("a refusal is the error that the service sent", () => {
  const error = refusalError(401, '{"code": "unauthorized", "message": "no key", "hint": "send one", "request_id": "3f9a"}', endpoint);
  const { code, message, hint, httpStatus, requestId } = error;
  assert.deepEqual([code, message, hint, httpStatus, requestId], ["unauthorized", "no key", "send one", 401, "3f9a"]);
});

for (const body of ["<html>", "{}", "null", '{"code": 3, "message": "x"}', ""]) {
  test(`a refusal with the body ${body} is from another server`, () => {
    const error = refusalError(404, body, endpoint);
    assert.deepEqual([error.code, error.httpStatus], ["connection_failed", 404]);
  });
}

test("only a page of another origin is asked to check the allowed origins", () => {
  assert.doesNotMatch(unreachableError(endpoint).hint, /ORIGINS/);
  globalThis.location = { origin: "http://a" };
  assert.doesNotMatch(unreachableError(endpoint).hint, /ORIGINS/);
  globalThis.location = { origin: "http://b" };
  assert.match(unreachableError(endpoint).hint, /LANESTREAM_ALLOWED_ORIGINS has http:\/\/b/);
});
