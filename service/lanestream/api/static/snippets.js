/** Code that does what the page does, with its present settings. It reads the key from the environment. */

/**
 * @typedef {import("./settings.js").Settings} Settings
 * @typedef {"curl" | "python" | "javascript"} Language
 * @typedef {object} Situation
 * @property {string} url of the service, with a slash at its end
 * @property {boolean} needsKey
 * @property {string | null} detector
 * @property {Settings} settings
 * @property {Settings["camera"]} camera the one in use
 */

/**
 * @param {Language} language
 * @param {Situation} situation
 */
export function snippet(language, situation) {
  return { curl, python, javascript }[language](situation);
}

/** @param {Situation} situation */
function curl({ url, needsKey, detector, settings, camera }) {
  const query = new URLSearchParams();
  if (detector !== null) query.set("detector", detector);
  if (settings.horizon !== null) query.set("horizon", String(settings.horizon));
  if (camera) {
    query.set("camera_height", String(camera.height));
    query.set("field_of_view", String(camera.fov));
  }
  for (const kind of settings.kinds ?? []) query.append("kinds", kind);
  const text = query.toString();
  return [
    "curl --data-binary @road.jpg",
    ...(needsKey ? ['  -H "Authorization: Bearer $LANESTREAM_API_KEY"'] : []),
    `  '${url}v1/detect${text === "" ? "" : `?${text}`}'`,
  ].join(" \\\n");
}

/** @param {Situation} situation */
function python({ url, needsKey, detector, settings, camera }) {
  const options = [
    ...(detector === null ? [] : [`detector="${detector}"`]),
    ...(settings.horizon === null ? [] : [`horizon=${settings.horizon}`]),
    ...(camera ? [`camera=CameraModel(height=${decimal(camera.height)}, field_of_view=${decimal(camera.fov)})`] : []),
    ...(settings.kinds === null ? [] : [`kinds=[${settings.kinds.map((kind) => `"${kind}"`).join(", ")}]`]),
  ];
  const key = needsKey ? ', api_key=os.environ["LANESTREAM_API_KEY"]' : "";
  const names = camera ? "CameraModel, LaneClient, open_source" : "LaneClient, open_source";
  return [
    ...(needsKey ? ["import os", ""] : []),
    `from lanestream_client import ${names}`,
    "",
    `with LaneClient("${bare(url)}"${key}) as client, open_source("drive.mp4") as source:`,
    `    stream = client.stream(${["source.frames", ...options].join(", ")})`,
    "    for result in stream:",
    "        print(result.frame.seq, result.lanes.ego if result.lanes else result.error)",
  ].join("\n");
}

/** @param {Situation} situation */
function javascript({ url, needsKey, detector, settings, camera }) {
  const options = [
    'mode: "latest"',
    ...(detector === null ? [] : [`detector: "${detector}"`]),
    ...(settings.horizon === null ? [] : [`horizon: ${settings.horizon}`]),
    ...(camera ? [`camera: { height: ${camera.height}, field_of_view: ${camera.fov} }`] : []),
    ...(settings.kinds === null ? [] : [`kinds: [${settings.kinds.map((kind) => `"${kind}"`).join(", ")}]`]),
  ];
  const token = needsKey ? ", { token }" : "";
  return [
    ...(needsKey ? ["// A token from POST /v1/tokens, which your own server exchanges for the key.", ""] : []),
    `import { LaneClient } from "${url}static/client/index.js";`,
    "",
    `const client = new LaneClient("${bare(url)}"${token});`,
    `const stream = client.stream({ ${options.join(", ")} });`,
    'stream.on("lanes", (answer) => console.log(answer.seq, answer.ego));',
    "stream.send(jpeg, { seq: 0, timestamp: 0 }); // a Blob, and its capture time in seconds",
  ].join("\n");
}

/**
 * Returns a number as Python shows a float.
 * @param {number} value
 */
function decimal(value) {
  return Number.isInteger(value) ? value.toFixed(1) : String(value);
}

/** @param {string} url */
function bare(url) {
  return url.replace(/\/$/, "");
}
