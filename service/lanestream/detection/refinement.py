"""Sub-pixel refinement: a candidate's curve moved onto the paint beneath it, with what the fit is worth.

The strip along the candidate is searched for a narrow bright bar row by row, and the curve is pulled onto the bars by
reweighted least squares. Where the paint is missing, or shows no bend, the candidate's own line is the prior, so a
straight marking stays straight and a dashed one keeps its direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.edges import paint_grey, resized
from lanestream.geometry import RoadView, Scaling
from lanestream.lanes import Candidate, Curve, FloatArray, Image, curve_basis

# hypot(1, slope) of an ego boundary: half a lane of 3.6 m beside a camera 1.45 m high.
USUAL_LEANING: Final = 1.6


@dataclass(frozen=True)
class Fit:
    """A refined curve in image pixels and the covariance (3, 3) of its coefficients."""

    curve: Curve
    covariance: FloatArray


@dataclass(frozen=True)
class Refinement:
    """The fit's settings; all widths are shares of the rows below the horizon, as everything on the road is.

    The strip reaches `reach` to either side in `cells` cells on `rows` rows; markings are about as wide as one of
    `bars`. The curve is told by its columns at the depths `anchors`, where the candidate may be off by about `doubt`. A
    bar's centre on one row is good to `noise` pixels of a 640 pixel wide image plus `blur` of the rows below the
    horizon. Leaning candidates err more from side to side for the same distance across: for them `reach`, `doubt` and
    `steps`, the distances at which bars lose half their weight, are wider.
    """

    reach: float = 0.16
    cells: int = 97
    rows: int = 64
    bars: tuple[float, ...] = (0.05, 0.1, 0.17)
    anchors: tuple[float, float, float] = (1.0, 0.45, 0.15)
    doubt: tuple[float, float, float] = (0.03, 0.02, 0.015)
    noise: float = 1.0
    blur: float = 0.012
    steps: tuple[float, ...] = (0.06, 0.05, 0.04, 0.03)
    detail_width: int = 1280

    def refine(self, image: Image, candidates: Sequence[Candidate], view: RoadView) -> list[Fit]:
        """A fit for each candidate of a BGR image (H, W, 3)."""
        if not candidates:
            return []
        scaling = Scaling(min(1.0, self.detail_width / view.width))
        grey = paint_grey(resized(image, scaling))
        leanings = [_leaning(candidate) for candidate in candidates]
        strips = self._strips(grey, candidates, leanings, view, scaling)
        return [
            self._fit(candidate, leaning, strip, view)
            for candidate, leaning, strip in zip(candidates, leanings, strips, strict=True)
        ]

    def _strips(
        self,
        grey: Image,
        candidates: Sequence[Candidate],
        leanings: Sequence[float],
        view: RoadView,
        scaling: Scaling,
    ) -> list[NDArray[np.float32]]:
        """Bar contrast (rows, cells), 0 to 1, of the strip along each candidate."""
        across = np.linspace(-self.reach, self.reach, self.cells)
        columns, rows = [], []
        for candidate, leaning in zip(candidates, leanings, strict=True):
            y = np.linspace(candidate.top, candidate.bottom, self.rows)
            x = candidate.curve.x(y)[:, None] + (y - view.horizon)[:, None] * leaning * across[None, :]
            columns.append(scaling.to_working(0.0) + x * scaling.factor)
            rows.append(np.broadcast_to((scaling.to_working(0.0) + y * scaling.factor)[:, None], x.shape))
        warped = cv2.remap(
            grey,
            np.concatenate(columns).astype(np.float32),
            np.concatenate(rows).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        strips = warped.astype(np.float32).reshape(len(candidates), self.rows, self.cells)
        return [self._bars(strip, leaning) for strip, leaning in zip(strips, leanings, strict=True)]

    def _bars(self, warped: NDArray[np.float32], leaning: float) -> NDArray[np.float32]:
        contrast = np.max([self._contrast(warped, bar / leaning) for bar in self.bars], axis=0)
        # Five grey levels above its own row's unrest is a bar that an eye would see.
        unrest = np.abs(contrast).mean(axis=1, keepdims=True)
        return np.asarray(np.clip((contrast - unrest) / (unrest + 5.0), 0.0, 1.0), dtype=np.float32)

    def _contrast(self, warped: NDArray[np.float32], bar: float) -> NDArray[np.float32]:
        """How much brighter a bar is than the brighter one of its neighbours of the same width."""
        width = max(1, round(bar / (2 * self.reach) * self.cells)) | 1
        mean = cv2.blur(warped, (width, 1))
        sides = np.pad(mean, ((0, 0), (width, width)), mode="edge")
        return np.asarray(mean - np.maximum(sides[:, : -2 * width], sides[:, 2 * width :]), dtype=np.float32)

    def _fit(self, candidate: Candidate, leaning: float, strip: NDArray[np.float32], view: RoadView) -> Fit:
        """Columns at the anchor rows by least squares with the candidate as the prior."""
        y = np.linspace(candidate.top, candidate.bottom, self.rows)
        below = y - view.horizon
        across = leaning * np.linspace(-self.reach, self.reach, self.cells)
        anchors = view.horizon + np.asarray(self.anchors) * view.depth
        to_curve = np.linalg.inv(curve_basis(view.horizon, anchors))
        basis = curve_basis(view.horizon, y) @ to_curve
        sigma = self.noise * view.width / 640.0 + self.blur * below
        prior = np.diag(1.0 / (leaning * np.asarray(self.doubt) * view.depth) ** 2)
        shift, normal = np.zeros(3), prior
        for reach in self.steps:
            off = across[None, :] - (basis @ shift / below)[:, None]
            weight = strip / (1.0 + (off / (leaning * reach)) ** 2) ** 2
            total = weight.sum(axis=1)
            centre = (weight * across[None, :]).sum(axis=1) / np.maximum(total, 1e-6) * below
            # A row counts once, however wide its bar; a row without a bar does not count.
            trust = np.minimum(total / 2.0, 1.0) / sigma**2
            normal = prior + basis.T @ (basis * trust[:, None])
            shift = np.linalg.solve(normal, basis.T @ (trust * centre))
        columns = candidate.curve.x(anchors) + shift
        # Neighbouring rows share their errors: about four of them are worth one.
        covariance = to_curve @ np.linalg.inv(prior + (normal - prior) / 4.0) @ to_curve.T
        return Fit(Curve.through(view.horizon, anchors, columns), covariance)


def _leaning(candidate: Candidate) -> float:
    """How much wider a candidate's errors are from side to side than those of one that leans as ego boundaries do."""
    slope = float(candidate.curve.slope(0.5 * (candidate.top + candidate.bottom)))
    return max(1.0, math.hypot(1.0, slope) / USUAL_LEANING)
