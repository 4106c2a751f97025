import { Connection, type Platform } from "./connection.js";
import { Emitter } from "./emitter.js";
import type { Endpoint } from "./endpoint.js";
import { LaneError } from "./errors.js";
import { FailoverPolicy } from "./failover.js";
import type { DrainingMessage, LanesMessage, ReadyMessage, WarningMessage } from "./messages.js";
import { type FrameMeta, type ImageFile, State, StreamProtocol, type StreamOptions, type Summary } from "./protocol.js";

export type StreamState = "connecting" | "open" | "reconnecting" | "ended" | "failed";

/**
 * A change of the state. After a reconnect, `resumed` says whether the session continues; if it is false, the session
 * is new and track ids start again. `resumed` is null in all other states. `reason` is for people, and may be empty.
 */
export interface StateChange {
  state: StreamState;
  resumed: boolean | null;
  reason: string;
}

export interface StreamEvents {
  ready: ReadyMessage;
  lanes: LanesMessage;
  error: LaneError;
  warning: WarningMessage;
  state: StateChange;
  draining: DrainingMessage;
}

/** What a stream needs from its client. */
export interface StreamSettings {
  readonly endpoints: readonly Endpoint[];
  readonly platform: Platform;
  readonly key: () => Promise<string | null>;
  readonly reconnectS: number;
  readonly timeoutS: number;
}

// How long `ready` may take after a fast handshake: the service may first have to fetch the session from its store.
const READY_S = 5;
// Browsers don't show pings. A peer that owes an answer for this long is taken for gone.
const ANSWER_S = 15;
// Sockets have no event for when their buffer has been sent.
const BUFFER_POLL_MS = 10;

interface Pending {
  readonly resolve: (lanes: LanesMessage | null) => void;
  readonly reject: (error: LaneError) => void;
}

/** A stream of one camera's frames. It connects by itself, and reconnects when its connection is lost. */
export class LaneStream extends Emitter<StreamEvents> {
  readonly #settings: StreamSettings;
  readonly #protocol: StreamProtocol;
  readonly #failover: FailoverPolicy;
  readonly #pending = new Map<number, Pending>();
  readonly #finished: Promise<Summary>;
  #connection: Connection | null = null;
  #abort = new AbortController();
  #closed = false;
  #state: StreamState = "connecting";
  #failure: LaneError | null = null;
  #bufferTimer: ReturnType<typeof setTimeout> | undefined;
  #drainS = 0;

  constructor(settings: StreamSettings, options: StreamOptions = {}) {
    super();
    this.#settings = settings;
    this.#protocol = new StreamProtocol(options);
    this.#failover = new FailoverPolicy(settings.endpoints.length, settings.reconnectS, settings.timeoutS);
    // Listeners that are added right after the constructor must not miss a thing.
    this.#finished = Promise.resolve().then(() => this.#run());
    this.#finished.catch(() => {});
  }

  /** The service's latest answer to `start`; null before the first. */
  get ready(): ReadyMessage | null {
    return this.#protocol.ready;
  }

  get state(): StreamState {
    return this.#state;
  }

  /** How many frames were dropped because newer ones replaced them, or because their connection was lost. */
  get dropped(): number {
    return this.#protocol.dropped;
  }

  /** How often the stream was opened again. */
  get reconnects(): number {
    return this.#protocol.reconnects;
  }

  /** The number of the newest frame; null before the first. */
  get lastSeq(): number | null {
    return this.#protocol.lastSeq;
  }

  /** Whether a frame would be sent at once. Cameras skip frames otherwise. */
  get wantsFrame(): boolean {
    return this.#protocol.wantsFrame && this.#canSend;
  }

  /**
   * Sends a frame. Returns its lanes; null if it was dropped in mode `latest`. In mode `all` it waits for a credit, and
   * is sent again if the connection is lost. Rejects with the frame's LaneError, which is also an `error` event, so that
   * the result may be ignored.
   */
  send(image: ImageFile, meta: FrameMeta = {}): Promise<LanesMessage | null> {
    const result = new Promise<LanesMessage | null>((resolve, reject) => {
      if (this.#failure !== null) {
        throw this.#failure;
      }
      this.#pending.set(this.#add(image, meta), { resolve, reject });
      this.#update();
    });
    result.catch(() => {});
    return result;
  }

  /** Opens the stream again with changed options. The session and its track ids continue. */
  restart(options: Partial<StreamOptions>): void {
    this.#protocol.restart(options);
    this.#disconnect();
    this.#abort.abort(new LaneError("restarted", "the stream was restarted with other options"));
  }

  /** Closes the socket without a word, as a lost network would. The stream reconnects and resumes its session. */
  breakConnection(): void {
    const connection = this.#connection;
    this.#disconnect();
    connection?.close(new LaneError("connection_failed", "the connection was broken on purpose"));
  }

  /** Sends no more frames. Returns the counts of the stream once every frame is settled. */
  end(): Promise<Summary> {
    this.#protocol.end();
    this.#update();
    return this.#finished;
  }

  /** Ends the stream at once. Frames without a result reject with the code `closed`. */
  close(): void {
    this.#closed = true;
    this.#abort.abort(new LaneError("closed", "the stream was closed"));
  }

  /** Iterates over the lanes of the frames, in their order. In mode `latest` a slow reader gets the newest ones only. */
  async *[Symbol.asyncIterator](): AsyncGenerator<LanesMessage, void> {
    const unread: LanesMessage[] = [];
    let wake = (): void => {};
    const stop = this.on("lanes", (lanes) => {
      if (this.#protocol.mode === "latest") {
        unread.length = 0;
      }
      unread.push(lanes);
      wake();
    });
    let ended = false;
    void this.#finished.catch(() => {}).then(() => {
      ended = true;
      wake();
    });
    try {
      for (;;) {
        const lanes = unread.shift();
        if (lanes !== undefined) {
          yield lanes;
        } else if (ended) {
          break;
        } else {
          await new Promise<void>((resolve) => (wake = resolve));
        }
      }
    } finally {
      stop();
    }
    if (this.#state === "failed") {
      throw this.#failure;
    }
  }

  async #run(): Promise<Summary> {
    for (;;) {
      let failure: LaneError;
      try {
        await this.#serveConnection();
        break;
      } catch (error) {
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
  async #serveConnection(): Promise<void> {
    const { endpoints, platform, timeoutS } = this.#settings;
    const signal = this.#abort.signal;
    const attemptS = this.#failover.attemptS;
    const endpoint = endpoints[this.#failover.index] as Endpoint;
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
    } finally {
      connection.close();
      clearTimeout(this.#bufferTimer);
    }
  }

  #opened(text: string): void {
    const first = this.ready === null;
    const ready = this.#protocol.receiveReady(text);
    this.#failover.connected();
    this.emit("ready", ready);
    this.#setState("open", "", first ? null : ready.resumed);
    this.#settle();
    this.#update();
  }

  #receive(text: string): void {
    const message = this.#protocol.receive(text);
    if (message.type === "warning") {
      this.emit("warning", message);
    } else if (message.type === "draining") {
      this.#drainS = message.deadline_s;
      this.emit("draining", message);
    }
    if (this.#settle()) {
      this.#failover.progressed();
    }
    this.#update();
  }

  get #canSend(): boolean {
    // In mode `all`, credits bound what waits in the socket.
    return this.#connection !== null && (this.#protocol.mode === "all" || this.#connection.bufferedAmount === 0);
  }

  #add(image: ImageFile, meta: FrameMeta): number {
    try {
      return this.#protocol.add(image, meta);
    } catch (error) {
      this.emit("error", LaneError.from(error));
      throw error;
    }
  }

  /** Sends what can be sent now, and reports the outcomes of frames. */
  #update(): void {
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
  #settle(): boolean {
    const outcomes = this.#protocol.takeOutcomes();
    for (const { seq, result } of outcomes) {
      const pending = this.#pending.get(seq);
      this.#pending.delete(seq);
      if (result instanceof LaneError) {
        pending?.reject(result);
        if (result !== this.#failure) {
          this.emit("error", result);
        }
      } else {
        pending?.resolve(result);
        if (result !== null) {
          this.emit("lanes", result);
        }
      }
    }
    return outcomes.length > 0;
  }

  /** Returns the seconds until the next attempt, or null if the stream should give up. A restart is not a failure. */
  #pauseAfter(failure: LaneError): number | null {
    if (this.#closed) {
      return null;
    }
    if (this.#abort.signal.aborted) {
      this.#abort = new AbortController();
      return 0;
    }
    return this.#failover.pauseAfter(failure, this.#protocol.draining);
  }

  #fail(failure: LaneError): LaneError {
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
  #disconnect(): void {
    this.#connection = null;
    this.#protocol.connectionLost();
    this.#settle();
  }

  #setState(state: StreamState, reason: string, resumed: boolean | null = null): void {
    this.#state = state;
    this.emit("state", { state, resumed, reason });
  }

  /** Returns the key or token within the time of a request, and throws LaneError if it can't be had. */
  async #key(signal: AbortSignal): Promise<string | null> {
    return until(this.#settings.key(), signal);
  }

  async #sleep(seconds: number): Promise<void> {
    const signal = this.#abort.signal;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const pause = new Promise<void>((resolve) => (timer = setTimeout(resolve, 1000 * seconds)));
    // What interrupts the pause ends the next connection before it is opened.
    await until(pause, signal).catch(() => clearTimeout(timer));
  }
}

/** Returns what `promise` resolves to. Throws the reason of `signal` when it is aborted. */
function until<Value>(promise: Promise<Value>, signal: AbortSignal): Promise<Value> {
  return new Promise((resolve, reject) => {
    const abort = (): void => reject(signal.reason);
    if (signal.aborted) {
      abort();
      return;
    }
    signal.addEventListener("abort", abort, { once: true });
    promise.then(resolve, reject).finally(() => signal.removeEventListener("abort", abort));
  });
}
