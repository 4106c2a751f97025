"""Bars along a curve: narrow bright stretches of its rows, which markings are, seen in a strip that is cut along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.features import paint_grey
from lanestream.road.curve import Curve, FloatArray, curve_columns
from lanestream.road.view import Image, RoadView, Scaling, visible_spans

# hypot(1, slope) of an ego boundary: half a lane of 3.6 m beside a camera 1.45 m high.
USUAL_LEANING: Final = 1.6

# A strip's best bars are those of the best tenth of its rows.
_BEST_ROWS: Final = 0.1


@dataclass(frozen=True)
class Along:
    """The rows (N, R) `y` along `curves`, the curves' columns `x` there, how far `below` the horizon they are.

    `leaning` (N,) is how much wider a candidate's errors are from side to side than those of one that leans as ego
    boundaries do.
    """

    curves: tuple[Curve, ...]
    y: FloatArray
    x: FloatArray
    below: FloatArray
    leaning: FloatArray

    @classmethod
    def of(cls, curves: Sequence[Curve], spans: Sequence[tuple[float, float]], view: RoadView, rows: int) -> Along:
        """`rows` rows along each of the `curves`, between the rows (top, bottom) of its span."""
        top, bottom = np.array(spans).T
        y = np.linspace(top, bottom, rows, axis=1)
        slope = [float(curve.slope(middle)) for curve, middle in zip(curves, 0.5 * (top + bottom), strict=True)]
        leaning = np.maximum(1.0, np.hypot(1.0, slope) / USUAL_LEANING)
        return cls(tuple(curves), y, curve_columns(curves, y), y - view.horizon, leaning)

    def places(self, x: FloatArray) -> FloatArray:
        """Where the columns `x` (N, R) are in the strips: beside the curves, in rows below the horizon by leaning."""
        return (x - self.x) / (self.below * self.leaning[:, None])

    def columns(self, places: FloatArray) -> FloatArray:
        """The columns (N, R) that are at `places` in the strips."""
        return self.x + places * self.below * self.leaning[:, None]


@dataclass(frozen=True)
class BarSearch:
    """The search's settings; all widths are shares of the rows below the horizon, as everything on the road is.

    A strip reaches `reach` to either side in `cells` cells on `rows` rows, from the bottom up to `top_share` of the
    depth; markings are about as wide as one of `widths`, and a bar is weighed against `fair` times the strip's best
    ones. Strips of leaning curves are wider, see `Along`.
    """

    reach: float = 0.16
    cells: int = 97
    rows: int = 48
    top_share: float = 0.06
    widths: tuple[float, ...] = (0.05, 0.1, 0.17)
    fair: float = 0.4

    def along(self, curves: Sequence[Curve], spans: Sequence[tuple[float, float]], view: RoadView) -> Along:
        """The rows of the strips along `curves`, within what is in view of them, else within their `spans`."""
        visible = visible_spans(curves, view, self.top_share)
        return Along.of(curves, [seen or span for seen, span in zip(visible, spans, strict=True)], view, self.rows)

    def across(self) -> NDArray[np.float32]:
        """Where a strip's cells (cells,) are beside its curve, in rows below the horizon times its leaning."""
        return np.linspace(-self.reach, self.reach, self.cells, dtype=np.float32)

    def find(self, detail: Image, scaling: Scaling, along: Along) -> NDArray[np.float32]:
        """Contrast of bars (N, rows, cells), 0 to 1, along curves of the image that `scaling` reduced to `detail`."""
        strips = zip(self._strips(detail, scaling, along), along.leaning, strict=True)
        return np.stack([self._bars(strip, leaning) for strip, leaning in strips])

    def _strips(self, detail: Image, scaling: Scaling, along: Along) -> NDArray[np.float32]:
        """Grey levels (N, rows, cells) of the strip along each curve."""
        reach = (along.below * along.leaning[:, None] * scaling.factor).astype(np.float32)
        columns = scaling.to_working(along.x).astype(np.float32)[:, :, None] + reach[:, :, None] * self.across()
        rows = np.broadcast_to(scaling.to_working(along.y).astype(np.float32)[:, :, None], columns.shape)
        warped = cv2.remap(
            detail,
            columns.reshape(-1, self.cells),
            rows.reshape(-1, self.cells),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return paint_grey(np.asarray(warped, np.uint8)).astype(np.float32).reshape(columns.shape)

    def _bars(self, strip: NDArray[np.float32], leaning: float) -> NDArray[np.float32]:
        """Bar contrast (rows, cells), 0 to 1, of a strip."""
        contrast = self._contrast(strip, self.widths[0] / leaning)
        for width in self.widths[1:]:
            np.maximum(contrast, self._contrast(strip, width / leaning), out=contrast)
        # Five grey levels above its own row's unrest is a bar that an eye would see. Squared: a few bright dots count
        # for more than a wheel track that is a little lighter all along.
        unrest = np.abs(contrast).mean(axis=1, keepdims=True)
        place = int((1.0 - _BEST_ROWS) * (len(contrast) - 1))
        best = max(0.0, float(np.partition(contrast.max(axis=1), place)[place]))
        bars = np.clip((contrast - unrest) / (unrest + 5.0 + self.fair * best), 0.0, 1.0)
        return np.asarray(bars * bars, dtype=np.float32)

    def _contrast(self, strip: NDArray[np.float32], width: float) -> NDArray[np.float32]:
        """How much brighter a bar is than the brighter one of its neighbours of the same width."""
        cells = max(1, round(width / (2 * self.reach) * self.cells)) | 1
        mean = cv2.blur(strip, (cells, 1))
        sides = cv2.copyMakeBorder(mean, 0, 0, cells, cells, cv2.BORDER_REPLICATE)
        return np.asarray(mean - np.maximum(sides[:, : -2 * cells], sides[:, 2 * cells :]), dtype=np.float32)
