"""The camera of a rendered scene: a level pinhole whose horizon may lie anywhere in the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera over the road, in the vehicle frame (metres, x forward, y left, z up from the road).

    The picture plane stays upright and pitch only moves the horizon, as a shift lens does. Every image row then sees
    one distance x of the road, which makes the inverse mapping a matter of one value a row. For the few degrees of
    pitch a dash camera has, the difference from a tilted picture plane is below the spread of real lenses.
    """

    width: int  # pixels
    height: int  # pixels
    field_of_view: float  # horizontal, degrees
    mount: float  # height of the lens above the road, metres
    horizon: float  # image row of the road's vanishing plane, pixels

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))

    @property
    def centre(self) -> float:
        """Image column of the optical axis, pixels."""
        return (self.width - 1) / 2.0

    def columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Image columns of points at forward distance x and lateral position y, metres."""
        return self.centre - self.focal * y / x

    def rows(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """Image rows of points at forward distance x and height z, metres."""
        return self.horizon + self.focal * (self.mount - z) / x

    def road_distance(self, rows: FloatArray, bend: float) -> FloatArray:
        """Forward distance x in metres of the road seen at each image row.

        The road surface is z = bend x^2 / 2, so x solves bend x^2 / 2 + (row - horizon) x / focal - mount = 0.
        Rows that see no road give infinity.
        """
        slope = (rows - self.horizon) / self.focal
        root = slope**2 + 2.0 * bend * self.mount
        denominator = slope + np.sqrt(np.maximum(root, 0.0))
        seen = (root >= 0.0) & (denominator > 1e-6)
        return np.where(seen, 2.0 * self.mount / np.where(seen, denominator, 1.0), np.inf)

    def road_reach(self, bend: float, limit: float) -> float:
        """Farthest visible forward distance x of the road in metres: its crest where it has one, else `limit`."""
        if bend >= 0.0:
            return limit
        return min(limit, math.sqrt(2.0 * self.mount / -bend))
