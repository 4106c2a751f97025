"""What the boundaries of one road share, used where they are fitted: each tells where the others' far ends must lie.

On a flat road all boundaries have one vanishing point, one horizon and one bend (`lanestream.detection.perspective`). A
dashed line that shows no bend of its own, or one whose far end is behind a car, has that of its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lanestream.lanes import FloatArray


@dataclass(frozen=True)
class Boundaries:
    """N boundaries as their `columns` (N, 3) at three rows.

    `to_curve` (3, 3) takes those columns to the coefficients v, b and k of a curve. `leaning` (N,) is how much wider a
    boundary's errors are from side to side than those of an upright one; `depth` is the rows below the horizon.
    """

    columns: FloatArray
    to_curve: FloatArray
    leaning: FloatArray
    depth: float

    @cached_property
    def coefficients(self) -> FloatArray:
        """The curves' coefficients v, b and k (N, 3)."""
        return np.asarray(self.columns @ self.to_curve.T)


@dataclass(frozen=True)
class Agreement:
    """Shifts (N, 3) of boundaries' columns, with covariances (N, 3, 3), and the road (3,) that they agree on.

    The road is told by its vanishing point's column V, by the rows H that its horizon is lower than the one that
    boundaries are told below, and by its bend K over the depth.
    """

    shifts: FloatArray
    covariances: FloatArray
    road: FloatArray


@dataclass(frozen=True)
class CommonRoad:
    """How strictly boundaries keep to one road; lengths are shares of the depth.

    The v and k of a boundary are those of the road give or take `vanishing` and `bend`; one that is `outlier` times
    that away counts half, because it is of another road, or no boundary. Of the road it is known beforehand that its
    V, H and K are those of the median boundary give or take `usual`.
    """

    vanishing: float = 0.003
    bend: float = 0.0006
    outlier: float = 3.0
    usual: tuple[float, float, float] = (0.1, 0.03, 0.03)

    def begun(self, boundaries: Boundaries) -> Agreement:
        """Boundaries that have not moved, and the road of the median one."""
        v, _, k = np.median(boundaries.coefficients, axis=0)
        road = np.array([v, 0.0, k / boundaries.depth])
        return Agreement(np.zeros_like(boundaries.columns), np.zeros((*boundaries.columns.shape, 3)), road)

    def agree(self, normal: FloatArray, moment: FloatArray, boundaries: Boundaries, last: Agreement) -> Agreement:
        """Boundaries and road fitted together; `last` tells which boundaries are far from the road.

        What each boundary says by itself are the normal equations of its shift: `normal` (N, 3, 3), `moment` (N, 3).
        """
        v, b, k = boundaries.coefficients.T
        # Two ties a boundary: v + its shift = V - b H, and k likewise = K.
        ties = boundaries.to_curve[[0, 2]] / np.array([[1.0], [boundaries.depth]])
        told = np.stack([v, k / boundaries.depth], axis=1)
        shared = np.zeros((len(v), 2, 3))
        shared[:, 0, 0], shared[:, 0, 1], shared[:, 1, 2] = 1.0, -b, 1.0
        sigma = boundaries.depth * boundaries.leaning[:, None] * np.array([self.vanishing, self.bend])
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
