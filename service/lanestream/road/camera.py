"""A camera over a flat road, and the curves of its image in meters on that road."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lanestream.road.curve import Curve


@dataclass(frozen=True)
class Camera:
    """A camera over a flat road: `height` in meters, the horizontal `field_of_view` of its whole image in degrees."""

    height: float
    field_of_view: float

    def focal_length(self, width: int) -> float:
        """Returns the focal length in pixels of an image `width` pixels wide."""
        return width / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))

    def ground(self, curve: Curve, width: int) -> tuple[float, float, float]:
        """Returns the curve on the road, (a, b, c) of Y = a X^2 + b X + c in meters, X forward, Y left of the camera.

        `curve` is in pixels of an image `width` pixels wide, whose middle column cx looks straight ahead. With the
        focal length f, similar triangles put a point u rows below the horizon at X = f height / u, and a point x - cx
        columns to the right of the middle at Y = -(x - cx) height / u. With x = v + b u + k / u and
        1 / u = X / (f height),

            Y = -k / (f^2 height) X^2 - (v - cx) / f X - b height.

        This assumes a level camera. For a pitch p, true widths are 1 / cos p of these: half a percent more at six
        degrees.
        """
        v, b, k = curve.coefficients
        focal = self.focal_length(width)
        return -k / (focal**2 * self.height), ((width - 1) / 2.0 - v) / focal, -b * self.height
