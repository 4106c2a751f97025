"""Sub-pixel refinement: a candidate's curve moved onto the paint beneath it, with what the fit is worth.

The strip along the candidate is searched for a narrow bright bar row by row, and the curve is pulled onto the bars by
reweighted least squares. Where the paint is missing, or shows no bend, the candidate's own line is the prior, and so is
the road that it shares with the others: a dashed marking keeps its direction, and far ends meet at one point. A fit on
one stripe of a double line is moved to between the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.bars import Along, BarSearch
from lanestream.detection.commonroad import Boundaries, CommonRoad
from lanestream.detection.doubles import DoubleLines
from lanestream.detection.features import resized
from lanestream.road.curve import Curve, FloatArray, curve_basis, curve_columns, curves_through
from lanestream.road.results import Candidate
from lanestream.road.view import Image, RoadView, Scaling

# Nearer to the horizon than this, in depths, a bend has no bounds, and paint tells nothing of it.
_FARTHEST: Final = 0.04


@dataclass(frozen=True)
class Fit:
    """A refined curve in image pixels and the covariance (3, 3) of its coefficients."""

    curve: Curve
    covariance: FloatArray

    def moved(self, by: float) -> Fit:
        """The fit moved to the right by `by` times its rows below the horizon: on the ground everywhere as far."""
        v, b, k = self.curve.coefficients
        return replace(self, curve=replace(self.curve, coefficients=(v, b + by, k)))


@dataclass(frozen=True)
class Refinement:
    """The fit's settings; all widths are shares of the rows below the horizon, as everything on the road is.

    `bars` are searched for along the candidate. The curve is told by its columns at the depths `anchors`, where the
    candidate may be off by about `doubt`. A bar's centre on one row is good to `noise` pixels of a 640 pixel wide image
    plus `blur` of the rows below the horizon. Leaning candidates err more from side to side for the same distance
    across: for them `doubt` and `steps`, the distances at which bars lose half their weight, are wider. All candidates
    are held to one `road`, and those on one of the `doubles` to its middle. Images wider than `detail_width` are
    reduced to it.
    """

    bars: BarSearch = BarSearch()
    anchors: tuple[float, float, float] = (1.0, 0.45, 0.15)
    doubt: tuple[float, float, float] = (0.03, 0.02, 0.1)
    noise: float = 1.0
    blur: float = 0.012
    steps: tuple[float, ...] = (0.06, 0.045, 0.03)
    road: CommonRoad = CommonRoad()
    doubles: DoubleLines = DoubleLines()
    detail_width: int = 640

    def refine(
        self, image: Image, candidates: Sequence[Candidate], view: RoadView, doubts: FloatArray | None = None
    ) -> tuple[list[Fit], RoadView]:
        """A fit for each candidate of a BGR image (H, W, 3), and `view` with the horizon that they agree on.

        `doubts` (N, 3) are how far off each candidate may be at the `anchors`, in pixels, where that is known.
        """
        if not candidates:
            return [], view
        scaling = Scaling(min(1.0, self.detail_width / view.width))
        detail = resized(image, scaling)
        spans = [(candidate.top, candidate.bottom) for candidate in candidates]
        along = self.bars.along([candidate.curve for candidate in candidates], spans, view)
        if doubts is None:
            doubts = along.leaning[:, None] * np.asarray(self.doubt) * view.depth
        fits, view = self._fits(along, self.bars.find(detail, scaling, along), view, doubts)
        along = self.doubles.bars.along([fit.curve for fit in fits], spans, view)
        stripes = self.doubles.bars.find(detail, scaling, along)
        beside = [self.doubles.middle(bars) * leaning for bars, leaning in zip(stripes, along.leaning, strict=True)]
        return [fit.moved(by) for fit, by in zip(fits, beside, strict=True)], view

    def _fits(
        self, along: Along, bars: NDArray[np.float32], view: RoadView, doubts: FloatArray
    ) -> tuple[list[Fit], RoadView]:
        """Columns at the anchor rows by least squares with the curves so far, and the road they share, as the prior."""
        anchors = view.horizon + np.asarray(self.anchors) * view.depth
        columns = curve_columns(along.curves, anchors)
        boundaries = Boundaries(columns, anchors, view.horizon, view.horizon, along.leaning, view.depth)
        prior = np.eye(3) / doubts[:, None] ** 2
        # Sums over a strip's cells, and sums of where they are, in one product.
        sums = np.stack([np.ones(self.bars.cells, np.float32), self.bars.across()], axis=1)
        found, normal = self.road.begun(boundaries), prior
        for reach in self.steps:
            basis = curve_basis(boundaries.horizon, along.y) @ boundaries.to_curve
            seen = along.places((basis @ (columns + found.shifts)[:, :, None])[:, :, 0])
            off = (self.bars.across() - seen.astype(np.float32)[:, :, None]) * np.float32(1.0 / reach)
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

    def _sigma(self, along: Along, view: RoadView) -> FloatArray:
        """How exactly a bar's centre is known on each row (N, R), in pixels."""
        return self.noise * view.width / 640.0 + self.blur * along.below
