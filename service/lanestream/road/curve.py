"""A lane boundary as a function x(y) of the image row: it runs away from the camera and crosses each row once.

Coordinates are pixels: x right, y down, floats, pixel centers at integers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# Three rows determine a curve. These fractions of the distance from the horizon to the bottom row cover the part of the
# road that an image resolves.
ANCHORS: Final[FloatArray] = np.array([1.0, 0.45, 0.15])


@dataclass(frozen=True)
class Curve:
    """A boundary x(y) = v + b u + k / u with the row offset u = y - horizon, in pixels; a straight line has k = 0.

    On a flat road this is exactly a parabola of the ground seen in perspective: v is where it meets the horizon, b its
    lateral position and k its curvature term. It is valid below the horizon; row offsets below 1 count as 1.
    """

    horizon: float
    coefficients: tuple[float, float, float]

    @classmethod
    def through(cls, horizon: float, rows: FloatArray, columns: FloatArray) -> Curve:
        """Returns the curve through three points at three different `rows` (3,) below `horizon`."""
        return Curves.through(horizon, rows, columns[None])[0]

    def x(self, y: FloatArray | float) -> FloatArray:
        """Returns the columns at the rows `y`, in the shape of `y`."""
        v, b, k = self.coefficients
        u = _row_offset(self.horizon, y)
        return v + b * u + k / u

    def slope(self, y: FloatArray | float) -> FloatArray:
        """Returns dx/dy at the rows `y`."""
        _, b, k = self.coefficients
        return b - k / _row_offset(self.horizon, y) ** 2


@dataclass(frozen=True)
class Curves:
    """N boundaries below one `horizon`; row n of `coefficients` (N, 3) holds v, b and k of boundary n."""

    horizon: float
    coefficients: FloatArray

    @classmethod
    def of(cls, curves: Sequence[Curve]) -> Curves:
        """Returns curves that share a horizon as one batch. Raises ValueError if there are none or horizons differ."""
        horizons = {curve.horizon for curve in curves}
        if len(horizons) != 1:
            raise ValueError(f"the curves have {len(horizons)} horizons; one is needed")
        return cls(horizons.pop(), np.array([curve.coefficients for curve in curves]))

    @classmethod
    def none(cls, horizon: float) -> Curves:
        """Returns an empty batch below `horizon`."""
        return cls(horizon, np.empty((0, 3)))

    @classmethod
    def through(cls, horizon: float, rows: FloatArray, columns: FloatArray) -> Curves:
        """Returns the curves with the `columns` (N, 3) at the same three `rows` (3,) below `horizon`."""
        return cls(horizon, columns @ np.linalg.inv(curve_basis(horizon, rows)).T)

    @classmethod
    def concatenate(cls, parts: Sequence[Curves]) -> Curves:
        """Returns the curves of all `parts`, which share a horizon, in order."""
        return cls(parts[0].horizon, np.concatenate([part.coefficients for part in parts]))

    def __len__(self) -> int:
        return len(self.coefficients)

    def __getitem__(self, index: int) -> Curve:
        v, b, k = self.coefficients[index].tolist()
        return Curve(self.horizon, (v, b, k))

    def __iter__(self) -> Iterator[Curve]:
        return (Curve(self.horizon, (v, b, k)) for v, b, k in self.coefficients.tolist())

    def take(self, indices: NDArray[np.intp] | NDArray[np.bool_] | Sequence[int]) -> Curves:
        """Returns the curves at `indices`, or those that a mask (N,) selects."""
        return Curves(self.horizon, self.coefficients[indices])

    def x(self, rows: FloatArray) -> FloatArray:
        """Returns columns (N, R) at `rows`, which are one set for each curve (N, R) or one for all (R,)."""
        u = _row_offset(self.horizon, rows)
        v, b, k = self.coefficients.T[:, :, None]
        columns: FloatArray = v + b * u + k / u
        return columns

    def slope(self, rows: FloatArray) -> FloatArray:
        """Returns dx/dy (N, R) at `rows`, (N, R) or (R,)."""
        u = _row_offset(self.horizon, rows)
        _, b, k = self.coefficients.T[:, :, None]
        slopes: FloatArray = b - k / (u * u)
        return slopes

    def below(self, horizon: float, bottom: float) -> Curves:
        """Returns the curves re-expressed below another `horizon`, down to the row `bottom`.

        Each keeps its columns at three rows below both horizons; nearer to the new horizon it continues with the same
        three coefficients.
        """
        if horizon == self.horizon:
            return self
        highest = max(horizon, self.horizon)
        rows = highest + ANCHORS * (bottom - highest)
        return Curves.through(horizon, rows, self.x(rows))


@dataclass(frozen=True)
class VanishingPoint:
    """What all boundaries of a road share: their vanishing point (`x`, `y`) and curvature term `k`, in pixels.

    `weight` (0 to 1) is the share of the frame's lines that supports it.
    """

    x: float
    y: float
    k: float = 0.0
    weight: float = 0.0

    def columns(self, positions: FloatArray, rows: FloatArray) -> FloatArray:
        """Returns the columns (R, P) of boundaries with the lateral `positions` b (P,) at `rows` (R,)."""
        u = np.maximum(rows - self.y, 1.0)[:, None]
        columns: FloatArray = (self.x + self.k / u) + u * positions
        return columns

    def positions(self, columns: FloatArray, rows: FloatArray) -> FloatArray:
        """Returns the lateral positions b (N,) of the boundaries through the points (`columns`, `rows`), each (N,)."""
        u = np.maximum(rows - self.y, 1.0)
        positions: FloatArray = (columns - self.x - self.k / u) / u
        return positions

    def curves(self, positions: FloatArray) -> Curves:
        """Returns the boundaries with the lateral `positions` b (N,)."""
        coefficients = np.empty((len(positions), 3))
        coefficients[:, 0], coefficients[:, 1], coefficients[:, 2] = self.x, positions, self.k
        return Curves(self.y, coefficients)


def curve_basis(horizon: float, rows: FloatArray) -> FloatArray:
    """Returns d x / d (v, b, k) at `rows` (...,) as an array (..., 3)."""
    u = _row_offset(horizon, rows)
    basis = np.empty((*u.shape, 3))
    basis[..., 0] = 1.0
    basis[..., 1] = u
    basis[..., 2] = 1.0 / u
    return basis


def _row_offset(horizon: float, y: FloatArray | float) -> FloatArray:
    return np.maximum(np.asarray(y, dtype=float) - horizon, 1.0)
