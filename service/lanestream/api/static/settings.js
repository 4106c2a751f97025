/** What the visitor has chosen. It is kept in the hash of the page's address, which browsers send to no server. */

/**
 * @typedef {object} Settings
 * @property {"candidates" | "regression" | "both" | null} detector null for the service's default
 * @property {[Kind, ...Kind[]] | null} kinds null for the service's setting
 * @property {number | null} horizon as a fraction of the picture's height; null to estimate it
 * @property {{height: number, fov: number} | null | undefined} camera meters and degrees; null for none, undefined for
 *   that of the source, if it is known
 * @typedef {"marking" | "road_edge"} Kind
 */

/** The camera of the demo clip: tools/demo_clip.py renders it with these values. */
export const DEMO_CAMERA = Object.freeze({ height: 1.4, fov: 60 });

const DETECTORS = ["candidates", "regression", "both"];
const KINDS = ["marking", "road_edge"];
const RANGES = { horizon: [-0.6, 0.99], height: [0.3, 4], fov: [20, 150] };

/** @returns {Settings} */
export function defaultSettings() {
  return { detector: null, kinds: null, horizon: null, camera: undefined };
}

/**
 * Reads settings from the hash of an address. What is missing or not valid keeps its default.
 * @param {string} hash
 * @returns {Settings}
 */
export function settingsFromHash(hash) {
  const fields = new URLSearchParams(hash.replace(/^#/, ""));
  const settings = defaultSettings();
  const detector = fields.get("detector");
  if (detector !== null && DETECTORS.includes(detector)) settings.detector = /** @type {any} */ (detector);
  const kinds = (fields.get("kinds") ?? "").split(",").filter((kind) => KINDS.includes(kind));
  if (kinds.length > 0) settings.kinds = /** @type {any} */ (kinds);
  settings.horizon = numberIn(fields.get("horizon"), RANGES.horizon);
  const height = numberIn(fields.get("height"), RANGES.height);
  const fov = numberIn(fields.get("fov"), RANGES.fov);
  if (height !== null && fov !== null) settings.camera = { height, fov };
  else if (fields.get("camera") === "none") settings.camera = null;
  return settings;
}

/**
 * Returns the hash that reproduces settings; empty if all have their defaults.
 * @param {Settings} settings
 */
export function hashFromSettings(settings) {
  const fields = new URLSearchParams();
  if (settings.detector !== null) fields.set("detector", settings.detector);
  if (settings.kinds !== null) fields.set("kinds", settings.kinds.join(","));
  if (settings.horizon !== null) fields.set("horizon", String(settings.horizon));
  if (settings.camera === null) fields.set("camera", "none");
  if (settings.camera) {
    fields.set("height", String(settings.camera.height));
    fields.set("fov", String(settings.camera.fov));
  }
  const text = fields.toString().replaceAll("%2C", ",");
  return text === "" ? "" : `#${text}`;
}

/**
 * Returns the options of `start` for a stream with these settings. Those that are undefined have their defaults.
 * @param {Settings} settings
 * @param {Settings["camera"]} camera the one in use
 * @param {"candidates" | "regression" | null} detector the stream's own
 * @returns {import("./client/index.js").StreamOptions}
 */
export function streamOptions(settings, camera, detector) {
  return {
    detector: detector ?? undefined,
    kinds: settings.kinds ?? undefined,
    horizon: settings.horizon ?? undefined,
    camera: camera ? { height: camera.height, field_of_view: camera.fov } : undefined,
  };
}

/**
 * @param {string | null} text
 * @param {number[]} range
 */
function numberIn(text, [low, high]) {
  const value = text === null || text.trim() === "" ? NaN : Number(text);
  return value >= low && value <= high ? value : null;
}
