"""How network inputs are sampled from an image: patches along candidates, and the crop of the whole road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curves
from lanestream.road.view import WORKING_WIDTH, RoadView, Scaling, Spans

FloatMap = NDArray[np.float32]


@dataclass(frozen=True)
class PatchGeometry:
    """How a patch along a candidate is sampled: `size` x `size` network pixels, with the road's scale in each row.

    At a row y a patch reaches `half_width` (y - horizon) to either side of its candidate, a constant width on a flat
    road, and never less than `min_half_width` pixels of a working image. If the candidate has the slope s, its patch is
    wider by hypot(1, `obliquity` s): with 1 all patches are equally wide across their candidates, as errors are
    measured; with 0 they are equally wide on the ground.
    """

    size: int = 112
    half_width: float = 0.33
    min_half_width: float = 4.0
    obliquity: float = 1.0

    def __post_init__(self) -> None:
        if self.size < 1 or min(self.half_width, self.min_half_width) <= 0.0 or self.obliquity < 0.0:
            raise ValueError("size, half_width and min_half_width must be positive, obliquity at least 0")

    def grids(self, curves: Curves, spans: Spans, view: RoadView) -> tuple[FloatMap, FloatMap]:
        """Returns the image columns and rows, each (N, size, size), at which the pixels of N patches are sampled."""
        top, bottom = spans.top[:, None], spans.bottom[:, None]
        rows = top + (bottom - top) * np.linspace(0.0, 1.0, self.size)
        slope = curves.slope(0.5 * (top + bottom))
        least = self.min_half_width * view.width / WORKING_WIDTH
        half_widths = np.hypot(1.0, self.obliquity * slope) * np.maximum(self.half_width * (rows - view.horizon), least)
        across = np.linspace(-1.0, 1.0, self.size, dtype=np.float32)
        columns = half_widths.astype(np.float32)[:, :, None] * across
        columns += curves.x(rows).astype(np.float32)[:, :, None]
        return columns, np.broadcast_to(rows.astype(np.float32)[:, :, None], columns.shape)


@dataclass(frozen=True)
class RoadCropGeometry:
    """The crop of the whole road: `size` x `size` network pixels in which the horizon always has the same row.

    Its rows run from `above` of the depth over the horizon down to the bottom of the image. Its columns reach half the
    image's width to either side of the middle at the bottom and `narrowest` of that at the horizon, which magnifies
    distant road. Images are reduced to `detail_width` before they are warped, so that near rows do not alias.
    """

    size: int = 224
    above: float = 0.12
    narrowest: float = 0.6
    detail_width: int = 448

    def __post_init__(self) -> None:
        if min(self.size, self.detail_width) < 1 or self.above < 0.0 or not 0.0 < self.narrowest <= 1.0:
            raise ValueError(
                "size and detail_width must be positive, above at least 0, narrowest above 0 and at most 1"
            )

    def grid(self, view: RoadView, scaling: Scaling = Scaling(1.0)) -> tuple[FloatMap, FloatMap]:  # noqa: B008
        """Returns the columns and rows, each (size, size), at which the pixels of the crop are sampled.

        They are in pixels of the view's image, or of that image resized by `scaling`.
        """
        shares = np.linspace(-self.above, 1.0, self.size)
        reach = 0.5 * view.width * (self.narrowest + (1.0 - self.narrowest) * np.maximum(shares, 0.0))
        across = np.linspace(-1.0, 1.0, self.size, dtype=np.float32)
        columns = (scaling.factor * reach).astype(np.float32)[:, None] * across
        columns += np.float32(scaling.to_working(view.middle))
        rows = scaling.to_working(view.horizon + shares * view.depth).astype(np.float32)[:, None]
        return columns, np.broadcast_to(rows, columns.shape)
