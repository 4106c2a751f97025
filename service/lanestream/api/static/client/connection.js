import { keyHeaders, pageOrigin, refusalError, unreachableError } from "./endpoint.js";
import { LaneError, timeoutError, timeoutSignal } from "./errors.js";
const SUBPROTOCOL = "lanestream.v1";
const KEY_SUBPROTOCOL = "bearer.";
const UPGRADE_REQUIRED = 426;
// The error for a close code if no message explained it. Other codes mean a lost connection.
const CLOSE_CODES = {
    1002: "bad_message",
    1003: "bad_message",
    1007: "bad_message",
    1008: "bad_message",
    1009: "image_too_large",
    4001: "evicted",
    4002: "idle",
    4003: "session_too_old",
};
/** One WebSocket: its messages can be awaited, and every failure is a LaneError that says what happened. */
export class Connection {
    #socket;
    #received = [];
    #failure = null;
    #waiting = null;
    #deadline;
    #signal;
    #aborted = () => this.#fail(LaneError.from(this.#signal.reason));
    constructor(socket, signal) {
        this.#socket = socket;
        this.#signal = signal;
        socket.onmessage = ({ data }) => this.#receive(data);
        socket.onclose = ({ code, reason }) => this.#fail(closedError(code, reason));
        socket.onerror = ignore;
        signal.addEventListener("abort", this.#aborted);
    }
    /**
     * Opens a WebSocket within `timeoutS` seconds. Throws LaneError with the reason if that fails, and the reason of
     * `signal` when it is aborted, which also ends an open connection.
     */
    static async open(endpoint, key, platform, timeoutS, signal) {
        signal.throwIfAborted();
        const subprotocols = key === null ? [SUBPROTOCOL] : [SUBPROTOCOL, KEY_SUBPROTOCOL + key];
        const socket = createSocket(endpoint, subprotocols, platform);
        const outcome = await opened(socket, timeoutS, signal);
        if (outcome === "opened") {
            return new Connection(socket, signal);
        }
        abandon(socket);
        signal.throwIfAborted();
        if (outcome === "timed out") {
            throw timeoutError(`connecting to ${endpoint.base}`, timeoutS);
        }
        throw await refusalReason(endpoint, key, platform, timeoutS, signal);
    }
    /** How many bytes wait to be sent. */
    get bufferedAmount() {
        return this.#socket.bufferedAmount;
    }
    send(message) {
        this.#socket.send(message);
    }
    /** Returns the next message. Throws LaneError when the connection is lost. */
    receive() {
        const text = this.#received.shift();
        if (text !== undefined) {
            return Promise.resolve(text);
        }
        if (this.#failure !== null) {
            return Promise.reject(this.#failure);
        }
        return new Promise((resolve, reject) => {
            this.#waiting = { resolve, reject };
        });
    }
    /** Fails the connection unless a message arrives within `seconds` of the first call since the previous message. */
    expectMessageWithin(seconds) {
        if (this.#failure === null) {
            const error = timeoutError("the answer of the service", seconds);
            this.#deadline ??= setTimeout(() => this.#fail(error), 1000 * seconds);
        }
    }
    /** Closes the connection, without waiting for the service. `receive` throws `reason` then. */
    close(reason = new LaneError("closed", "the connection was closed")) {
        this.#fail(reason);
    }
    #receive(data) {
        clearTimeout(this.#deadline);
        this.#deadline = undefined;
        if (typeof data !== "string") {
            this.#fail(new LaneError("bad_message", "the service sent a binary message; only text messages are expected"));
            return;
        }
        const waiting = this.#waiting;
        this.#waiting = null;
        if (waiting === null) {
            this.#received.push(data);
        }
        else {
            waiting.resolve(data);
        }
    }
    #fail(error) {
        if (this.#failure !== null) {
            return;
        }
        this.#failure = error;
        clearTimeout(this.#deadline);
        this.#signal.removeEventListener("abort", this.#aborted);
        abandon(this.#socket);
        this.#waiting?.reject(error);
        this.#waiting = null;
    }
}
function createSocket(endpoint, subprotocols, platform) {
    try {
        return new platform.WebSocket(endpoint.stream, subprotocols);
    }
    catch (error) {
        const hint = "a page that was loaded over https can only use a service with https";
        throw new LaneError("bad_settings", `no WebSocket to ${endpoint.base} can be created: ${String(error)}`, hint);
    }
}
/** Waits until a socket is open, closed or late. */
function opened(socket, timeoutS, signal) {
    return new Promise((resolve) => {
        const timer = setTimeout(() => settle("timed out"), 1000 * timeoutS);
        const abort = () => settle("aborted");
        const settle = (outcome) => {
            clearTimeout(timer);
            signal.removeEventListener("abort", abort);
            resolve(outcome);
        };
        signal.addEventListener("abort", abort);
        socket.onopen = () => settle("opened");
        socket.onclose = () => settle("closed");
        // Some implementations report only an error if the handshake fails.
        socket.onerror = () => settle("closed");
    });
}
/** Closes a socket whose events no longer matter. The peer may be gone, so its reply is not awaited. */
function abandon(socket) {
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.onerror = ignore;
    socket.close();
}
/** Handles the error events of a socket: outside of browsers, those that nobody handles may end the process. */
function ignore() { }
/** Asks over HTTP why a handshake failed: browsers do not say. */
async function refusalReason(endpoint, key, platform, timeoutS, signal) {
    // Browsers name the origin of the page only in requests to other origins.
    const origin = pageOrigin();
    const query = origin === null ? "" : `?origin=${encodeURIComponent(origin)}`;
    const deadline = AbortSignal.any([signal, timeoutSignal(timeoutS)]);
    const request = { headers: keyHeaders(key), signal: deadline, cache: "no-store" };
    try {
        const response = await platform.fetch(`${endpoint.http}/v1/stream${query}`, request);
        const body = await response.text();
        if (response.status !== UPGRADE_REQUIRED) {
            return refusalError(response.status, body, endpoint);
        }
    }
    catch {
        return signal.aborted ? LaneError.from(signal.reason) : unreachableError(endpoint);
    }
    const hint = "a proxy between them may not pass WebSockets on";
    return new LaneError("connection_failed", `no WebSocket to ${endpoint.base} could be opened`, hint);
}
function closedError(code, reason) {
    if (code === 1005 || code === 1006) {
        return new LaneError("connection_failed", "the connection to the service broke");
    }
    const why = reason ? `: ${reason}` : "";
    return new LaneError(CLOSE_CODES[code] ?? "connection_failed", `the service closed the stream with code ${code}${why}`);
}
