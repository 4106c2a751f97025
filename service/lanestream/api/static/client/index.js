export { captureFrames } from "./capture.js";
export { LaneClient } from "./client.js";
export { LaneError } from "./errors.js";
export { lanePoints, laneX } from "./geometry.js";
export { LaneStream } from "./stream.js";
