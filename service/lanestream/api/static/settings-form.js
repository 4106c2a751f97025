/** The form with the settings of the streams. */

import { DEMO_CAMERA, defaultSettings } from "./settings.js";

/** @typedef {import("./settings.js").Settings} Settings */

// A slider that moves changes the streams only when it rests for this long.
const REST_MS = 250;
const FIRST_HORIZON = 0.45;

/**
 * @typedef {object} FormListener
 * @property {(settings: Settings) => void} onChange
 * @property {(horizon: number | null) => void} onHorizon the horizon slider moves; null when it rests
 */

export class SettingsForm {
  settings;
  #form;
  #listener;
  /** @type {Settings["camera"]} the one in use */
  #camera = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #resting;

  /**
   * @param {HTMLFormElement} form
   * @param {Settings} settings
   * @param {FormListener} listener
   */
  constructor(form, settings, listener) {
    this.#form = form;
    this.settings = settings;
    this.#listener = listener;
    form.addEventListener("input", ({ target }) => this.#edited(/** @type {HTMLInputElement} */ (target)));
    form.addEventListener("submit", (event) => event.preventDefault());
    this.#show();
  }

  /**
   * Shows the camera that is in use.
   * @param {Settings["camera"]} camera
   */
  set camera(camera) {
    this.#camera = camera;
    this.#show();
  }

  /**
   * Offers only the detectors that the service has; the first one is its default.
   * @param {string[]} detectors
   */
  offer(detectors) {
    for (const radio of /** @type {NodeListOf<HTMLInputElement>} */ (this.#form.querySelectorAll("[name=detector]"))) {
      radio.disabled = radio.value === "both" ? detectors.length < 2 : !detectors.includes(radio.value);
    }
    this.defaultDetector = detectors[0] ?? "candidates";
    this.#show();
  }

  defaultDetector = "candidates";

  /** @param {Settings} settings */
  replace(settings) {
    this.settings = settings;
    this.#show();
    this.#listener.onChange(settings);
  }

  reset() {
    this.replace(defaultSettings());
  }

  /** @param {HTMLInputElement} input */
  #edited(input) {
    const settings = { ...this.settings };
    switch (input.name) {
      case "detector":
        settings.detector = /** @type {any} */ (input.value);
        break;
      case "marking":
      case "road_edge": {
        const both = /** @type {const} */ (["marking", "road_edge"]);
        const kinds = both.filter((kind) => this.#input(kind).checked);
        // At least one kind is reported.
        const [first = input.name === "marking" ? "road_edge" : "marking", ...others] = kinds;
        settings.kinds = [first, ...others];
        break;
      }
      case "horizon_auto":
        settings.horizon = input.checked ? null : this.#input("horizon").valueAsNumber;
        break;
      case "horizon":
        settings.horizon = input.valueAsNumber;
        this.#listener.onHorizon(settings.horizon);
        break;
      case "camera":
        settings.camera = input.checked ? this.#sliders() : null;
        break;
      default:
        settings.camera = this.#sliders();
    }
    this.settings = settings;
    if (settings.camera !== undefined) this.#camera = settings.camera;
    this.#show();
    clearTimeout(this.#resting);
    this.#resting = setTimeout(() => this.#rested(), input.type === "range" ? REST_MS : 0);
  }

  #rested() {
    this.#listener.onHorizon(null);
    this.#listener.onChange(this.settings);
  }

  #sliders() {
    return { height: this.#input("height").valueAsNumber, fov: this.#input("fov").valueAsNumber };
  }

  #show() {
    const { detector, kinds, horizon } = this.settings;
    for (const radio of /** @type {NodeListOf<HTMLInputElement>} */ (this.#form.querySelectorAll("[name=detector]"))) {
      radio.checked = radio.value === (detector ?? this.defaultDetector);
    }
    this.#input("marking").checked = kinds?.includes("marking") ?? true;
    this.#input("road_edge").checked = kinds?.includes("road_edge") ?? true;
    this.#input("horizon_auto").checked = horizon === null;
    this.#slide("horizon", horizon ?? FIRST_HORIZON, horizon === null ? "auto" : `${(100 * horizon).toFixed(1)} %`);
    this.#input("camera").checked = Boolean(this.#camera);
    const { height, fov } = this.#camera ?? this.settings.camera ?? DEMO_CAMERA;
    this.#slide("height", height, `${height.toFixed(2)} m`);
    this.#slide("fov", fov, `${fov.toFixed(0)}°`);
    for (const name of ["height", "fov"]) this.#input(name).dataset.off = String(!this.#camera);
    this.#input("horizon").dataset.off = String(horizon === null);
  }

  /**
   * @param {string} name
   * @param {number} value
   * @param {string} text
   */
  #slide(name, value, text) {
    const input = this.#input(name);
    if (input !== document.activeElement || input.valueAsNumber !== value) input.value = String(value);
    input.setAttribute("aria-valuetext", text);
    const output = input.parentElement?.querySelector("output");
    if (output) output.value = text;
  }

  /** @param {string} name */
  #input(name) {
    return /** @type {HTMLInputElement} */ (this.#form.elements.namedItem(name));
  }
}
