"""Images and the part of them that can be road: working images, rows below the horizon, the rows a curve is in view.

All resizing of coordinates goes through `Scaling`. Pixel centres are at integers, so a resize by s maps x to
s (x + 0.5) - 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curve, FloatArray, curve_columns

Image = NDArray[np.uint8]
T = TypeVar("T", float, FloatArray)


@dataclass(frozen=True)
class Scaling:
    """A uniform resize from image pixels to working pixels; `factor` is working size over image size."""

    factor: float

    def to_working(self, value: T) -> T:
        """Image columns or rows, in working pixels."""
        return (value + 0.5) * self.factor - 0.5

    def to_image(self, value: T) -> T:
        """Working columns or rows, in image pixels."""
        return (value + 0.5) / self.factor - 0.5

    def curve_to_image(self, curve: Curve) -> Curve:
        """A working curve, in image pixels."""
        v, b, k = curve.coefficients
        return Curve(self.to_image(curve.horizon), (self.to_image(v), b, k / self.factor**2))

    def covariance_to_image(self, covariance: FloatArray) -> FloatArray:
        """The covariance (3, 3) of a working curve's coefficients, of those in image pixels."""
        by = np.array([1.0 / self.factor, 1.0, 1.0 / self.factor**2])
        return covariance * np.outer(by, by)

    def curve_to_working(self, curve: Curve) -> Curve:
        """An image curve, in working pixels."""
        v, b, k = curve.coefficients
        return Curve(self.to_working(curve.horizon), (self.to_working(v), b, k * self.factor**2))


@dataclass(frozen=True)
class RoadView:
    """What of an image can be road: all below the horizon. Sizes and rows in pixels of that image."""

    width: int
    height: int
    horizon: float

    @property
    def bottom(self) -> float:
        """The lowest row."""
        return self.height - 1.0

    @property
    def depth(self) -> float:
        """Rows between the horizon and the bottom: the scale of everything on the road."""
        return self.bottom - self.horizon

    def scaled(self, scaling: Scaling, width: int, height: int) -> RoadView:
        """The same view of the working image, which is `width` x `height`."""
        return RoadView(width, height, scaling.to_working(self.horizon))

    def row_at(self, share: float) -> float:
        """The row at `share` of the way from the horizon (0) to the bottom (1)."""
        return self.horizon + share * self.depth


def visible_rows(curve: Curve, view: RoadView, top_share: float) -> tuple[float, float] | None:
    """The (top, bottom) rows between which `curve` is inside the image and `top_share` of the depth below the horizon.

    None where fewer than two rows of it are in view. Where a bent curve leaves and comes back, the part that begins
    nearest to the camera counts.
    """
    return visible_spans([curve], view, top_share)[0]


def visible_spans(curves: Sequence[Curve], view: RoadView, top_share: float) -> list[tuple[float, float] | None]:
    """`visible_rows` of each of the `curves`, at once."""
    rows = np.linspace(view.bottom, view.row_at(top_share), 65)
    columns = curve_columns(curves, rows)
    inside = (columns >= 0.0) & (columns <= view.width - 1.0)
    first = inside.argmax(axis=1)
    left = ~inside & (np.arange(len(rows)) > first[:, None])
    last = np.where(left.any(axis=1), left.argmax(axis=1), len(rows)) - 1
    spans = zip(rows[last].tolist(), rows[first].tolist(), strict=True)
    # Of a curve that is nowhere inside, the span is its first row alone.
    return [(top, bottom) if bottom - top >= 2.0 else None for top, bottom in spans]
