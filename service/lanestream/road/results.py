"""What detectors find and trackers follow: detections, tracked boundaries, the ego lane and the result of a frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from lanestream.road.appearance import Appearance, BoundaryKind
from lanestream.road.curve import Curve, FloatArray
from lanestream.road.view import Scaling

TrackState = Literal["detected", "inferred", "predicted"]
Side = Literal["left", "right"]
TimestampWarning = Literal["timestamps_in_milliseconds", "timestamps_not_advancing"]
# The coefficients (a, b, c) of Y = a X^2 + b X + c on the road, in meters: X forward, Y left of the vehicle's middle.
GroundCurve = tuple[float, float, float]


@dataclass(frozen=True)
class Estimate:
    """An estimated value and its standard deviation, in the same unit."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Detection:
    """A boundary found in one frame.

    `covariance` (3, 3) belongs to the curve's coefficients. The boundary is visible between the rows `top` and
    `bottom`. `probability` is the calibrated probability that it is a lane boundary, `paint` the share of its rows in
    which a marking is visible, and `expected` whether the ego-lane prior has a boundary there. `appearance` is how it
    looks in this frame.
    """

    curve: Curve
    covariance: FloatArray
    top: float
    bottom: float
    probability: float
    paint: float = 1.0
    expected: bool = False
    appearance: Appearance = Appearance()


@dataclass(frozen=True)
class LaneBoundary:
    """A tracked boundary: a detection with an identity, a history and a position relative to the camera.

    `position` is -1 for ego left, +1 for ego right, -2 and +2 for the next ones out. `age_s` counts from its first
    detection. `state` is `detected` if a detection of this frame supports it, `inferred` if one does but little or no
    paint was seen along it, and `predicted` if the filter carries it. `ground` is the boundary in meters if the camera
    is known, with the covariance `ground_covariance` (3, 3). `appearance` is what its detections have shown it to be.
    """

    track_id: int
    position: int
    state: TrackState
    probability: float
    curve: Curve
    covariance: FloatArray
    top: float
    bottom: float
    age_s: float
    ground: GroundCurve | None = None
    ground_covariance: FloatArray | None = None
    appearance: Appearance = Appearance()


@dataclass(frozen=True)
class LaneChange:
    """The vehicle's middle crossed the boundary `track_id` towards `direction`.

    `timestamp` is interpolated between frames. Without a camera model, the camera counts as the vehicle's middle.
    """

    track_id: int
    direction: Side
    timestamp: float


@dataclass(frozen=True)
class SceneCut:
    """The frame at `timestamp` shows another scene than the one before; all boundaries are new."""

    timestamp: float


@dataclass(frozen=True)
class CalibrationChanged:
    """The camera was found to point in another direction than before: `pitch` down and `yaw` left, in degrees."""

    timestamp: float
    pitch: float
    yaw: float


@dataclass(frozen=True)
class DepartureEvent:
    """The vehicle began to leave its lane (`warning`), or its wheel crossed the boundary `track_id` (`crossed`).

    `timestamp` is interpolated between frames.
    """

    state: Literal["warning", "crossed"]
    side: Side
    track_id: int
    timestamp: float


Event = LaneChange | SceneCut | CalibrationChanged | DepartureEvent


@dataclass(frozen=True)
class Departure:
    """Whether the vehicle leaves its lane, and on which side.

    `side` is None without a departure. `time_to_crossing` is the time in seconds, at most 10, until the wheels reach
    the boundary that the vehicle approaches; 0 beyond it; None if it approaches none.
    """

    state: Literal["none", "warning", "crossed"] = "none"
    side: Side | None = None
    time_to_crossing: float | None = None


@dataclass(frozen=True)
class EgoMeters:
    """The ego lane in the vehicle's frame, in meters; a value is None if it is unknown.

    `offset` is that of the vehicle's middle from the lane's, positive to the right; `heading` is the angle from the
    vehicle's heading to the lane's in radians, positive to the left; `curvature` in 1/m is positive to the left;
    `lateral_speed` in m/s is positive to the right. `left` and `right` are the distances of the boundaries from the
    vehicle's middle, positive while it is inside its lane.
    """

    offset: Estimate | None = None
    heading: Estimate | None = None
    curvature: Estimate | None = None
    lane_width: Estimate | None = None
    lateral_speed: Estimate | None = None
    left: Estimate | None = None
    right: Estimate | None = None


@dataclass(frozen=True)
class RoadEstimate:
    """What all boundaries of a frame share, in pixels: a boundary is x(y) = v + b u + k / u with u = y - horizon.

    `vanishing_column` is v and `curvature` is k of the road. `lateral_rate` is how much faster than the road the
    camera moves to the right: the rate at which all b fall, per second.
    """

    vanishing_column: Estimate
    curvature: Estimate
    lateral_rate: Estimate

    def to_image(self, scaling: Scaling) -> RoadEstimate:
        """Converts an estimate in working pixels to pixels of the image that `scaling` reduced."""
        column, curvature, factor = self.vanishing_column, self.curvature, scaling.factor
        return replace(
            self,
            vanishing_column=Estimate(scaling.to_image(column.value), column.sigma / factor),
            curvature=Estimate(curvature.value / factor**2, curvature.sigma / factor**2),
        )


@dataclass(frozen=True)
class EgoLane:
    """The lane the camera is in: the track ids and the kinds of its boundaries, and the camera's position between them.

    `offset` is the camera's distance from the lane's center as a fraction of the lane width at the bottom row, positive
    to the right; `lateral_speed` is its rate in lane widths per second. Both are None unless both boundaries are
    known. `meters` is known if the camera is.
    """

    left: int | None = None
    right: int | None = None
    left_kind: BoundaryKind | None = None
    right_kind: BoundaryKind | None = None
    offset: Estimate | None = None
    lateral_speed: Estimate | None = None
    meters: EgoMeters | None = None


@dataclass(frozen=True)
class Calibration:
    """The estimated direction of the camera in degrees, `pitch` down and `yaw` left; `settled` if it can be used."""

    pitch: Estimate
    yaw: Estimate
    settled: bool


@dataclass(frozen=True)
class FrameResult:
    """The result of one frame: boundaries from left to right, the ego lane, events, and the horizon's row.

    `road` is None if no boundary is known, `departure` and `calibration` if the camera is not; `calibration` is its
    estimated direction. `warnings` are codes of faults of the stream, each of which is reported once.
    """

    lanes: tuple[LaneBoundary, ...]
    ego: EgoLane
    horizon: float
    events: tuple[Event, ...] = ()
    road: RoadEstimate | None = None
    departure: Departure | None = None
    calibration: Calibration | None = None
    warnings: tuple[TimestampWarning, ...] = ()
    timing_ms: dict[str, float] = field(default_factory=dict)

    def to_image(self, scaling: Scaling) -> FrameResult:
        """Converts a result in working pixels to pixels of the image that `scaling` reduced."""
        lanes = tuple(
            replace(
                lane,
                curve=scaling.curve_to_image(lane.curve),
                covariance=scaling.covariance_to_image(lane.covariance),
                top=scaling.to_image(lane.top),
                bottom=scaling.to_image(lane.bottom),
            )
            for lane in self.lanes
        )
        road = None if self.road is None else self.road.to_image(scaling)
        return replace(self, lanes=lanes, horizon=scaling.to_image(self.horizon), road=road)
