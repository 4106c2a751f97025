/** Exchanges an API key for a short-lived token. The key is forgotten at once, and the token is kept in memory only. */

import { Problem, explain } from "./problems.js";

export class Access {
  #base;
  #dialog;
  /** @type {string | null} */
  token = null;
  /** Whether the service has asked for a key so far. */
  needsKey = false;

  /**
   * @param {URL} base address of the service
   * @param {HTMLDialogElement} dialog that asks for the key
   */
  constructor(base, dialog) {
    this.#base = base;
    this.#dialog = dialog;
  }

  /**
   * Asks the visitor for a key until the service accepts one. Returns false if the visitor gives up.
   * @param {string} reason shown in the dialog
   */
  async ask(reason = "") {
    this.needsKey = true;
    this.token = null;
    const dialog = this.#dialog;
    if (dialog.open) return false;
    const input = /** @type {HTMLInputElement} */ (dialog.querySelector("input"));
    const form = /** @type {HTMLFormElement} */ (dialog.querySelector("form"));
    const error = /** @type {HTMLElement} */ (dialog.querySelector(".error"));
    const cancel = /** @type {HTMLButtonElement} */ (dialog.querySelector("#access-cancel"));
    error.textContent = reason;
    form.onsubmit = async (event) => {
      event.preventDefault();
      const key = input.value;
      input.value = "";
      try {
        this.token = await this.#exchange(key);
        dialog.close();
      } catch (problem) {
        error.textContent = problem instanceof Problem ? problem.line : String(problem);
        input.focus();
      }
    };
    cancel.onclick = () => dialog.close();
    dialog.showModal();
    input.focus();
    await new Promise((resolve) => dialog.addEventListener("close", resolve, { once: true }));
    input.value = "";
    return this.token !== null;
  }

  /** @param {string} key */
  async #exchange(key) {
    let response;
    try {
      response = await fetch(new URL("v1/tokens", this.#base), {
        method: "POST",
        headers: { Authorization: `Bearer ${key.trim()}` },
      });
    } catch (error) {
      if (error instanceof TypeError && /header/i.test(error.message)) {
        throw new Problem("This is not an API key: it has characters that no key has", "Copy the key again");
      }
      throw new Problem("The service can't be reached", "Check that it runs, then try again");
    }
    if (response.ok) return String((await response.json()).token);
    const problem = await response.json().catch(() => ({}));
    const code = problem.code ?? (response.status === 401 ? "unauthorized" : "internal");
    if (code === "unauthorized")
      throw new Problem("The service does not know this key", "Check it, or ask whoever runs the service for one");
    const message = problem.message ?? problem.detail ?? `the service replied with ${response.status}`;
    throw new Problem(explain({ code, message, hint: problem.hint }).replace(/\.$/, ""), "");
  }
}
