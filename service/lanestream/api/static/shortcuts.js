/** Keys that work anywhere on the page, except while something is typed. */

/**
 * Calls the action of a key when it is pressed.
 * @param {Record<string, () => void>} actions by key, in lower case
 */
export function listenForShortcuts(actions) {
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || event.defaultPrevented) return;
    if (document.querySelector("dialog[open]") !== null) return;
    const target = event.target instanceof Element ? event.target : document.body;
    if (target.matches("input:not([type=range], [type=checkbox], [type=radio])")) return;
    // These elements have a use for the space bar themselves.
    if (event.key === " " && target.matches("button, input, a, summary")) return;
    const action = actions[event.key.toLowerCase()];
    if (action === undefined) return;
    event.preventDefault();
    action();
  });
}
