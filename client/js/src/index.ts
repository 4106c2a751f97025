export { type CaptureOptions, type Capture, captureFrames, type FrameSource } from "./capture.js";
export { type ClientOptions, type DetectOptions, LaneClient } from "./client.js";
export { LaneError } from "./errors.js";
export { lanePoints, laneX, type PointsOptions } from "./geometry.js";
export type * from "./messages.js";
export type { LaneModel as Lane } from "./messages.js";
export type { FrameMeta, ImageFile, StreamOptions, Summary } from "./protocol.js";
export { LaneStream, type StateChange, type StreamEvents, type StreamState } from "./stream.js";
