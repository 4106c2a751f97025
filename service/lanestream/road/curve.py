"""A lane boundary as a function x(y) of the image row: it runs away from the camera and crosses each row once.

Coordinates are pixels: x right, y down, floats, pixel centres at integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


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
