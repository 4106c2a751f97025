/** Tells the visitor what happens: short banners over the picture, and a log below it. */

/** @typedef {import("./client/index.js").LanesMessage["events"][number]} LaneEvent */

const BANNER_MS = 3500;
const MOST_BANNERS = 3;
const MOST_ENTRIES = 30;

export class Notices {
  #banners;
  #alerts;
  #log;
  #isEmpty = true;

  /** @param {ParentNode} root */
  constructor(root) {
    this.#banners = /** @type {HTMLElement} */ (root.querySelector("#banners"));
    this.#alerts = /** @type {HTMLElement} */ (root.querySelector("#alerts"));
    this.#log = /** @type {HTMLElement} */ (root.querySelector("#log"));
  }

  /**
   * Shows a banner for a moment, and keeps it in the log.
   * @param {string} text
   * @param {"info" | "good" | "caution" | "alert"} level
   */
  show(text, level = "info") {
    const area = level === "alert" || level === "caution" ? this.#alerts : this.#banners;
    const banner = document.createElement("p");
    banner.textContent = text;
    banner.dataset.level = level;
    area.append(banner);
    while (area.children.length > MOST_BANNERS) area.firstElementChild?.remove();
    setTimeout(() => banner.remove(), BANNER_MS);
    this.log(text, level);
  }

  /**
   * Shows a problem until it is dismissed or another follows.
   * @param {string} text
   */
  problem(text) {
    this.clearProblem();
    const banner = document.createElement("p");
    banner.dataset.level = "problem";
    banner.textContent = text;
    const close = document.createElement("button");
    close.type = "button";
    close.textContent = "×";
    close.setAttribute("aria-label", "Dismiss");
    close.addEventListener("click", () => banner.remove());
    banner.append(close);
    this.#alerts.append(banner);
    this.log(text, "alert");
  }

  clearProblem() {
    this.#alerts.querySelector('[data-level="problem"]')?.remove();
  }

  /**
   * @param {string} text
   * @param {string} level
   */
  log(text, level = "info") {
    if (this.#isEmpty) this.#log.replaceChildren();
    this.#isEmpty = false;
    const entry = document.createElement("li");
    entry.dataset.level = level;
    const time = document.createElement("time");
    time.textContent = new Date().toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
    entry.append(time, text);
    this.#log.prepend(entry);
    while (this.#log.children.length > MOST_ENTRIES) this.#log.lastElementChild?.remove();
  }
}

/**
 * Returns what an event of a frame means to a driver, and how urgent it is.
 * @param {LaneEvent} event
 * @returns {[string, "info" | "good" | "caution" | "alert"]}
 */
export function eventNotice(event) {
  switch (event.type) {
    case "lane_change":
      return [`Lane change to the ${event.direction}`, "info"];
    case "departure":
      return event.state === "warning"
        ? [`Lane departure to the ${event.side}`, "caution"]
        : [`Line ${event.track_id} crossed on the ${event.side}`, "alert"];
    case "scene_cut":
      return ["Another scene: all ids are new", "info"];
    case "calibration_changed":
      return ["The camera points in another direction", "info"];
    default:
      return ["Something this page does not know has happened", "info"];
  }
}

/**
 * Returns what became of a session whose connection was lost.
 * @param {import("./session.js").Return} back
 * @returns {[string, "good" | "caution"]}
 */
export function returnNotice({ resumed, seconds, kept }) {
  const after = `Back after ${seconds.toFixed(1)} s`;
  if (!resumed) return [`${after} in a new session: ids start again`, "caution"];
  if (kept.length === 0) return [`${after} in the same session`, "good"];
  if (kept.length === 1) return [`${after}: line ${kept[0]} kept its id`, "good"];
  return [`${after}: lines ${kept.slice(0, -1).join(", ")} and ${kept.at(-1)} kept their ids`, "good"];
}
