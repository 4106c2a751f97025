/** The live page: connects a source, the streams of its detectors, and what shows their answers. */

import { Access } from "./access.js";
import { drawMap } from "./birds-eye.js";
import { Capture } from "./capture.js";
import { LaneClient } from "./client/index.js";
import { CodeView, copyText } from "./code-view.js";
import { showConnection } from "./connection.js";
import { listenForDrops } from "./drop.js";
import { LatencyView } from "./latency.js";
import { Notices, eventNotice, returnNotice } from "./notices.js";
import { Problem, explain } from "./problems.js";
import { Readings } from "./readings.js";
import { Recordings, download, downloadLink, nameNow } from "./recording.js";
import { LiveSession } from "./session.js";
import { SettingsForm } from "./settings-form.js";
import { DEMO_CAMERA, hashFromSettings, settingsFromHash, streamOptions } from "./settings.js";
import { listenForShortcuts } from "./shortcuts.js";
import { restoreTheme, toggleTheme } from "./theme.js";

/**
 * @typedef {import("./capture.js").SourceKind} SourceKind
 * @typedef {import("./session.js").LanePane} LanePane
 * @typedef {import("./client/index.js").LaneError} LaneError
 */

const BASE = new URL(".", location.href);
// A page that nobody closes waits for its service for an hour.
const RECONNECT_S = 3600;
const SAME_ERROR_MS = 5000;
const BOTH = /** @type {("candidates" | "regression")[]} */ (["candidates", "regression"]);

/**
 * @template {HTMLElement} Kind
 * @param {string} id
 * @returns {Kind}
 */
function element(id) {
  return /** @type {Kind} */ (document.getElementById(id));
}

class LivePage {
  #root = element("live");
  #notices = new Notices(document);
  #latency = new LatencyView(document);
  #readings = new Readings(document);
  #access = new Access(BASE, element("access"));
  #form = new SettingsForm(element("settings"), settingsFromHash(location.hash), {
    onChange: () => this.#applySettings(),
    onHorizon: (horizon) => this.#previewHorizon(horizon),
  });
  /** @type {Capture | null} */
  #capture = null;
  /** @type {LiveSession | null} */
  #session = null;
  #recordings = new Recordings();
  #code = new CodeView();
  #isPaused = false;
  #drawn = 0;
  /** @type {Map<string, number>} when each kind of error was shown last */
  #shownErrors = new Map();

  constructor() {
    this.#wire();
    this.#show();
    void this.#offerDetectors();
    drawMap(element("map"), [], () => 0);
  }

  /** The camera in use: that of the settings, or of the demo clip. */
  get #camera() {
    const chosen = this.#form.settings.camera;
    if (chosen !== undefined) return chosen;
    return this.#capture?.kind === "demo" ? DEMO_CAMERA : null;
  }

  /** The options of `start` for each stream. */
  get #options() {
    const { settings } = this.#form;
    const detectors = settings.detector === "both" ? BOTH : [settings.detector];
    return detectors.map((detector) => streamOptions(settings, this.#camera, detector));
  }

  /**
   * Starts a source in the place of the present one.
   * @param {SourceKind} kind
   * @param {string | File | null} video
   */
  async start(kind, video = null) {
    await this.stop();
    this.#notices.clearProblem();
    const capture = new Capture(kind, {
      onFrame: (frame) => (this.#session ? this.#session.send(frame) : frame.picture.close()),
      onEnd: (problem) => void this.#ended(capture, problem),
    });
    this.#capture = capture;
    this.#show();
    try {
      await capture.open(video);
    } catch (error) {
      if (this.#capture !== capture) return;
      this.#capture = null;
      this.#notices.problem(error instanceof Problem ? error.line : String(error));
      this.#show();
      return;
    }
    if (this.#capture === capture) this.#connect();
  }

  async stop() {
    await this.#stopRecording();
    this.#session?.close();
    this.#capture?.close();
    this.#session = null;
    this.#capture = null;
    this.#isPaused = false;
    this.#readings.clear();
    drawMap(element("map"), [], () => 0);
    this.#show();
  }

  togglePause() {
    if (this.#capture === null) return;
    this.#isPaused = !this.#isPaused;
    this.#show();
  }

  breakConnection() {
    if (this.#session === null) return;
    this.#notices.log("You have broken the connection");
    this.#session.breakConnection();
  }

  snapshot() {
    const pane = this.#session?.panes[0];
    if (!pane?.frame) return;
    pane.canvas.toBlob((blob) => blob && download({ name: `${nameNow()}.png`, blob }), "image/png");
  }

  async toggleRecording() {
    if (this.#recordings.areRunning) {
      await this.#stopRecording();
    } else if (!Recordings.areSupported) {
      this.#notices.problem(
        new Problem("This browser can't record", "Use a current Chrome, Edge, Firefox or Safari").line,
      );
    } else {
      this.#recordings.start(this.#session?.panes.filter((pane) => pane.frame !== null) ?? []);
      this.#show();
    }
  }

  async #stopRecording() {
    if (!this.#recordings.areRunning) return;
    const files = await this.#recordings.stop();
    const area = element("downloads");
    for (const link of area.querySelectorAll("a")) URL.revokeObjectURL(link.href);
    area.replaceChildren("Recorded: ", ...files.map(downloadLink));
    area.hidden = false;
    this.#show();
  }

  #connect() {
    this.#session?.close();
    const client = new LaneClient(BASE, {
      reconnectS: RECONNECT_S,
      ...(this.#access.token ? { token: this.#access.token } : {}),
    });
    const session = new LiveSession(client, this.#options, {
      onDrawn: (pane, stages, drawn) => this.#session === session && this.#showAnswer(pane, stages, drawn),
      onState: () => this.#session === session && this.#show(),
      onReturn: (pane, back) =>
        this.#session === session && pane === session.panes[0] && this.#notices.show(...returnNotice(back)),
      onError: (_, error) => this.#session === session && void this.#failed(error),
      onRoom: (hasRoom) => this.#session === session && this.#capture && (this.#capture.hasRoom = hasRoom),
      onPlan: () => this.#session === session && this.#capture && (this.#capture.plan = session.pacing.plan),
    });
    this.#session = session;
    this.#latency.reset();
    const panes = element("panes");
    panes.dataset.count = String(session.panes.length);
    panes.replaceChildren(
      ...session.panes.map((pane, index) => {
        const figure = document.createElement("figure");
        const caption = document.createElement("figcaption");
        caption.textContent = String(this.#options[index].detector ?? "");
        caption.hidden = session.panes.length === 1;
        figure.append(pane.canvas, caption);
        return figure;
      }),
    );
    if (this.#capture) this.#capture.plan = session.pacing.plan;
    this.#show();
  }

  /**
   * @param {Capture} capture
   * @param {Problem | null} problem
   */
  async #ended(capture, problem) {
    if (this.#capture !== capture) return;
    await this.stop();
    if (problem !== null) this.#notices.problem(problem.line);
  }

  /** @param {LaneError} error */
  async #failed(error) {
    if (!error.fatal) {
      const now = performance.now();
      if (now - (this.#shownErrors.get(error.code) ?? -Infinity) < SAME_ERROR_MS) return;
      this.#shownErrors.set(error.code, now);
      this.#notices.log(explain(error), "caution");
      return;
    }
    if (error.code === "unauthorized") {
      this.#session?.close();
      const reason =
        this.#access.token === null ? "" : "The token has expired or is not valid any more. Enter the key again.";
      const hasToken = await this.#access.ask(reason);
      this.#show();
      if (hasToken && this.#capture) {
        this.#connect();
        return;
      }
    }
    await this.stop();
    this.#notices.problem(explain(error));
  }

  #applySettings() {
    const hash = hashFromSettings(this.#form.settings);
    if (hash !== location.hash)
      history.replaceState(null, "", hash === "" ? location.pathname + location.search : hash);
    const options = this.#options;
    if (this.#session !== null) {
      if (options.length === this.#session.panes.length) this.#session.restart(options);
      else void this.#stopRecording().then(() => this.#connect());
    }
    this.#show();
  }

  /** @param {number | null} horizon */
  #previewHorizon(horizon) {
    for (const pane of this.#session?.panes ?? []) {
      pane.horizon = horizon;
      pane.redraw();
    }
  }

  /**
   * @param {LanePane} pane
   * @param {import("./latency.js").Stages} stages
   * @param {number} drawn
   */
  #showAnswer(pane, stages, drawn) {
    const answer = /** @type {import("./client/index.js").LanesMessage} */ (pane.answer);
    const frame = /** @type {import("./capture.js").CapturedFrame} */ (pane.frame);
    this.#recordings.add(pane);
    if (this.#session?.panes.length === 2) {
      const caption = pane.canvas.nextElementSibling;
      const text = `${pane.ready?.detector} · ${answer.timing_ms.total.toFixed(0)} ms in the service`;
      if (caption) caption.textContent = text;
    }
    if (pane !== this.#session?.panes[0]) return;
    if (/** @type {HTMLButtonElement} */ (element("snapshot")).disabled) this.#show();
    this.#drawn += 1;
    this.#readings.show(answer);
    drawMap(element("map"), answer.lanes, pane.unseen);
    element("stage").dataset.departure = answer.departure?.state === "none" ? "" : (answer.departure?.side ?? "");
    for (const event of answer.events) this.#notices.show(...eventNotice(event));
    const isFresh = this.#latency.add(stages, drawn, answer.dropped);
    this.#root.dataset.drawn = String(this.#drawn);
    if (!isFresh) return;
    const { fps, median, p95, dropped } = this.#latency.summary;
    Object.assign(this.#root.dataset, { fps: fps.toFixed(1), median: median.toFixed(1), p95: p95.toFixed(1), dropped });
    element("sent").textContent =
      `Sent as ${frame.width} × ${frame.height} JPEG, ${Math.round(frame.blob.size / 1000)} KB` +
      ` to ${pane.ready?.model ?? "the service"} on ${pane.ready?.provider ?? "?"}.`;
  }

  /** Shows the state of everything but the answers. */
  #show() {
    const worst = this.#worstPane;
    const isRunning = this.#capture !== null;
    const hasPicture = this.#session?.panes[0].frame != null;
    const state = worst?.state ?? (isRunning ? "opening" : "idle");
    if (this.#capture) this.#capture.paused = this.#isPaused || state !== "open";
    Object.assign(this.#root.dataset, {
      source: this.#capture?.kind ?? "",
      state: this.#isPaused && state === "open" ? "paused" : state,
      session: worst?.resumed == null ? "" : worst.resumed ? "resumed" : "new",
    });
    element("welcome").hidden = isRunning;
    element("panes").hidden = !isRunning;
    showConnection(element("connection"), worst);
    for (const button of document.querySelectorAll(".toolbar [data-source]")) {
      const isChosen = button.getAttribute("data-source") === this.#capture?.kind;
      button.setAttribute("aria-pressed", String(isChosen));
    }
    for (const id of ["pause", "stop", "break"]) /** @type {HTMLButtonElement} */ (element(id)).disabled = !isRunning;
    for (const id of ["snapshot", "record"]) /** @type {HTMLButtonElement} */ (element(id)).disabled = !hasPicture;
    element("pause").textContent = this.#isPaused ? "Resume" : "Pause";
    element("record").textContent = this.#recordings.areRunning ? "Stop recording" : "Record";
    element("record").setAttribute("aria-pressed", String(this.#recordings.areRunning));
    if (!isRunning) element("stage").dataset.departure = "";
    this.#form.camera = this.#camera;
    element("map-hint").hidden = Boolean(this.#camera);
    const { settings } = this.#form;
    const [{ detector = null }] = this.#options;
    this.#code.show({ url: BASE.href, needsKey: this.#access.needsKey, detector, settings, camera: this.#camera });
  }

  /** The pane with the worst connection, which stands for all. */
  get #worstPane() {
    const order = ["failed", "ended", "reconnecting", "connecting", "open"];
    const panes = this.#session?.panes ?? [];
    return panes.toSorted((a, b) => order.indexOf(a.state) - order.indexOf(b.state))[0] ?? null;
  }

  /** Asks which detectors the service has, which everyone may know. */
  async #offerDetectors() {
    try {
      const response = await fetch(new URL("readyz", BASE));
      if (!response.ok) return;
      const { networks } = await response.json();
      this.#form.offer(networks.map((/** @type {{detector: string}} */ network) => network.detector));
    } catch {
      // A service that can't be reached now offers all; connecting will say more.
    }
  }

  /** @param {SourceKind} kind */
  #choose(kind) {
    if (kind === "file") element("file").click();
    else void this.start(kind, kind === "demo" ? new URL("demo.webm", import.meta.url).href : null);
  }

  #wire() {
    for (const button of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll("button[data-source]"))) {
      button.addEventListener("click", () => this.#choose(/** @type {SourceKind} */ (button.dataset.source)));
    }
    const file = /** @type {HTMLInputElement} */ (element("file"));
    file.addEventListener("change", () => {
      const [video] = file.files ?? [];
      file.value = "";
      if (video) void this.start("file", video);
    });
    /** @type {Record<string, () => void>} */
    const actions = {
      "start-demo": () => this.#choose("demo"),
      pause: () => this.togglePause(),
      stop: () => void this.stop(),
      snapshot: () => this.snapshot(),
      record: () => void this.toggleRecording(),
      break: () => this.breakConnection(),
      theme: toggleTheme,
      "help-open": () => /** @type {HTMLDialogElement} */ (element("help")).showModal(),
      reset: () => this.#form.reset(),
      copy: () => void copyText(this.#code.text, element("copy")),
      "copy-link": () => void copyText(location.href, element("copy-link")),
    };
    for (const [id, action] of Object.entries(actions)) element(id).addEventListener("click", action);
    listenForShortcuts({
      d: actions["start-demo"],
      c: () => this.#choose("camera"),
      f: () => this.#choose("file"),
      " ": actions.pause,
      s: actions.snapshot,
      r: actions.record,
      b: actions.break,
      t: actions.theme,
      escape: actions.stop,
      "?": actions["help-open"],
    });
    listenForDrops(element("drop-hint"), (video) => void this.start("file", video));
    addEventListener("hashchange", () => this.#form.replace(settingsFromHash(location.hash)));
    addEventListener("resize", () => {
      const pane = this.#session?.panes[0];
      drawMap(element("map"), pane?.answer?.lanes ?? [], pane?.unseen ?? (() => 0));
    });
  }
}

restoreTheme();
new LivePage();
