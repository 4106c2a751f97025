"""Sub-pixel refinement: a candidate's curve moved onto the paint beneath it, with what the fit is worth.

The strip along the candidate is searched for a narrow bright bar row by row, and the curve is pulled onto the bars by
reweighted least squares. Where the paint is missing, or shows no bend, the candidate's own line is the prior, and so is
the road that it shares with the others: a dashed marking keeps its direction, and far ends meet at one point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.commonroad import Boundaries, CommonRoad
from lanestream.detection.edges import paint_grey, resized
from lanestream.geometry import RoadView, Scaling, visible_spans
from lanestream.lanes import Candidate, Curve, FloatArray, Image, curve_basis, curve_columns, curves_through

# hypot(1, slope) of an ego boundary: half a lane of 3.6 m beside a camera 1.45 m high.
USUAL_LEANING: Final = 1.6

# A strip's best bars are those of the best tenth of its rows.
_BEST_ROWS: Final = 0.1

# Nearer to the horizon than this, in depths, a bend has no bounds, and paint tells nothing of it.
_FARTHEST: Final = 0.04


@dataclass(frozen=True)
class Fit:
    """A refined curve in image pixels and the covariance (3, 3) of its coefficients."""

    curve: Curve
    covariance: FloatArray


@dataclass(frozen=True)
class Refinement:
    """The fit's settings; all widths are shares of the rows below the horizon, as everything on the road is.

    The strip reaches `reach` to either side in `cells` cells on `rows` rows, from the bottom up to `top_share` of the
    depth; markings are about as wide as one of `bars`, and a bar is weighed against `fair` times the strip's best ones.
    The curve is told by its columns at the depths `anchors`, where the candidate may be off by about `doubt`. A bar's
    centre on one row is good to `noise` pixels of a 640 pixel wide image plus `blur` of the rows below the horizon.
    Leaning candidates err more from side to side for the same distance across: for them `reach`, `doubt` and `steps`,
    the distances at which bars lose half their weight, are wider. All candidates are held to one `road`.
    """

    reach: float = 0.16
    cells: int = 97
    rows: int = 48
    top_share: float = 0.06
    bars: tuple[float, ...] = (0.05, 0.1, 0.17)
    fair: float = 0.4
    anchors: tuple[float, float, float] = (1.0, 0.45, 0.15)
    doubt: tuple[float, float, float] = (0.03, 0.02, 0.1)
    noise: float = 1.0
    blur: float = 0.012
    steps: tuple[float, ...] = (0.06, 0.045, 0.03)
    road: CommonRoad = CommonRoad()
    detail_width: int = 640

    def refine(
        self, image: Image, candidates: Sequence[Candidate], view: RoadView, doubts: FloatArray | None = None
    ) -> tuple[list[Fit], RoadView]:
        """A fit for each candidate of a BGR image (H, W, 3), and `view` with the horizon that they agree on.

        `doubts` (N, 3) are how far off each candidate may be at the `anchors`, in pixels, where that is known.
        """
        if not candidates:
            return [], view
        curves = [candidate.curve for candidate in candidates]
        spans = [
            span or (candidate.top, candidate.bottom)
            for span, candidate in zip(visible_spans(curves, view, self.top_share), candidates, strict=True)
        ]
        along = _Along.of(curves, spans, view, self.rows)
        strips = self._strips(image, along, view)
        bars = [self._bars(strip, leaning) for strip, leaning in zip(strips, along.leaning, strict=True)]
        if doubts is None:
            doubts = along.leaning[:, None] * np.asarray(self.doubt) * view.depth
        return self._fits(along, np.stack(bars), view, doubts)

    def _strips(self, image: Image, along: _Along, view: RoadView) -> NDArray[np.float32]:
        """Grey levels (N, rows, cells) of the strip along each curve."""
        scaling = Scaling(min(1.0, self.detail_width / view.width))
        reach = (along.below * along.leaning[:, None] * scaling.factor).astype(np.float32)
        columns = scaling.to_working(along.x).astype(np.float32)[:, :, None] + reach[:, :, None] * self._across()
        rows = np.broadcast_to(scaling.to_working(along.y).astype(np.float32)[:, :, None], columns.shape)
        warped = cv2.remap(
            resized(image, scaling),
            columns.reshape(-1, self.cells),
            rows.reshape(-1, self.cells),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return paint_grey(np.asarray(warped, np.uint8)).astype(np.float32).reshape(columns.shape)

    def _across(self) -> NDArray[np.float32]:
        """Where a strip's cells (cells,) are beside its candidate, in rows below the horizon times its leaning."""
        return np.linspace(-self.reach, self.reach, self.cells, dtype=np.float32)

    def _bars(self, strip: NDArray[np.float32], leaning: float) -> NDArray[np.float32]:
        """Bar contrast (rows, cells), 0 to 1, of a strip."""
        contrast = self._contrast(strip, self.bars[0] / leaning)
        for bar in self.bars[1:]:
            np.maximum(contrast, self._contrast(strip, bar / leaning), out=contrast)
        # Five grey levels above its own row's unrest is a bar that an eye would see. Squared: a few bright dots count
        # for more than a wheel track that is a little lighter all along.
        unrest = np.abs(contrast).mean(axis=1, keepdims=True)
        place = int((1.0 - _BEST_ROWS) * (len(contrast) - 1))
        best = max(0.0, float(np.partition(contrast.max(axis=1), place)[place]))
        bars = np.clip((contrast - unrest) / (unrest + 5.0 + self.fair * best), 0.0, 1.0)
        return np.asarray(bars * bars, dtype=np.float32)

    def _contrast(self, strip: NDArray[np.float32], bar: float) -> NDArray[np.float32]:
        """How much brighter a bar is than the brighter one of its neighbours of the same width."""
        width = max(1, round(bar / (2 * self.reach) * self.cells)) | 1
        mean = cv2.blur(strip, (width, 1))
        sides = cv2.copyMakeBorder(mean, 0, 0, width, width, cv2.BORDER_REPLICATE)
        return np.asarray(mean - np.maximum(sides[:, : -2 * width], sides[:, 2 * width :]), dtype=np.float32)

    def _fits(
        self, along: _Along, bars: NDArray[np.float32], view: RoadView, doubts: FloatArray
    ) -> tuple[list[Fit], RoadView]:
        """Columns at the anchor rows by least squares with the curves so far, and the road they share, as the prior."""
        anchors = view.horizon + np.asarray(self.anchors) * view.depth
        columns = curve_columns(along.curves, anchors)
        boundaries = Boundaries(columns, anchors, view.horizon, view.horizon, along.leaning, view.depth)
        prior = np.eye(3) / doubts[:, None] ** 2
        # Sums over a strip's cells, and sums of where they are, in one product.
        sums = np.stack([np.ones(self.cells, np.float32), self._across()], axis=1)
        found, normal = self.road.begun(boundaries), prior
        for reach in self.steps:
            basis = curve_basis(boundaries.horizon, along.y) @ boundaries.to_curve
            seen = along.places((basis @ (columns + found.shifts)[:, :, None])[:, :, 0])
            off = (self._across() - seen.astype(np.float32)[:, :, None]) * np.float32(1.0 / reach)
            total, moment = np.moveaxis((bars / (1.0 + off * off) ** 2) @ sums, 2, 0).astype(np.float64)
            away = along.columns(moment / np.maximum(total, 1e-6)) - (basis @ columns[:, :, None])[:, :, 0]
            # A row counts once, however wide its bar; a row without a bar does not count.
            trust = np.minimum(total / 2.0, 1.0) * (along.y - boundaries.horizon > _FARTHEST * view.depth)
            trusted = basis.swapaxes(1, 2) * (trust / self._sigma(along, view) ** 2)[:, None]
            normal = prior + trusted @ basis
            found = self.road.agree(normal, (trusted @ away[:, :, None])[:, :, 0], boundaries, found)
            boundaries, found = self.road.nodded(boundaries, found)
        # Neighbouring rows share their errors: about four of them are worth one.
        worth = self.road.agree(prior + (normal - prior) / 4.0, np.zeros_like(found.shifts), boundaries, found)
        covariances = boundaries.to_curve @ worth.covariances @ boundaries.to_curve.T
        curves = curves_through(boundaries.horizon, anchors, columns + found.shifts)
        fits = [Fit(curve, covariance) for curve, covariance in zip(curves, covariances, strict=True)]
        return fits, replace(view, horizon=boundaries.horizon)

    def _sigma(self, along: _Along, view: RoadView) -> FloatArray:
        """How exactly a bar's centre is known on each row (N, R), in pixels."""
        return self.noise * view.width / 640.0 + self.blur * along.below


@dataclass(frozen=True)
class _Along:
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
    def of(cls, curves: Sequence[Curve], spans: Sequence[tuple[float, float]], view: RoadView, rows: int) -> _Along:
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
