import { LaneError } from "./errors.js";
export var State;
(function (State) {
    State["Disconnected"] = "disconnected";
    State["Open"] = "open";
    State["Ending"] = "ending";
    State["Finished"] = "finished";
})(State || (State = {}));
// In mode `latest`: one that the service processes, and one on its way. More would only make the answers older.
const MOST_IN_FLIGHT_LATEST = 2;
const MOST_SPEED = 150;
const MOST_TIMESTAMP = 1e15;
/**
 * The client's side of a stream without any I/O: decides what to send, and matches the service's messages to frames.
 *
 * A stream outlives its sockets: even if they break, each frame has exactly one outcome, in frame order. After a
 * connection was lost, mode `latest` drops the unanswered frames. Mode `all` sends them again, except those that a
 * resumed session has already processed: their answers are lost.
 */
export class StreamProtocol {
    state = State.Disconnected;
    /** The service's latest answer to `start`. */
    ready = null;
    /** How often the stream was opened again. */
    reconnects = 0;
    /** Whether the service announced over the latest socket that it is about to stop. */
    draining = false;
    #start;
    #clock;
    #startedAt;
    #pending = new Map(); // by number, in ascending order
    #lastSeq = -1;
    #ended = false;
    #counts = { answered: 0, failed: 0, dropped: 0, lost: 0 };
    #outcomes = [];
    constructor(options = {}, clock = () => performance.now() / 1000) {
        this.#start = { type: "start" };
        this.restart(options);
        this.#clock = clock;
        this.#startedAt = clock();
    }
    get mode() {
        return this.#start.mode ?? "latest";
    }
    get lastSeq() {
        return this.#lastSeq < 0 ? null : this.#lastSeq;
    }
    get dropped() {
        return this.#counts.dropped;
    }
    /** Whether a frame added now would be sent at once. */
    get wantsFrame() {
        return this.state === State.Open && !this.draining && !this.#ended && !this.#firstWaiting && this.#hasCredit;
    }
    /** Whether the service owes a message. */
    get expectsMessage() {
        return this.state === State.Ending || this.draining || this.#inFlight > 0;
    }
    get summary() {
        const { answered, failed, dropped, lost } = this.#counts;
        const duration = Math.round(1000 * (this.#clock() - this.#startedAt)) / 1000;
        return { frames: answered + failed + dropped + lost, ...this.#counts, duration_s: duration };
    }
    /** Returns the outcomes of frames since the last call, in frame order. */
    takeOutcomes() {
        const outcomes = this.#outcomes;
        this.#outcomes = [];
        return outcomes;
    }
    /** Returns the first message for a new socket. It resumes the session of the previous socket, if any. */
    startMessage() {
        return JSON.stringify(this.#start);
    }
    /** Handles the service's answer to `start`. Throws the error that it sent, or `bad_message` if it is another one. */
    receiveReady(text) {
        const ready = parse(text);
        if (ready.type === "error") {
            throw LaneError.fromMessage(ready);
        }
        if (ready.type === "draining") {
            throw new LaneError("draining", "the service is about to stop");
        }
        if (ready.type !== "ready") {
            throw new LaneError("bad_message", `the service answered \`start\` with \`${ready.type}\``);
        }
        if (this.ready === null) {
            this.#startedAt = this.#clock();
        }
        else {
            this.reconnects += 1;
        }
        this.ready = ready;
        this.#start.resume_token = ready.resume_token;
        this.state = State.Open;
        this.draining = false;
        const processed = ready.resumed ? (ready.last_seq ?? -1) : -1;
        for (const frame of this.#frames("sent")) {
            if (frame.meta.seq <= processed) {
                this.#settleUnanswered(frame);
            }
            else {
                frame.state = "waiting";
            }
        }
        this.#dropReplaced();
        this.#flush();
        return ready;
    }
    /** Changes options of `start` for the next socket. Those that are undefined return to their defaults. */
    restart(options) {
        Object.assign(this.#start, options);
        this.#dropReplaced();
        this.#flush();
    }
    /** Adds a frame and returns its number. Throws `bad_message` if a value is not valid or no more frames may follow. */
    add(data, meta = {}) {
        if (this.#ended || this.state === State.Finished) {
            throw new LaneError("bad_message", "the stream has ended, so it takes no more frames");
        }
        const seq = meta.seq ?? this.#lastSeq + 1;
        checkMeta(meta, seq, this.#lastSeq);
        this.#lastSeq = seq;
        this.#pending.set(seq, { data, meta: { ...meta, seq }, state: "waiting", result: null });
        this.#dropReplaced();
        this.#flush();
        return seq;
    }
    /** Records that no more frames follow. */
    end() {
        this.#ended = true;
        if (this.state === State.Disconnected && this.ready !== null) {
            this.#finishIfDone();
        }
    }
    /** Returns the messages to send now: those of one frame, `end`, or none until something changes. */
    messagesToSend() {
        if (this.state !== State.Open || this.draining) {
            return [];
        }
        this.#rejectOversized();
        const frame = this.#firstWaiting;
        if (frame === undefined) {
            if (!this.#ended) {
                return [];
            }
            this.state = State.Ending;
            return [JSON.stringify({ type: "end" })];
        }
        if (!this.#hasCredit) {
            return [];
        }
        frame.state = "sent";
        return [JSON.stringify({ type: "frame", ...frame.meta }), frame.data];
    }
    /**
     * Handles a message after `ready` and returns it. Throws the error that the service sent if it ends the stream or is
     * not about a frame, and `bad_message` if the message is not valid here.
     */
    receive(text) {
        const message = parse(text);
        switch (message.type) {
            case "lanes":
                this.#settle(message.seq, message);
                break;
            case "error":
                this.#receiveError(LaneError.fromMessage(message));
                break;
            case "draining":
                this.draining = true;
                this.#start.resume_token = message.resume_token ?? this.#start.resume_token ?? null;
                break;
            case "summary":
                this.#receiveSummary(message);
                break;
            case "ready":
                throw unexpected(message.type);
            default: // `warning`, and what a later version may add
        }
        return message;
    }
    /** Handles the loss of the socket. The stream has finished if no more frames follow and every frame has its outcome. */
    connectionLost() {
        if (this.state === State.Finished) {
            return;
        }
        this.state = State.Disconnected;
        if (this.mode === "latest") {
            for (const frame of this.#frames("sent")) {
                this.#settleUnanswered(frame);
            }
            this.#flush();
        }
        if (this.ready !== null) {
            this.#finishIfDone();
        }
    }
    /** Finishes the stream. `error` becomes the outcome of all frames that have none yet. */
    giveUp(error) {
        for (const frame of this.#pending.values()) {
            if (frame.state !== "settled") {
                this.#counts.lost += 1;
                frame.state = "settled";
                frame.result = error;
            }
        }
        this.#flush();
        this.state = State.Finished;
    }
    *#frames(state) {
        for (const frame of this.#pending.values()) {
            if (frame.state === state) {
                yield frame;
            }
        }
    }
    get #firstWaiting() {
        return this.#frames("waiting").next().value ?? undefined;
    }
    get #inFlight() {
        return [...this.#frames("sent")].length;
    }
    get #hasCredit() {
        const credits = this.ready?.limits.credits ?? 0;
        return this.#inFlight < (this.mode === "latest" ? Math.min(credits, MOST_IN_FLIGHT_LATEST) : credits);
    }
    /** In mode `latest` only the newest frame waits. */
    #dropReplaced() {
        if (this.mode === "latest") {
            for (const frame of [...this.#frames("waiting")].slice(0, -1)) {
                this.#settleUnanswered(frame);
            }
        }
    }
    /** Fails frames with more bytes than the service accepts. To send one would end the stream. */
    #rejectOversized() {
        const limit = this.ready?.limits.max_bytes ?? Infinity;
        for (const frame of this.#frames("waiting")) {
            const size = frame.data instanceof Blob ? frame.data.size : frame.data.byteLength;
            if (size <= limit) {
                break;
            }
            const problem = `the image has ${size} bytes; the service accepts ${limit}`;
            this.#fail(frame, new LaneError("image_too_large", problem, "send a smaller one", { seq: frame.meta.seq }));
        }
        this.#flush();
    }
    #receiveError(error) {
        if (error.fatal || error.seq === null) {
            throw error;
        }
        if (error.code === "draining") {
            this.#returnToQueue(error.seq);
        }
        else {
            this.#settle(error.seq, error);
        }
    }
    /** Handles a frame that a draining service refused: mode `all` sends it again, mode `latest` drops it. */
    #returnToQueue(seq) {
        this.draining = true;
        const frame = this.#sentFrame(seq);
        this.#settleBefore(seq);
        if (this.mode === "all") {
            frame.state = "waiting";
        }
        else {
            this.#settleUnanswered(frame);
        }
        this.#flush();
    }
    #receiveSummary(message) {
        if (this.state !== State.Ending) {
            throw unexpected(message.type);
        }
        this.#settleBefore(this.#lastSeq + 1);
        this.#flush();
        this.state = State.Finished;
    }
    #settle(seq, result) {
        const frame = this.#sentFrame(seq);
        this.#settleBefore(seq);
        if (result instanceof LaneError) {
            this.#fail(frame, result);
        }
        else {
            this.#counts.answered += 1;
            frame.state = "settled";
            frame.result = result;
        }
        this.#flush();
    }
    /** Settles the frames before `seq`: the service answers in order, so they get no answer any more. */
    #settleBefore(seq) {
        for (const frame of this.#frames("sent")) {
            if (frame.meta.seq < seq) {
                this.#settleUnanswered(frame);
            }
        }
    }
    #settleUnanswered(frame) {
        frame.state = "settled";
        if (this.mode === "latest") {
            this.#counts.dropped += 1;
            return;
        }
        this.#counts.lost += 1;
        const problem = "the answer to this frame was lost with the connection";
        frame.result = new LaneError("lost", problem, "the session has processed the frame", { seq: frame.meta.seq });
    }
    #fail(frame, error) {
        this.#counts.failed += 1;
        frame.state = "settled";
        frame.result = error;
    }
    #sentFrame(seq) {
        const frame = this.#pending.get(seq);
        if (frame?.state !== "sent") {
            throw new LaneError("bad_message", `the service answered frame ${seq}, which was not sent`);
        }
        return frame;
    }
    /** Reports the outcomes of settled frames, as far as all frames before them are settled. */
    #flush() {
        for (const [seq, frame] of this.#pending) {
            if (frame.state !== "settled") {
                return;
            }
            this.#pending.delete(seq);
            this.#outcomes.push({ seq, result: frame.result });
        }
    }
    #finishIfDone() {
        if (this.#ended && this.#pending.size === 0) {
            this.state = State.Finished;
        }
    }
}
/** Throws `bad_message` if the service would refuse these values. It would count the image under another number. */
function checkMeta(meta, seq, lastSeq) {
    const problem = (name, value, accepted) => new LaneError("bad_message", `the ${name} of a frame is ${String(value)}`, accepted, { seq });
    if (!Number.isSafeInteger(seq) || seq <= lastSeq) {
        throw problem("number", seq, `frame numbers are integers that rise; the last one was ${lastSeq}`);
    }
    const { timestamp = 0, speed = 0, indicator = "off" } = meta;
    if (!(Math.abs(timestamp) <= MOST_TIMESTAMP)) {
        throw problem("timestamp", timestamp, "give the capture time in seconds");
    }
    if (!(speed >= 0 && speed <= MOST_SPEED)) {
        throw problem("speed", speed, `give a speed of 0 to ${MOST_SPEED} m/s`);
    }
    if (!["off", "left", "right"].includes(indicator)) {
        throw problem("indicator", indicator, "off, left and right are accepted");
    }
}
function parse(text) {
    let message;
    try {
        message = JSON.parse(text);
    }
    catch {
        message = null;
    }
    if (typeof message !== "object" || message === null || typeof message.type !== "string") {
        throw new LaneError("bad_message", "the service sent a message that is not a JSON object with a type");
    }
    return message;
}
function unexpected(type) {
    return new LaneError("bad_message", `the service sent \`${type}\` in the middle of the stream`);
}
