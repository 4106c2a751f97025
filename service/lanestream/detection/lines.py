"""Lines of one frame on their way to candidates: joined, ranked, and those left out that follow a better one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curve, FloatArray, curve_columns, under_horizon
from lanestream.road.view import RoadView, Scaling

# The two rows, as shares of the depth, at which lines are told, compared and suppressed.
NEAR: Final = 1.0
FAR: Final = 0.45


def told_rows(view: RoadView) -> FloatArray:
    """The near and the far row (2,) of a view."""
    return np.array([view.row_at(NEAR), view.row_at(FAR)])


@dataclass(frozen=True)
class Lines:
    """Lines of the working image by their columns (N,) at the `near` and the `far` row, and their `strength` (N,).

    `curves` are their curves in image pixels, None for those that are known by their two columns alone.
    """

    near: FloatArray
    far: FloatArray
    strength: FloatArray
    curves: tuple[Curve | None, ...]

    @classmethod
    def told(cls, near: FloatArray, far: FloatArray, strength: FloatArray) -> Lines:
        """Lines that are known by their columns alone."""
        return cls(near, far, strength, (None,) * len(near))

    @classmethod
    def along(cls, curves: Sequence[Curve], scaling: Scaling, view: RoadView) -> Lines:
        """Curves of the image as lines of the working image, all of strength 1, told from the view's horizon."""
        working = under_horizon([scaling.curve_to_working(curve) for curve in curves], view.horizon, view.bottom)
        near, far = curve_columns(working, told_rows(view)).T
        return cls(near, far, np.ones(len(curves)), tuple(scaling.curve_to_image(curve) for curve in working))

    @classmethod
    def joined(cls, parts: Sequence[Lines]) -> Lines:
        """The lines of all `parts`, one after the other."""
        near = np.concatenate([np.empty(0), *(part.near for part in parts)])
        far = np.concatenate([np.empty(0), *(part.far for part in parts)])
        strength = np.concatenate([np.empty(0), *(part.strength for part in parts)])
        return cls(near, far, strength, tuple(curve for part in parts for curve in part.curves))

    def taken(self, order: NDArray[np.intp]) -> Lines:
        """The lines at the places `order`, in that order."""
        curves = tuple(self.curves[i] for i in order.tolist())
        return Lines(self.near[order], self.far[order], self.strength[order], curves)

    def weighed(self, weights: FloatArray) -> Lines:
        """The same, each one's strength times its weight (N,)."""
        return replace(self, strength=self.strength * weights)

    def strong(self, least: float) -> Lines:
        """Those whose strength is at least `least`."""
        return self.taken(np.flatnonzero(self.strength >= least))

    @property
    def normalised(self) -> Lines:
        """The same, with the strongest one's strength as 1."""
        return replace(self, strength=self.strength / self.strength.max()) if len(self.strength) else self

    @property
    def ranked(self) -> Lines:
        """The same, strongest first."""
        return self.taken(np.argsort(-self.strength, kind="stable"))

    def follow(self, others: Lines, separation: float, view: RoadView) -> NDArray[np.bool_]:
        """For each line (N, M), which of the `others` are nearer to it than `separation`, in rows below the horizon.

        Lines that are so near at both rows follow the same marking. Flat lines lie closer to each other than their
        columns tell, so the distance is measured across the other one.
        """
        slope = (others.near - others.far) / ((NEAR - FAR) * view.depth)
        least = separation * view.depth * np.hypot(1.0, slope)
        near = np.abs(self.near[:, None] - others.near) < NEAR * least
        return np.asarray(near & (np.abs(self.far[:, None] - others.far) < FAR * least))

    def apart(self, separation: float, view: RoadView) -> NDArray[np.intp]:
        """Places of the lines that keep `separation` from all that are kept before them; see `follow`."""
        same = self.follow(self, separation, view)
        free = np.ones(len(self.near), bool)
        kept = []
        for i in range(len(free)):
            if free[i]:
                kept.append(i)
                free &= ~same[i]
        return np.array(kept, np.intp)
