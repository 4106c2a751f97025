import { LaneError } from "./errors.js";
import type { Problem } from "./messages.js";

/** Where one replica of the service is: `base` for people, `http` for requests, `stream` for WebSockets. */
export interface Endpoint {
  readonly base: string;
  readonly http: string;
  readonly stream: string;
}

const URL_HINT = "use a URL such as http://127.0.0.1:8000";
const HTTP_SCHEMES: Readonly<Record<string, string>> = { "http:": "http:", "https:": "https:", "ws:": "http:", "wss:": "https:" };
// The characters of a subprotocol, which carries the key: RFC 9110, section 5.6.2.
const KEY = /^[!#$%&'*+\-.^_`|~0-9A-Za-z]{1,512}$/;

/** Returns the endpoints at these URLs: http, https, ws or wss, with or without a path before `/v1`. Throws LaneError. */
export function parseEndpoints(url: string | URL | readonly (string | URL)[]): Endpoint[] {
  const urls = Array.isArray(url) ? url : [url];
  if (urls.length === 0) {
    throw new LaneError("bad_settings", "no service URL was given", URL_HINT);
  }
  return urls.map(parseEndpoint);
}

function parseEndpoint(url: string | URL): Endpoint {
  const text = String(url).trim();
  const absolute = /^([./]|[a-z]+:\/\/)/i.test(text) ? text : `http://${text}`;
  let parts: URL;
  try {
    // In a page, a URL may be relative to it.
    parts = new URL(absolute, globalThis.document?.baseURI);
  } catch {
    throw new LaneError("bad_settings", `${JSON.stringify(text)} is not a valid service URL`, URL_HINT);
  }
  const scheme = HTTP_SCHEMES[parts.protocol];
  if (scheme === undefined || parts.username || parts.password) {
    const problem = scheme === undefined ? `has the scheme ${parts.protocol}` : "has a login, which can't be sent";
    throw new LaneError("bad_settings", `the service URL ${problem}`, URL_HINT);
  }
  const path = parts.pathname.replace(/\/(v1\/stream)?$/, "");
  const http = `${scheme}//${parts.host}${path}`;
  return { base: http, http, stream: `${http.replace(/^http/, "ws")}/v1/stream` };
}

/** Returns `key` if it can be sent. Throws LaneError otherwise. */
export function checkKey(key: string): string {
  if (typeof key !== "string" || !KEY.test(key)) {
    const hint = "a key or token is 1 to 512 letters, digits or other ASCII characters without spaces, quotes and slashes";
    throw new LaneError("bad_settings", "the API key or token can't be sent", hint);
  }
  return key;
}

/** Returns the headers that carry a key. */
export function keyHeaders(key: string | null): Record<string, string> {
  return key === null ? {} : { Authorization: `Bearer ${key}` };
}

/** Returns the error in an unsuccessful response, or a `connection_failed` if it is not from Lanestream. */
export function refusalError(status: number, body: string, endpoint: Endpoint): LaneError {
  try {
    const problem = JSON.parse(body) as Partial<Problem & { detail: string }>;
    const message = problem.message ?? problem.detail;
    if (typeof problem.code === "string" && typeof message === "string") {
      const details = { httpStatus: status, requestId: problem.request_id ?? null };
      return new LaneError(problem.code, message, String(problem.hint ?? ""), details);
    }
  } catch {
    // Another server answered.
  }
  const hint = "check that a Lanestream service runs at this URL";
  return new LaneError("connection_failed", `${endpoint.base} answered with status ${status}`, hint, { httpStatus: status });
}

/** Returns the origin of the page that this runs in; null outside of pages. */
export function pageOrigin(): string | null {
  return globalThis.location?.origin ?? null;
}

/** Returns the error for a request without a response. Browsers do not say why. */
export function unreachableError(endpoint: Endpoint): LaneError {
  const page = pageOrigin();
  const hint =
    page === null || new URL(endpoint.http).origin === page
      ? "check the URL, and that the service runs"
      : `check the URL, that the service runs, and that its setting LANESTREAM_ALLOWED_ORIGINS has ${page}`;
  return new LaneError("connection_failed", `the service at ${endpoint.base} can't be reached`, hint);
}
