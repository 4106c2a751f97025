"""Where things are: image pixels, the working image, the road region and the strips along candidates.

All transforms of pixels go through `Scaling`, so that no factor is ever loose. Pixel centres are at integers, hence a
resize by s maps x to s (x + 0.5) - 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lanestream.lanes import Candidate, Curve, FloatArray, curve_columns, curve_slopes

T = TypeVar("T", float, FloatArray)

FloatMaps = NDArray[np.float32]


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


@dataclass(frozen=True)
class StripGeometry:
    """How a strip along a candidate is cut: `size` x `size` network pixels, wide in proportion to the road's scale.

    At a row y the strip reaches `half_width` (y - horizon) to either side of its candidate, a constant width on a flat
    road, and never less than `min_half_width` pixels of a 640 pixel wide image. A candidate that leans by `slope`
    columns a row has a strip wider by hypot(1, lean slope): with a `lean` of 1 strips are equally wide across their
    candidates, as errors are counted across them; with 0 they are equally wide on the ground.
    """

    size: int = 112
    half_width: float = 0.33
    min_half_width: float = 4.0
    lean: float = 1.0

    @property
    def detail_width(self) -> int:
        """How wide an image may be before the near rows of its strips alias: that of 640 pixels for patches of 112."""
        return self.size * 40 // 7

    def grids(self, candidates: Sequence[Candidate], view: RoadView) -> tuple[FloatMaps, FloatMaps]:
        """Image columns and rows, each (N, size, size), that the pixels of the candidates' patches are sampled at."""
        top, bottom = np.array([(candidate.top, candidate.bottom) for candidate in candidates]).T[:, :, None]
        rows = top + (bottom - top) * np.linspace(0.0, 1.0, self.size)
        curves = [candidate.curve for candidate in candidates]
        slope = curve_slopes(curves, 0.5 * (top + bottom))
        least = self.min_half_width * view.width / 640.0
        half_widths = np.hypot(1.0, self.lean * slope) * np.maximum(self.half_width * (rows - view.horizon), least)
        across = np.linspace(-1.0, 1.0, self.size, dtype=np.float32)
        columns = half_widths.astype(np.float32)[:, :, None] * across
        columns += curve_columns(curves, rows).astype(np.float32)[:, :, None]
        return columns, np.broadcast_to(rows.astype(np.float32)[:, :, None], columns.shape)


@dataclass(frozen=True)
class CanvasGeometry:
    """The canonical picture of a road: `size` x `size` network pixels in which the horizon has a fixed place.

    Its rows run from `above` of the depth over the horizon down to the bottom of the image. Its columns reach half the
    image's width to either side of the middle at the bottom and `narrowest` of that at the horizon: what is far away is
    small, and shown larger.
    """

    size: int = 224
    above: float = 0.12
    narrowest: float = 0.6

    def grid(self, view: RoadView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image (columns, rows) that the canvas pixels are sampled at, each (size, size)."""
        shares = np.linspace(-self.above, 1.0, self.size)
        reach = 0.5 * view.width * (self.narrowest + (1.0 - self.narrowest) * np.maximum(shares, 0.0))
        across = np.linspace(-1.0, 1.0, self.size)
        columns = (view.width - 1) / 2.0 + reach[:, None] * across[None, :]
        return columns, np.broadcast_to(view.row_at(0.0) + shares[:, None] * view.depth, columns.shape)
