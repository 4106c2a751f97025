/** Shows the state of the connection beside the title. */

/** @typedef {import("./session.js").LanePane} LanePane */

/**
 * @param {HTMLElement} root
 * @param {LanePane | null} pane whose stream stands for all; null if there is none
 */
export function showConnection(root, pane) {
  const text = connectionText(pane);
  root.dataset.state = pane === null ? "idle" : pane.state === "open" && pane.resumed === false ? "new" : pane.state;
  root.title = text;
  const label = root.querySelector("span");
  if (label && label.textContent !== text) label.textContent = text;
}

/** @param {LanePane | null} pane */
function connectionText(pane) {
  const attempt = pane && pane.attempt > 1 ? `, attempt ${pane.attempt}` : "";
  const why = pane?.reason ? `: ${pane.reason}` : "";
  switch (pane?.state) {
    case "open":
      return pane.resumed === null ? "Connected" : pane.resumed ? "Connected, same session" : "Connected, new session";
    case "connecting":
      return `Connecting${attempt}${why}`;
    case "reconnecting":
      return `Reconnecting${attempt}${why}`;
    default:
      return "Not connected";
  }
}
