"""What the detectors find and the tracker follows. Coordinates are pixels of the original image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from lanestream.road.curve import Curve, FloatArray

State = Literal["detected", "predicted"]


@dataclass(frozen=True)
class Candidate:
    """A possible boundary, straight from the extended Hough transform.

    `top` and `bottom` are the rows between which it is in view and on the road. `strength` orders candidates of one
    frame (more is better).
    """

    curve: Curve
    top: float
    bottom: float
    strength: float


@dataclass(frozen=True)
class Detection:
    """A boundary found in one frame.

    `covariance` (3, 3) belongs to the curve's coefficients. `probability` is the calibrated chance
    that this is a lane boundary.
    """

    curve: Curve
    covariance: FloatArray
    top: float
    bottom: float
    probability: float


@dataclass(frozen=True)
class LaneBoundary:
    """A tracked boundary: a detection with an identity, a history and a place beside the camera.

    `position` is -1 for ego left, +1 for ego right, -2 and +2 for the next ones out. `age_s` counts from its first
    detection. `state` tells whether a detection of this frame backs it (`detected`) or the filter carries it.
    """

    track_id: int
    position: int
    state: State
    probability: float
    curve: Curve
    covariance: FloatArray
    top: float
    bottom: float
    age_s: float


@dataclass(frozen=True)
class LaneChange:
    """The camera crossed the boundary `track_id`, towards `direction`."""

    track_id: int
    direction: Literal["left", "right"]


@dataclass(frozen=True)
class EgoLane:
    """The lane the camera is in: the track ids of its boundaries and where the camera is between them.

    `offset` is the camera's distance from the lane's centre as a share of the lane width at the bottom row, positive to
    the right; None unless both boundaries are known.
    """

    left: int | None = None
    right: int | None = None
    offset: float | None = None


@dataclass(frozen=True)
class FrameResult:
    """All that is known after one frame: boundaries from left to right, the ego lane, events, the horizon's row."""

    lanes: tuple[LaneBoundary, ...]
    ego: EgoLane
    horizon: float
    events: tuple[LaneChange, ...] = ()
    timing_ms: dict[str, float] = field(default_factory=dict)
