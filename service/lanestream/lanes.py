"""Value objects: what the detectors find and the tracker follows.

Coordinates are pixels of the original image: x right, y down, floats, pixel centres at integers. Every boundary is a
function x(y) of the image row, because lane boundaries run away from the camera and cross each row once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]
State = Literal["detected", "predicted"]


@dataclass(frozen=True)
class Curve:
    """A boundary as x(y) = v + b u + k / u with u = y - horizon, in pixels; a straight line has k = 0.

    On a flat road this is exactly a parabola of the ground seen in perspective: v is where it meets the horizon, b its
    lateral place, k its bend. It is valid below the horizon; nearer than one row to it, u counts as one row.
    """

    horizon: float
    coefficients: tuple[float, float, float]

    @classmethod
    def through(cls, horizon: float, rows: FloatArray, columns: FloatArray) -> Curve:
        """The curve through three points at three different rows (3,) below `horizon`."""
        return curves_through(horizon, rows, columns[None])[0]

    def x(self, y: FloatArray | float) -> FloatArray:
        """Columns at the rows `y`; the shape of the answer is that of `y`."""
        v, b, k = self.coefficients
        u = _depth(self.horizon, y)
        return v + b * u + k / u

    def slope(self, y: FloatArray | float) -> FloatArray:
        """dx/dy at the rows `y`."""
        _, b, k = self.coefficients
        return b - k / _depth(self.horizon, y) ** 2


def curve_basis(horizon: float, rows: FloatArray) -> FloatArray:
    """d x / d (v, b, k) at `rows` (N,): shape (N, 3)."""
    u = _depth(horizon, rows)
    return np.stack([np.ones_like(u), u, 1.0 / u], axis=-1)


def curves_through(horizon: float, rows: FloatArray, columns: FloatArray) -> list[Curve]:
    """The curve through each row of `columns` (N, 3), which they have at the same three `rows` (3,) below `horizon`."""
    coefficients = np.linalg.solve(curve_basis(horizon, rows), columns.T).T.tolist()
    return [Curve(horizon, (v, b, k)) for v, b, k in coefficients]


# The shares of a depth at which a curve is told anew: three tell it.
_TELLING: Final = np.array([1.0, 0.45, 0.15])


def under_horizon(curves: Sequence[Curve], horizon: float, bottom: float) -> list[Curve]:
    """The curves told from another `horizon`, from which on they are curves at all, down to the row `bottom`.

    Each has the columns that it had at three rows below its own horizon and below the new one: a curve of a lower
    horizon goes on as it bends, where it had no columns.
    """
    told = []
    for curve in curves:
        highest = max(curve.horizon, horizon)
        rows = highest + _TELLING * (bottom - highest)
        told += curves_through(horizon, rows, curve_columns([curve], rows))
    return told


def curve_columns(curves: Sequence[Curve], rows: FloatArray) -> FloatArray:
    """Columns (N, R) of N curves at once, at `rows` of their own (N, R) or the same for all (R,)."""
    horizon, v, b, k = _told(curves)
    u = _depth(horizon, rows)
    columns: FloatArray = v + b * u + k / u
    return columns


def curve_slopes(curves: Sequence[Curve], rows: FloatArray) -> FloatArray:
    """dx/dy of N curves at once, at `rows` of their own (N, R) or the same for all (R,); shape (N, R)."""
    horizon, _, b, k = _told(curves)
    slopes: FloatArray = b - k / _depth(horizon, rows) ** 2
    return slopes


def _told(curves: Sequence[Curve]) -> FloatArray:
    """Horizons and coefficients of N curves (4, N, 1)."""
    told = np.array([(curve.horizon, *curve.coefficients) for curve in curves])
    return told.reshape(-1, 4).T[:, :, None]


def _depth(horizon: FloatArray | float, y: FloatArray | float) -> FloatArray:
    return np.maximum(np.asarray(y, dtype=float) - horizon, 1.0)


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
