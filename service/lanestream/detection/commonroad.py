"""What the boundaries of one road share, used where they are fitted: each tells where the others' far ends must lie.

On a flat road all boundaries have one vanishing point, one horizon and one bend (`lanestream.detection.perspective`). A
dashed line that shows no bend of its own, or one whose far end is behind a car, has that of its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lanestream.road.curve import FloatArray, curve_basis


@dataclass(frozen=True)
class Boundaries:
    """N boundaries as their `columns` (N, 3) at three `rows` (3,), told below a `horizon`.

    The row at which it was `expected` is kept beside it. `leaning` (N,) is how much wider a boundary's errors are from
    side to side than those of an upright one; `depth` is the rows below the expected horizon.
    """

    columns: FloatArray
    rows: FloatArray
    horizon: float
    expected: float
    leaning: FloatArray
    depth: float

    @cached_property
    def to_curve(self) -> FloatArray:
        """The matrix (3, 3) that takes columns at the rows to the coefficients v, b and k of a curve."""
        return np.asarray(np.linalg.inv(curve_basis(self.horizon, self.rows)))

    @cached_property
    def coefficients(self) -> FloatArray:
        """The curves' coefficients v, b and k (N, 3)."""
        return np.asarray(self.columns @ self.to_curve.T)

    def drift(self, shifts: FloatArray) -> FloatArray:
        """How v, b and k (N, 3) of the boundaries, moved by `shifts` (N, 3), change with each row of the horizon.

        The columns stay where they are: a lower horizon is to a curve as if its points were that much higher.
        """
        _, b, k = ((self.columns + shifts) @ self.to_curve.T).T[:, :, None]
        slopes = b - k / (self.rows - self.horizon) ** 2
        return np.asarray(slopes @ self.to_curve.T)


@dataclass(frozen=True)
class Agreement:
    """Shifts (N, 3) of boundaries' columns, with covariances (N, 3, 3), and the road (3,) that they agree on.

    The road is told by its vanishing point's column V, by the rows H that its horizon is lower than the one that
    boundaries are told below, and by its bend K over the depth, V and K below its own horizon.
    """

    shifts: FloatArray
    covariances: FloatArray
    road: FloatArray


@dataclass(frozen=True)
class CommonRoad:
    """How strictly boundaries keep to one road; lengths are shares of the depth.

    The v and k of a boundary are those of the road give or take `vanishing` and `bend`, and of a road that bends give
    or take `turn` of its K, too: the inner boundary turns more sharply than the outer one. One that is `outlier` times
    that away counts half, because it is of another road, or no boundary. Of the road it is known beforehand that its
    V and K are those of the median boundary, and its horizon where it was expected, give or take `usual`; the horizon
    is not taken to be more than `nod` away.
    """

    vanishing: float = 0.003
    bend: float = 0.0006
    turn: float = 0.1
    outlier: float = 3.0
    usual: tuple[float, float, float] = (0.1, 0.03, 0.03)
    nod: float = 0.04

    def begun(self, boundaries: Boundaries) -> Agreement:
        """Boundaries that have not moved, and the road of the median one below the expected horizon."""
        v, _, k = np.median(boundaries.coefficients, axis=0)
        road = np.array([v, boundaries.expected - boundaries.horizon, k / boundaries.depth])
        return Agreement(np.zeros_like(boundaries.columns), np.zeros((*boundaries.columns.shape, 3)), road)

    def agree(self, normal: FloatArray, moment: FloatArray, boundaries: Boundaries, last: Agreement) -> Agreement:
        """Boundaries and road fitted together; `last` tells which boundaries are far from the road.

        What each boundary says by itself are the normal equations of its shift: `normal` (N, 3, 3), `moment` (N, 3).
        """
        v, _, k = boundaries.coefficients.T
        drift_v, _, drift_k = boundaries.drift(last.shifts).T
        # Two ties a boundary: v + its shift + its drift H = V, and k likewise = K.
        ties = boundaries.to_curve[[0, 2]] / np.array([[1.0], [boundaries.depth]])
        told = np.stack([v, k / boundaries.depth], axis=1)
        shared = np.zeros((len(v), 2, 3))
        shared[:, 0, 0], shared[:, 0, 1] = 1.0, -drift_v
        shared[:, 1, 1], shared[:, 1, 2] = -drift_k / boundaries.depth, 1.0
        turn = self.turn * abs(last.road[2]) / boundaries.depth
        usual = np.array([self.vanishing + turn, self.bend + turn])
        sigma = boundaries.depth * boundaries.leaning[:, None] * usual
        away = (told + last.shifts @ ties.T - shared @ last.road) / sigma
        weight = sigma**-2.0 / (1.0 + (away**2).sum(axis=1, keepdims=True) / self.outlier**2)
        # Least squares over all shifts and the road. The shifts, each tied to the road alone, are eliminated.
        tied, known = ties.T * weight[:, None], shared.swapaxes(1, 2) * weight[:, None]
        own = np.linalg.inv(normal + tied @ ties)
        alone = (own @ (moment[..., None] - tied @ told[..., None]))[..., 0]
        follows = own @ tied @ shared
        first = self.begun(boundaries).road
        prior = np.diag((boundaries.depth * np.asarray(self.usual)) ** -2.0)
        spread = np.linalg.inv(prior + (known @ (shared - ties @ follows)).sum(axis=0))
        road = spread @ (prior @ first + np.einsum("nij,nj->i", known, told + alone @ ties.T))
        covariances = own + follows @ spread @ follows.swapaxes(1, 2)
        return Agreement(alone + follows @ road, covariances, road)

    def nodded(self, boundaries: Boundaries, found: Agreement) -> tuple[Boundaries, Agreement]:
        """The same boundaries and what they agreed on, told below the horizon of their road."""
        most = self.nod * boundaries.depth
        low = float(np.clip(boundaries.horizon + found.road[1] - boundaries.expected, -most, most))
        road = np.array([found.road[0], 0.0, found.road[2]])
        return replace(boundaries, horizon=boundaries.expected + low), replace(found, road=road)
