"""Where boundaries are to be expected once the ego lane is known: roads repeat their lanes.

Told in slopes at the bottom row, columns a row from the vanishing point, which on a flat road are metres over camera
heights: there lanes are equally wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray

# Lanes are 2.5 to 4.5 m wide and cameras 1 to 2.4 m high; what is usual stands in where one boundary was seen alone.
USUAL_WIDTH: Final = 2.4
_NARROWEST, _WIDEST = 1.2, 4.5


@dataclass(frozen=True)
class LaneSpacing:
    """The ego lane's boundaries as slopes, `left` and `right`, from which others are whole lanes away.

    A line off a place of the lattice by `spread` lane widths counts less, down to `least`; places beyond the next
    lanes count `outer`.
    """

    left: float
    right: float
    spread: float = 0.12
    least: float = 0.3
    outer: float = 0.6

    @classmethod
    def of(cls, left: float | None, right: float | None) -> LaneSpacing:
        """The lattice of one or two boundaries; the missing one is a usual lane away."""
        if left is not None:
            return cls(left, right if right is not None else left + USUAL_WIDTH)
        if right is not None:
            return cls(right - USUAL_WIDTH, right)
        raise ValueError("a lattice needs a boundary")

    @property
    def width(self) -> float:
        """The lane width; that of a lane which can't be one is brought to what lanes are."""
        return min(max(self.right - self.left, _NARROWEST), _WIDEST)

    @property
    def neighbours(self) -> tuple[float, float]:
        """The next boundaries out on both sides."""
        return self.left - self.width, self.right + self.width

    def trust(self, slopes: FloatArray) -> FloatArray:
        """How likely lines with these slopes (N,) are boundaries, from 0 to 1, judged by their places alone."""
        is_left = slopes < 0.5 * (self.left + self.right)
        beyond = np.where(is_left, self.left - slopes, slopes - self.right) / self.width
        lanes = np.maximum(0.0, np.rint(beyond))
        near = np.exp(-0.5 * ((beyond - lanes) / self.spread) ** 2)
        trust: FloatArray = (self.least + (1.0 - self.least) * near) * np.where(lanes <= 1.0, 1.0, self.outer)
        return trust
