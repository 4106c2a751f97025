import { checkKey, keyHeaders, parseEndpoints, refusalError, unreachableError } from "./endpoint.js";
import { isRetryable, LaneError, timeoutError, timeoutSignal } from "./errors.js";
import { LaneStream } from "./stream.js";
/** A client of a Lanestream service, or of several replicas of one. */
export class LaneClient {
    #endpoints; // the replica that answered last comes first
    #platform;
    #token;
    #reconnectS;
    #timeoutS;
    /** Throws LaneError with the code `bad_settings` if a URL or an option is not valid. */
    constructor(url, options = {}) {
        const { apiKey, token, reconnectS = 30, timeoutS = 30 } = options;
        if (apiKey !== undefined && token !== undefined) {
            throw new LaneError("bad_settings", "both an API key and a token were given", "give either");
        }
        if (!(reconnectS >= 0) || !(timeoutS > 0)) {
            throw new LaneError("bad_settings", "reconnectS or timeoutS is not valid", "give seconds");
        }
        const key = apiKey ?? (typeof token === "function" ? null : token) ?? null;
        if (key !== null) {
            checkKey(key);
        }
        this.#endpoints = parseEndpoints(url);
        this.#token = typeof token === "function" ? token : () => key;
        this.#reconnectS = reconnectS;
        this.#timeoutS = timeoutS;
        this.#platform = platform(options);
    }
    /** Returns the lanes of one image, on its own: a JPEG, PNG or WebP file. Rejects with LaneError. */
    async detect(image, options = {}) {
        const query = detectQuery(options);
        const path = query.size ? `/v1/detect?${query}` : "/v1/detect";
        return this.#request(path, { method: "POST", body: image });
    }
    /** Returns the loaded networks. The first one belongs to the default detector. */
    async models() {
        return this.#request("/v1/models", {});
    }
    /** Opens a stream, in the background. */
    stream(options = {}) {
        const settings = {
            endpoints: [...this.#endpoints],
            platform: this.#platform,
            key: () => this.#key(),
            reconnectS: this.#reconnectS,
            timeoutS: this.#timeoutS,
        };
        return new LaneStream(settings, options);
    }
    /** Returns the first successful answer of a replica. Throws the last replica's error if all fail. */
    async #request(path, init) {
        for (let left = this.#endpoints.length - 1;; left--) {
            const endpoint = this.#endpoints[0];
            try {
                return (await this.#requestFrom(endpoint, path, init));
            }
            catch (error) {
                if (left === 0 || !isRetryable(LaneError.from(error))) {
                    throw error;
                }
                if (this.#endpoints[0] === endpoint) {
                    this.#endpoints.push(...this.#endpoints.splice(0, 1));
                }
            }
        }
    }
    async #requestFrom(endpoint, path, init) {
        const headers = keyHeaders(await this.#key());
        const signal = timeoutSignal(this.#timeoutS);
        let status;
        let body;
        try {
            const response = await this.#platform.fetch(endpoint.http + path, { ...init, headers, signal });
            status = response.status;
            body = await response.text();
        }
        catch {
            throw signal.aborted ? timeoutError(`the request to ${endpoint.base}`, this.#timeoutS) : unreachableError(endpoint);
        }
        if (status !== 200) {
            throw refusalError(status, body, endpoint);
        }
        try {
            return JSON.parse(body);
        }
        catch {
            throw new LaneError("bad_message", `${endpoint.base} sent a response that is not JSON`);
        }
    }
    async #key() {
        let timer;
        const late = new Promise((_, reject) => {
            timer = setTimeout(() => reject(timeoutError("fetching a token", this.#timeoutS)), 1000 * this.#timeoutS);
        });
        try {
            const key = await Promise.race([this.#token(), late]);
            return key === null ? null : checkKey(key);
        }
        catch (error) {
            if (error instanceof LaneError) {
                throw error;
            }
            const hint = "check the function that fetches tokens";
            throw new LaneError("connection_failed", `no token could be fetched: ${String(error)}`, hint);
        }
        finally {
            clearTimeout(timer);
        }
    }
}
function platform(options) {
    const webSocket = options.WebSocket ?? globalThis.WebSocket;
    if (webSocket === undefined) {
        const hint = "use Node 22 or later, or give an implementation in the option WebSocket";
        throw new LaneError("bad_settings", "this version of Node has no WebSocket", hint);
    }
    // In browsers, fetch must not be called as a method of another object.
    return { WebSocket: webSocket, fetch: options.fetch ?? globalThis.fetch.bind(globalThis) };
}
function detectQuery(options) {
    const query = new URLSearchParams();
    const { detector, horizon, camera, kinds } = options;
    if (detector != null) {
        query.set("detector", detector);
    }
    if (horizon != null) {
        query.set("horizon", String(horizon));
    }
    if (camera != null) {
        query.set("camera", JSON.stringify(camera));
    }
    kinds?.forEach((kind) => query.append("kinds", kind));
    return query;
}
