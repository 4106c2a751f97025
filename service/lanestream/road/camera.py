"""A camera over a flat road, and curves of its image in metres on that road."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lanestream.road.curve import Curve


@dataclass(frozen=True)
class Camera:
    """A camera over a flat road: `height` in metres, the horizontal `field_of_view` of its whole image in degrees."""

    height: float
    field_of_view: float

    def focal_length(self, width: int) -> float:
        """The focal length in pixels of an image `width` pixels wide."""
        return width / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))

    def ground(self, curve: Curve, width: int) -> tuple[float, float, float]:
        """The curve on the road: (a, b, c) of Y = a X^2 + b X + c in metres, X forward and Y left of the camera.

        `curve` is in pixels of an image `width` pixels wide, whose middle column cx looks straight ahead. With the
        focal length f, similar triangles put what is u rows below the horizon at X = f height / u, and what is x - cx
        columns to the right there at Y = -(x - cx) height / u. With x = v + b u + k / u and 1 / u = X / (f height),

            Y = -k / (f^2 height) X^2 - (v - cx) / f X - b height.

        The camera is taken to look level. For one that is pitched by p, widths are really 1 / cos p of these: half a
        per cent more at six degrees.
        """
        v, b, k = curve.coefficients
        focal = self.focal_length(width)
        return -k / (focal**2 * self.height), ((width - 1) / 2.0 - v) / focal, -b * self.height
