// The messages of the service, generated from their JSON Schemas by `make js-types`. Do not edit.

/**
 * The messages of a stream by who sends them, and the bodies of other responses.
 */
export interface Messages {
  client: StartMessage | FrameMessage | EndMessage;
  server: ReadyMessage | LanesMessage | WarningMessage | ErrorMessage | DrainingMessage | SummaryMessage;
  models: ModelList;
  problem: Problem;
}
/**
 * Client: opens the stream. Without it, the first image opens the stream with the defaults.
 *
 * With the token of a session that still exists, the stream continues that session on another socket or another
 * replica of the service: the same boundaries keep their ids. With an unknown token, a new session starts.
 */
export interface StartMessage {
  type?: "start";
  /**
   * Name of the session in logs and in `ready`; generated if missing.
   */
  session?: string | null;
  /**
   * The token of `ready` or `draining` of the session to resume.
   */
  resume_token?: string | null;
  /**
   * `latest`: a newer frame replaces a waiting one; `all`: every frame is answered.
   */
  mode?: "latest" | "all";
  /**
   * The detector that finds the lanes; the service's default if missing.
   */
  detector?: ("candidates" | "regression") | null;
  /**
   * Row of the horizon as a fraction of the image height, negative above the image; estimated if missing.
   */
  horizon?: number | null;
  /**
   * If present, lanes are also reported in meters.
   */
  camera?: CameraModel | null;
  /**
   * When to warn of lane departures; the service's settings if missing.
   */
  departure?: DepartureOptions | null;
  /**
   * The kinds of boundaries to report: `marking`, `road_edge` or both; the service's setting if missing.
   */
  kinds?: ["marking" | "road_edge", ...("marking" | "road_edge")[]] | null;
}
/**
 * The camera parameters that coordinates in meters need, over a flat road.
 *
 * A camera file holds this object as JSON. Either `field_of_view` or `focal_length` is required. With `auto`, pitch or
 * yaw are estimated while driving; without a pitch, that of each frame follows from its horizon.
 */
export interface CameraModel {
  /**
   * Height of the camera above the road in meters.
   */
  height: number;
  field_of_view?: number | null;
  /**
   * [fx, fy] in pixels of an image of `image_size`.
   */
  focal_length?: [number, number] | null;
  /**
   * [cx, cy] in pixels of an image of `image_size`; its middle if missing.
   */
  principal_point?: [number, number] | null;
  /**
   * [width, height] of the images that were calibrated; that of the frames if missing.
   */
  image_size?: [number, number] | null;
  /**
   * OpenCV's [k1, k2, p1, p2, k3].
   *
   * @minItems 5
   * @maxItems 5
   */
  distortion?: [number, number, number, number, number];
  /**
   * Degrees that the camera looks down, or `auto`.
   */
  pitch?: number | "auto" | null;
  /**
   * Degrees that the camera looks to the left of the vehicle's direction, or `auto`.
   */
  yaw?: number | "auto";
  /**
   * Degrees that the camera is turned clockwise, as the driver sees it.
   */
  roll?: number;
  /**
   * Meters that the camera is left of the vehicle's middle.
   */
  lateral?: number;
}
/**
 * When to warn of lane departures, which needs a camera. The service's settings apply to missing fields.
 */
export interface DepartureOptions {
  /**
   * Width of the vehicle over the outer edges of its wheels in meters.
   */
  vehicle_width?: number | null;
  /**
   * Seconds before a line is crossed in which a warning comes.
   */
  warning_s?: number | null;
  /**
   * Below this speed in m/s no warning comes, if frames report the speed.
   */
  least_speed?: number | null;
}
/**
 * Client: number, capture time and motion for the binary message that follows.
 *
 * The service assigns a missing number and a missing time.
 */
export interface FrameMessage {
  type?: "frame";
  /**
   * Number of the frame; the previous one plus one if missing.
   */
  seq?: number | null;
  /**
   * Capture time in seconds, on any clock that does not run backwards.
   */
  timestamp?: number | null;
  /**
   * Speed of the vehicle in m/s.
   */
  speed?: number | null;
  /**
   * Direction indicator of the vehicle.
   */
  indicator?: ("off" | "left" | "right") | null;
}
/**
 * Client: no more frames follow. The service answers the frames it holds, sends a summary and closes the socket.
 */
export interface EndMessage {
  type?: "end";
}
/**
 * Service: the stream is open. `last_seq` is the last answered frame of a resumed session.
 */
export interface ReadyMessage {
  type: "ready";
  /**
   * Name of the session in the service's logs.
   */
  session: string;
  /**
   * Resumes this session; keep it as secret as an API key.
   */
  resume_token: string;
  /**
   * Whether an earlier session continues; false for a new one.
   */
  resumed: boolean;
  /**
   * Number of the last answered frame of a resumed session.
   */
  last_seq: number | null;
  /**
   * The mode of the stream.
   */
  mode: "latest" | "all";
  /**
   * The detector that finds the lanes.
   */
  detector: string;
  /**
   * Name and version of its network.
   */
  model: string;
  /**
   * The execution provider that runs its network.
   */
  provider: string;
  limits: Limits;
}
/**
 * The limits of the service.
 */
export interface Limits {
  /**
   * Maximum size of an image file in bytes.
   */
  max_bytes: number;
  /**
   * Maximum number of pixels of an image.
   */
  max_pixels: number;
  /**
   * Maximum number of unanswered frames in mode `all`.
   */
  credits: number;
  /**
   * Maximum average number of frames per second.
   */
  frames_per_s: number;
  /**
   * Maximum average number of bytes per second.
   */
  bytes_per_s: number;
  /**
   * A stream that is idle for this many seconds is closed.
   */
  idle_s: number;
  /**
   * Maximum age of a session in seconds.
   */
  session_s: number;
  /**
   * A session can be resumed for this many seconds after its socket closed.
   */
  resume_s: number;
}
/**
 * Service: the lanes of one frame.
 */
export interface LanesMessage {
  type: "lanes";
  /**
   * Number of the frame.
   */
  seq: number;
  /**
   * Capture time of the frame in seconds.
   */
  timestamp: number;
  /**
   * Width of the image in pixels.
   */
  width: number;
  /**
   * Height of the image in pixels.
   */
  height: number;
  /**
   * Row of the horizon in this frame in pixels.
   */
  horizon: number;
  /**
   * The reported boundaries.
   */
  lanes: LaneModel[];
  ego: EgoModel;
  /**
   * Null without a camera.
   */
  departure: DepartureModel | null;
  /**
   * Null unless the camera's pitch or yaw is `auto`.
   */
  calibration: CalibrationModel | null;
  /**
   * What happened since the previous frame.
   */
  events: (LaneChangeModel | DepartureEventModel | SceneCutModel | CalibrationChangedModel)[];
  /**
   * Frames of this stream that were dropped so far.
   */
  dropped: number;
  timing_ms: TimingModel;
}
/**
 * A tracked lane boundary: x(y) = v + b u + k / u with u = y - horizon and `coefficients` [v, b, k].
 *
 * The curve is valid between the rows of `line`. On a flat road it is a parabola on the ground, seen in perspective.
 */
export interface LaneModel {
  /**
   * Identity of the boundary, which it keeps while it is tracked.
   */
  track_id: number;
  /**
   * -1 is ego left, +1 ego right, -2 and +2 are the next boundaries outwards.
   */
  position: number;
  /**
   * `detected` in this frame, `inferred` from the road where little or no paint was seen, or `predicted` only.
   */
  state: "detected" | "inferred" | "predicted";
  /**
   * Probability that it is a boundary.
   */
  probability: number;
  /**
   * A `marking` on the road, or a `road_edge`: a curb, or where the pavement ends.
   */
  kind: "marking" | "road_edge";
  /**
   * Probability that it is of this kind.
   */
  kind_probability: number;
  /**
   * Null for a road edge, and if the model does not classify markings.
   */
  marking: MarkingModel | null;
  /**
   * Points [x, y] on the curve in pixels, from the lowest row to the highest.
   */
  points: [number, number][];
  line: LineModel;
  /**
   * Row of the horizon of the curve in pixels.
   */
  horizon: number;
  /**
   * [v, b, k] of the curve: v in pixels, b in pixels per row, k in square pixels.
   *
   * @minItems 3
   * @maxItems 3
   */
  coefficients: [number, number, number];
  /**
   * 3 x 3 covariance of the coefficients, in their units.
   */
  covariance: number[][];
  /**
   * Seconds since its track began.
   */
  age_s: number;
  /**
   * [a, b, c] of Y = a X^2 + b X + c on the road, in meters: X forward of the camera, Y left of the vehicle's middle. Null without a camera.
   */
  ground: [number, number, number] | null;
  /**
   * 3 x 3 covariance of [a, b, c]. Null without a camera.
   */
  ground_covariance: number[][] | null;
}
/**
 * How a marking is painted, as all frames in which it was detected have shown so far.
 */
export interface MarkingModel {
  /**
   * The most probable type; `dots` are raised dots.
   */
  type: "solid" | "dashed" | "double" | "dots";
  /**
   * Probability of this type.
   */
  type_probability: number;
  /**
   * The more probable color.
   */
  color: "white" | "yellow";
  /**
   * Probability of this color.
   */
  color_probability: number;
  /**
   * Probability that type and color are both right.
   */
  probability: number;
}
/**
 * The end points of the curve.
 */
export interface LineModel {
  /**
   * The point in the lowest row.
   *
   * @minItems 2
   * @maxItems 2
   */
  bottom: [number, number];
  /**
   * The point in the highest row.
   *
   * @minItems 2
   * @maxItems 2
   */
  top: [number, number];
}
/**
 * The lane the camera is in: the track ids and kinds of its boundaries, and the camera's offset from the center.
 *
 * `offset` is a fraction of the lane width, positive to the right; null unless both boundaries are known. The fields
 * in meters need a camera model and apply at the vehicle's middle: `offset_m` and `lane_width_m` if both boundaries
 * are known, `heading` and `curvature` if at least one is. Each has its standard deviation in `..._sigma`.
 */
export interface EgoModel {
  /**
   * Track id of the left boundary; null without one.
   */
  left: number | null;
  /**
   * Track id of the right boundary; null without one.
   */
  right: number | null;
  /**
   * Kind of the left boundary; null without one.
   */
  left_kind: ("marking" | "road_edge") | null;
  /**
   * Kind of the right boundary; null without one.
   */
  right_kind: ("marking" | "road_edge") | null;
  /**
   * Distance of the camera from the center of the lane as a share of its width, positive to the right.
   */
  offset: number | null;
  /**
   * Standard deviation of `offset`.
   */
  offset_sigma: number | null;
  /**
   * Offset in meters, positive to the right of the center.
   */
  offset_m: number | null;
  /**
   * Standard deviation of `offset_m` in meters.
   */
  offset_m_sigma: number | null;
  /**
   * Lane width in meters.
   */
  lane_width_m: number | null;
  /**
   * Standard deviation of `lane_width_m` in meters.
   */
  lane_width_m_sigma: number | null;
  /**
   * Angle from the vehicle's heading to the lane's in radians, positive to the left.
   */
  heading: number | null;
  /**
   * Standard deviation of `heading` in radians.
   */
  heading_sigma: number | null;
  /**
   * Curvature of the lane in 1/m, positive if it curves to the left.
   */
  curvature: number | null;
  /**
   * Standard deviation of `curvature` in 1/m.
   */
  curvature_sigma: number | null;
  /**
   * Speed of the vehicle across its lane in m/s, positive to the right.
   */
  lateral_speed: number | null;
  /**
   * Standard deviation of `lateral_speed` in m/s.
   */
  lateral_speed_sigma: number | null;
}
/**
 * Whether the vehicle leaves its lane, and on which side.
 */
export interface DepartureModel {
  /**
   * `warning` before its wheels cross a boundary, `crossed` from then until they are back inside.
   */
  state: "none" | "warning" | "crossed";
  /**
   * Null if the state is `none`.
   */
  side: ("left" | "right") | null;
  /**
   * Seconds until the wheels on the side that the vehicle approaches reach its boundary, at most 10; 0 beyond it. Null if it approaches none.
   */
  time_to_crossing: number | null;
}
/**
 * The estimated direction of the camera in degrees, if `start` had `auto` for its pitch or its yaw.
 */
export interface CalibrationModel {
  /**
   * Pitch of the camera in degrees, positive if it looks down.
   */
  pitch: number;
  /**
   * Standard deviation of the pitch in degrees.
   */
  pitch_sigma: number;
  /**
   * Yaw of the camera in degrees, positive if it looks to the left.
   */
  yaw: number;
  /**
   * Standard deviation of the yaw in degrees.
   */
  yaw_sigma: number;
  /**
   * Whether the estimate is good enough to be used.
   */
  settled: boolean;
}
/**
 * The vehicle's middle, or the camera if that is unknown, crossed a lane boundary.
 */
export interface LaneChangeModel {
  type: "lane_change";
  /**
   * Track id of the boundary.
   */
  track_id: number;
  /**
   * The side to which the vehicle changes.
   */
  direction: "left" | "right";
  /**
   * Time of the crossing, interpolated between frames.
   */
  timestamp: number;
}
/**
 * A departure warning began, or the vehicle's wheels crossed a boundary of its lane.
 */
export interface DepartureEventModel {
  type: "departure";
  /**
   * What began: a warning, or a crossing.
   */
  state: "warning" | "crossed";
  /**
   * The side of the boundary.
   */
  side: "left" | "right";
  /**
   * Track id of the boundary.
   */
  track_id: number;
  /**
   * Time of the warning or the crossing, interpolated between frames.
   */
  timestamp: number;
}
/**
 * The frame shows another scene than the one before: all track ids are new.
 */
export interface SceneCutModel {
  type: "scene_cut";
  /**
   * Time of the first frame of the new scene.
   */
  timestamp: number;
}
/**
 * The camera points in another direction than before, in degrees.
 */
export interface CalibrationChangedModel {
  type: "calibration_changed";
  /**
   * The new pitch in degrees, positive if the camera looks down.
   */
  pitch: number;
  /**
   * The new yaw in degrees, positive if the camera looks to the left.
   */
  yaw: number;
  /**
   * Time of the frame in which it was noticed.
   */
  timestamp: number;
}
/**
 * Duration of each stage in milliseconds. `total` is their sum.
 */
export interface TimingModel {
  /**
   * Decoding the image file.
   */
  decode: number;
  /**
   * Working image, ego-lane prior and candidates, without the networks.
   */
  propose: number;
  /**
   * Waiting before the frame was processed.
   */
  queue: number;
  /**
   * Waiting for the networks.
   */
  infer: number;
  /**
   * Fitting curves to the paint.
   */
  fit: number;
  /**
   * The tracker.
   */
  track: number;
  /**
   * From the frame's arrival to its reply.
   */
  total: number;
}
/**
 * Service: what the client sends is accepted, but probably wrong. Each code comes at most once in a session.
 */
export interface WarningMessage {
  type: "warning";
  /**
   * The kind of warning, for programs.
   */
  code: "timestamps_in_milliseconds" | "timestamps_not_advancing";
  /**
   * What is probably wrong, for people.
   */
  message: string;
  /**
   * What to do, for people.
   */
  hint: string;
  /**
   * The frame that showed it.
   */
  seq: number;
}
/**
 * Service: an error. With a `seq` it answers that frame; a fatal error ends the stream.
 */
export interface ErrorMessage {
  type: "error";
  /**
   * The kind of error, for programs; never changes its meaning.
   */
  code: string;
  /**
   * What is wrong, for people.
   */
  message: string;
  /**
   * What to do, for people.
   */
  hint: string;
  /**
   * The frame that the error answers; null if none.
   */
  seq: number | null;
  /**
   * Whether the service closes the stream.
   */
  fatal: boolean;
}
/**
 * Service: it is about to stop. It answers the frames it holds, refuses later ones, then closes the socket.
 *
 * The session can be resumed on another replica, or on this one after its restart.
 */
export interface DrainingMessage {
  type: "draining";
  /**
   * Null if the stream was opened without `start`.
   */
  resume_token: string | null;
  /**
   * The socket is closed after this many seconds at the latest.
   */
  deadline_s: number;
}
/**
 * Service: the reply to `end` with the counts of all frames received over this socket.
 *
 * `frames` is the number of received frames, each of which was answered, failed or dropped.
 */
export interface SummaryMessage {
  type: "summary";
  /**
   * Frames received.
   */
  frames: number;
  /**
   * Frames answered with lanes.
   */
  answered: number;
  /**
   * Frames answered with an error.
   */
  failed: number;
  /**
   * Frames without an answer, because newer ones replaced them.
   */
  dropped: number;
  /**
   * Seconds since the socket was opened.
   */
  duration_s: number;
}
/**
 * The loaded networks. The first one belongs to the default detector.
 */
export interface ModelList {
  models: ModelEntry[];
}
/**
 * A loaded network with the SHA-256 of its file and the file's metadata.
 */
export interface ModelEntry {
  name: string;
  detector: string;
  provider: string;
  sha256: string;
  metadata: {
    [k: string]: unknown;
  };
}
/**
 * The body of every error response. `request_id` is null if the head of the request was refused.
 */
export interface Problem {
  code: string;
  message: string;
  hint: string;
  request_id: string | null;
}
