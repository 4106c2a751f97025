"""What detectors find and trackers follow: detections, tracked boundaries, the ego lane and the result of a frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from lanestream.road.curve import Curve, FloatArray
from lanestream.road.view import Scaling

TrackState = Literal["detected", "predicted"]


@dataclass(frozen=True)
class Detection:
    """A boundary found in one frame.

    `covariance` (3, 3) belongs to the curve's coefficients. The boundary is visible between the rows `top` and
    `bottom`. `probability` is the calibrated probability that it is a lane boundary.
    """

    curve: Curve
    covariance: FloatArray
    top: float
    bottom: float
    probability: float


@dataclass(frozen=True)
class LaneBoundary:
    """A tracked boundary: a detection with an identity, a history and a position relative to the camera.

    `position` is -1 for ego left, +1 for ego right, -2 and +2 for the next ones out. `age_s` counts from its first
    detection. `state` is `detected` if a detection of this frame supports it, `predicted` if the filter carries it.
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


@dataclass(frozen=True)
class LaneChange:
    """The camera crossed the boundary `track_id` towards `direction`."""

    track_id: int
    direction: Literal["left", "right"]


@dataclass(frozen=True)
class EgoLane:
    """The lane the camera is in: the track ids of its boundaries and the camera's position between them.

    `offset` is the camera's distance from the lane's center as a fraction of the lane width at the bottom row, positive
    to the right; None unless both boundaries are known.
    """

    left: int | None = None
    right: int | None = None
    offset: float | None = None


@dataclass(frozen=True)
class FrameResult:
    """The result of one frame: boundaries from left to right, the ego lane, events, and the horizon's row."""

    lanes: tuple[LaneBoundary, ...]
    ego: EgoLane
    horizon: float
    events: tuple[LaneChange, ...] = ()
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
        return replace(self, lanes=lanes, horizon=scaling.to_image(self.horizon))
