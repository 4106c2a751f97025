import { Connection } from "./connection.js";
import { Emitter } from "./emitter.js";
import { LaneError } from "./errors.js";
import { FailoverPolicy } from "./failover.js";
import { State, StreamProtocol } from "./protocol.js";
// How long `ready` may take after a fast handshake: the service may first have to fetch the session from its store.
const READY_S = 5;
// Browsers don't show pings. A peer that owes an answer for this long is taken for gone.
const ANSWER_S = 15;
// Sockets have no event for when their buffer has been sent.
const BUFFER_POLL_MS = 10;
/** A stream of one camera's frames. It connects by itself, and reconnects when its connection is lost. */
export class LaneStream extends Emitter {
    #settings;
    #protocol;
    #failover;
    #pending = new Map();
    #finished;
    #connection = null;
    #abort = new AbortController();
    #closed = false;
    #state = "connecting";
    #failure = null;
    #bufferTimer;
    #drainS = 0;
    constructor(settings, options = {}) {
        super();
        this.#settings = settings;
        this.#protocol = new StreamProtocol(options);
        this.#failover = new FailoverPolicy(settings.endpoints.length, settings.reconnectS, settings.timeoutS);
        // Listeners that are added right after the constructor must not miss a thing.
        this.#finished = Promise.resolve().then(() => this.#run());
        this.#finished.catch(() => { });
    }
    /** The service's latest answer to `start`; null before the first. */
    get ready() {
        return this.#protocol.ready;
    }
    get state() {
        return this.#state;
    }
    /** How many frames were dropped because newer ones replaced them, or because their connection was lost. */
    get dropped() {
        return this.#protocol.dropped;
    }
    /** How often the stream was opened again. */
    get reconnects() {
        return this.#protocol.reconnects;
    }
    /** The number of the newest frame; null before the first. */
    get lastSeq() {
        return this.#protocol.lastSeq;
    }
    /** Whether a frame would be sent at once. Cameras skip frames otherwise. */
    get wantsFrame() {
        return this.#protocol.wantsFrame && this.#canSend;
    }
    /**
     * Sends a frame. Returns its lanes; null if it was dropped in mode `latest`. In mode `all` it waits for a credit, and
     * is sent again if the connection is lost. Rejects with the frame's LaneError, which is also an `error` event, so that
     * the result may be ignored.
     */
    send(image, meta = {}) {
        const result = new Promise((resolve, reject) => {
            if (this.#failure !== null) {
                throw this.#failure;
            }
            this.#pending.set(this.#add(image, meta), { resolve, reject });
            this.#update();
        });
        result.catch(() => { });
        return result;
    }
    /** Opens the stream again with changed options. The session and its track ids continue. */
    restart(options) {
        this.#protocol.restart(options);
        this.#disconnect();
        this.#abort.abort(new LaneError("restarted", "the stream was restarted with other options"));
    }
    /** Closes the socket without a word, as a lost network would. The stream reconnects and resumes its session. */
    breakConnection() {
        const connection = this.#connection;
        this.#disconnect();
        connection?.close(new LaneError("connection_failed", "the connection was broken on purpose"));
    }
    /** Sends no more frames. Returns the counts of the stream once every frame is settled. */
    end() {
        this.#protocol.end();
        this.#update();
        return this.#finished;
    }
    /** Ends the stream at once. Frames without a result reject with the code `closed`. */
    close() {
        this.#closed = true;
        this.#abort.abort(new LaneError("closed", "the stream was closed"));
    }
    /** Iterates over the lanes of the frames, in their order. In mode `latest` a slow reader gets the newest ones only. */
    async *[Symbol.asyncIterator]() {
        const unread = [];
        let wake = () => { };
        const stop = this.on("lanes", (lanes) => {
            if (this.#protocol.mode === "latest") {
                unread.length = 0;
            }
            unread.push(lanes);
            wake();
        });
        let ended = false;
        void this.#finished.catch(() => { }).then(() => {
            ended = true;
            wake();
        });
        try {
            for (;;) {
                const lanes = unread.shift();
                if (lanes !== undefined) {
                    yield lanes;
                }
                else if (ended) {
                    break;
                }
                else {
                    await new Promise((resolve) => (wake = resolve));
                }
            }
        }
        finally {
            stop();
        }
        if (this.#state === "failed") {
            throw this.#failure;
        }
    }
    async #run() {
        for (;;) {
            let failure;
            try {
                await this.#serveConnection();
                break;
            }
            catch (error) {
                failure = LaneError.from(error);
            }
            const pause = this.#pauseAfter(failure);
            if (pause === null) {
                throw this.#fail(failure);
            }
            this.#disconnect();
            if (this.#protocol.state === State.Finished) {
                break;
            }
            this.#setState(this.ready === null ? "connecting" : "reconnecting", failure.message);
            await this.#sleep(pause);
        }
        this.#failure ??= new LaneError("bad_message", "the stream has ended, so it takes no more frames");
        this.#setState("ended", "");
        return this.#protocol.summary;
    }
    /** Receives messages until the stream has finished. Throws LaneError when the connection fails. */
    async #serveConnection() {
        const { endpoints, platform, timeoutS } = this.#settings;
        const signal = this.#abort.signal;
        const attemptS = this.#failover.attemptS;
        const endpoint = endpoints[this.#failover.index];
        const key = await this.#key(signal);
        const connection = await Connection.open(endpoint, key, platform, attemptS, signal);
        this.#connection = connection;
        try {
            connection.send(this.#protocol.startMessage());
            connection.expectMessageWithin(Math.min(timeoutS, Math.max(attemptS, READY_S)));
            this.#opened(await connection.receive());
            while (this.#protocol.state !== State.Finished) {
                this.#receive(await connection.receive());
            }
        }
        finally {
            connection.close();
            clearTimeout(this.#bufferTimer);
        }
    }
    #opened(text) {
        const first = this.ready === null;
        const ready = this.#protocol.receiveReady(text);
        this.#failover.connected();
        this.emit("ready", ready);
        this.#setState("open", "", first ? null : ready.resumed);
        this.#settle();
        this.#update();
    }
    #receive(text) {
        const message = this.#protocol.receive(text);
        if (message.type === "warning") {
            this.emit("warning", message);
        }
        else if (message.type === "draining") {
            this.#drainS = message.deadline_s;
            this.emit("draining", message);
        }
        if (this.#settle()) {
            this.#failover.progressed();
        }
        this.#update();
    }
    get #canSend() {
        // In mode `all`, credits bound what waits in the socket.
        return this.#connection !== null && (this.#protocol.mode === "all" || this.#connection.bufferedAmount === 0);
    }
    #add(image, meta) {
        try {
            return this.#protocol.add(image, meta);
        }
        catch (error) {
            this.emit("error", LaneError.from(error));
            throw error;
        }
    }
    /** Sends what can be sent now, and reports the outcomes of frames. */
    #update() {
        const connection = this.#connection;
        if (connection !== null) {
            while (this.#canSend) {
                const messages = this.#protocol.messagesToSend();
                if (messages.length === 0) {
                    break;
                }
                messages.forEach((message) => connection.send(message));
            }
            clearTimeout(this.#bufferTimer);
            if (!this.#canSend) {
                this.#bufferTimer = setTimeout(() => this.#update(), BUFFER_POLL_MS);
            }
            if (this.#protocol.expectsMessage && this.#protocol.state !== State.Disconnected) {
                connection.expectMessageWithin(this.#protocol.draining ? this.#drainS + READY_S : ANSWER_S);
            }
        }
        this.#settle();
    }
    /** Reports the outcomes of frames. Returns whether there are any. */
    #settle() {
        const outcomes = this.#protocol.takeOutcomes();
        for (const { seq, result } of outcomes) {
            const pending = this.#pending.get(seq);
            this.#pending.delete(seq);
            if (result instanceof LaneError) {
                pending?.reject(result);
                if (result !== this.#failure) {
                    this.emit("error", result);
                }
            }
            else {
                pending?.resolve(result);
                if (result !== null) {
                    this.emit("lanes", result);
                }
            }
        }
        return outcomes.length > 0;
    }
    /** Returns the seconds until the next attempt, or null if the stream should give up. A restart is not a failure. */
    #pauseAfter(failure) {
        if (this.#closed) {
            return null;
        }
        if (this.#abort.signal.aborted) {
            this.#abort = new AbortController();
            return 0;
        }
        return this.#failover.pauseAfter(failure, this.#protocol.draining);
    }
    #fail(failure) {
        const closed = this.#closed;
        this.#failure = (closed ? new LaneError("closed", "the stream was closed") : failure).asFatal();
        this.#protocol.giveUp(this.#failure);
        this.#settle();
        this.#setState(closed ? "ended" : "failed", this.#failure.message);
        if (!closed) {
            this.emit("error", this.#failure);
        }
        return this.#failure;
    }
    /** Sends nothing more over the present socket. */
    #disconnect() {
        this.#connection = null;
        this.#protocol.connectionLost();
        this.#settle();
    }
    #setState(state, reason, resumed = null) {
        this.#state = state;
        this.emit("state", { state, resumed, reason });
    }
    /** Returns the key or token within the time of a request, and throws LaneError if it can't be had. */
    async #key(signal) {
        return until(this.#settings.key(), signal);
    }
    async #sleep(seconds) {
        const signal = this.#abort.signal;
        let timer;
        const pause = new Promise((resolve) => (timer = setTimeout(resolve, 1000 * seconds)));
        // What interrupts the pause ends the next connection before it is opened.
        await until(pause, signal).catch(() => clearTimeout(timer));
    }
}
/** Returns what `promise` resolves to. Throws the reason of `signal` when it is aborted. */
function until(promise, signal) {
    return new Promise((resolve, reject) => {
        const abort = () => reject(signal.reason);
        if (signal.aborted) {
            abort();
            return;
        }
        signal.addEventListener("abort", abort, { once: true });
        promise.then(resolve, reject).finally(() => signal.removeEventListener("abort", abort));
    });
}
