/** The code at the bottom of the page, a tab for each language. */

import { snippet } from "./snippets.js";

/** @typedef {import("./snippets.js").Language} Language */

const LANGUAGES = /** @type {const} */ (["curl", "python", "javascript"]);
const COPIED_MS = 1500;

export class CodeView {
  #tabs = LANGUAGES.map((language) => /** @type {HTMLElement} */ (document.getElementById(`tab-${language}`)));
  #panel = /** @type {HTMLElement} */ (document.getElementById("snippet"));
  /** @type {Language} */
  #language = LANGUAGES[0];
  /** @type {import("./snippets.js").Situation | null} */
  #situation = null;

  constructor() {
    this.#tabs.forEach((tab, index) => {
      tab.addEventListener("click", () => this.#select(index));
      tab.addEventListener("keydown", ({ key }) => {
        const step = { ArrowRight: 1, ArrowLeft: LANGUAGES.length - 1 }[key];
        if (step === undefined) return;
        const next = (index + step) % LANGUAGES.length;
        this.#select(next);
        this.#tabs[next].focus();
      });
    });
  }

  get text() {
    return this.#panel.textContent ?? "";
  }

  /** @param {import("./snippets.js").Situation} situation */
  show(situation) {
    this.#situation = situation;
    const text = snippet(this.#language, situation);
    const code = this.#panel.querySelector("code");
    if (code && code.textContent !== text) code.textContent = text;
  }

  /** @param {number} index */
  #select(index) {
    this.#language = LANGUAGES[index];
    this.#tabs.forEach((tab, other) => {
      tab.setAttribute("aria-selected", String(other === index));
      tab.tabIndex = other === index ? 0 : -1;
    });
    this.#panel.setAttribute("aria-labelledby", this.#tabs[index].id);
    if (this.#situation) this.show(this.#situation);
  }
}

/**
 * Copies text, and says so on the button for a moment.
 * @param {string} text
 * @param {HTMLElement} button
 */
export async function copyText(text, button) {
  const label = (button.dataset.label ??= button.textContent ?? "");
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
  } catch {
    button.textContent = "Select it and copy";
  }
  setTimeout(() => (button.textContent = label), COPIED_MS);
}
