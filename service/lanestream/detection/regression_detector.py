"""The second detector: a network that looks at the whole road at once and tells the ego lane's two boundaries.

The frame is warped to a canonical picture, in which the horizon has its place, and the network answers with where each
boundary runs, how sure it is of that, whether the boundary is there at all, and where the horizon really is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Detections, Prepared
from lanestream.detection.bars import BarSearch
from lanestream.detection.curve_fit import Fit, Refinement
from lanestream.detection.features import resized
from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import Candidate, Detection
from lanestream.road.view import Image, RoadView, Scaling, visible_spans

# A boundary is told by its columns at these shares of the depth below the horizon.
ANCHORS: Final = (1.0, 0.4, 0.15)

# What the network answers: columns of the left and the right boundary at the anchors, in image widths from the middle;
# their standard deviations likewise; the chance that each boundary is there; the horizon's distance from where the
# canvas took it to be, in depths, positive downwards.
OUTPUTS: Final = 15

# Where the horizon of a frame of which nothing is known may be, as shares of its height: one look at each.
HORIZONS: Final = (0.32, 0.39, 0.46, 0.53, 0.6)

_TOP_SHARE: Final = 0.1

# No boundary is told more exactly than this, in depths.
_EXACT: Final = 0.003


@dataclass(frozen=True)
class RoadCropGeometry:
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


@dataclass(frozen=True)
class RegressorOutput:
    """The network's answer for one frame, in shares of the frame.

    `columns` (2, 3) and `deviations` (2, 3) of the left and the right boundary at the anchors, in image widths from the
    middle; `presence` (2,) from 0 to 1; `horizon` in depths below where it was taken to be.
    """

    columns: FloatArray
    deviations: FloatArray
    presence: FloatArray
    horizon: float

    @classmethod
    def of(cls, output: NDArray[np.float32]) -> RegressorOutput:
        """The reading in one row (15,) of the network's outputs."""
        values = np.asarray(output, dtype=np.float64)
        return cls(values[:6].reshape(2, 3), values[6:12].reshape(2, 3), values[12:14], float(values[14]))

    @property
    def doubt(self) -> float:
        """How unsure the network is: its deviations, and a little for a horizon that is not where it was expected."""
        return float(self.deviations.mean() + 0.05 * abs(self.horizon))

    @property
    def mirrored(self) -> RegressorOutput:
        """What the reading of a mirrored canvas says of the canvas itself."""
        return RegressorOutput(-self.columns[::-1], self.deviations[::-1], self.presence[::-1], self.horizon)

    def mean(self, other: RegressorOutput) -> RegressorOutput:
        """The mean of two readings of one canvas."""
        return RegressorOutput(
            0.5 * (self.columns + other.columns),
            0.5 * (self.deviations + other.deviations),
            0.5 * (self.presence + other.presence),
            0.5 * (self.horizon + other.horizon),
        )

    def view(self, assumed: RoadView) -> RoadView:
        """The road view with the horizon where the network sees it."""
        horizon = assumed.horizon + self.horizon * assumed.depth
        return RoadView(assumed.width, assumed.height, float(np.clip(horizon, 0.0, 0.9 * assumed.height)))

    def curve(self, side: int, view: RoadView) -> Curve:
        """The boundary on `side` (0 left, 1 right) in pixels of `view`, the view with the network's horizon."""
        return Curve.through(view.horizon, _anchor_rows(view), _middle(view) + self.columns[side] * view.width)


@dataclass(frozen=True)
class RegressionDetector:
    """Finds the ego lane's boundaries with one look at the whole frame.

    A boundary is told from the presence `threshold` on, after `refinement` has moved it onto the paint beneath it.
    `detail_width` is the width that frames are reduced to before they are warped, so that near rows do not alias. Paint
    moves a boundary by as much as the network is unsure of it, `doubt` times the deviations that it tells.
    """

    threshold: float = 0.5
    geometry: RoadCropGeometry = RoadCropGeometry()
    detail_width: int = 448
    refinement: Refinement = Refinement(bars=BarSearch(reach=0.24), anchors=ANCHORS, steps=(0.09, 0.06, 0.04, 0.04))
    doubt: float = 1.5

    def survey(self, image: Image, horizon: float | None = None) -> None:
        """Nothing: all that this detector does before it asks its network is the picture that it asks about."""

    def prepare(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),  # noqa: ARG002
        prior: object = None,  # noqa: ARG002
        survey: object = None,  # noqa: ARG002
    ) -> Prepared:
        """Canonical pictures (2 N, size, size, 3) of a BGR image; `horizon` is about its row, where known.

        With a horizon N is 1, without one there is a look for each of `HORIZONS`. Every look is taken twice, straight
        and mirrored: the network's errors are not the same in both. `expected` boundaries, a `prior` and a `survey` are
        of no use here, because the network looks at every frame afresh.
        """
        height, width = image.shape[:2]
        rows = [share * height for share in HORIZONS] if horizon is None else [horizon]
        looks = tuple(RoadView(width, height, float(np.clip(row, 0.0, 0.85 * height))) for row in rows)
        scaling = Scaling(min(1.0, self.detail_width / width))
        detail = resized(image, scaling)
        straight = [self._canvas(detail, scaling, view) for view in looks]
        both = np.stack([*straight, *(cv2.flip(canvas, 1) for canvas in straight)])
        return Prepared(image, (lambda: both,), looks[0], looks=looks)

    def read(self, prepared: Prepared, outputs: NDArray[np.float32]) -> tuple[RegressorOutput, RoadView]:
        """The reading of the look that the network is surest of, and the view with the horizon that it saw."""
        straight, mirrored = np.split(outputs, 2)
        readings = [
            RegressorOutput.of(one).mean(RegressorOutput.of(other).mirrored)
            for one, other in zip(straight, mirrored, strict=True)
        ]
        best = min(range(len(readings)), key=lambda i: readings[i].doubt)
        return readings[best], readings[best].view(prepared.looks[best])

    def _canvas(self, detail: Image, scaling: Scaling, view: RoadView) -> NDArray[np.uint8]:
        """The canonical picture (size, size, 3) in RGB of `detail`, the image reduced by `scaling`, seen in `view`."""
        columns, rows = (scaling.to_working(places).astype(np.float32) for places in self.geometry.grid(view))
        canvas = cv2.remap(detail, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.cvtColor(canvas, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Detections:
        """The boundaries in the network's outputs (2 N, 15), left to right, and the horizon that it saw."""
        reading, view = self.read(prepared, outputs)
        fits, view = self.fitted(prepared.image, reading, view)
        spans = visible_spans([fit.curve for fit in fits.values()], view, _TOP_SHARE)
        detections = [
            Detection(fit.curve, fit.covariance, *span, float(reading.presence[side]))
            for (side, fit), span in zip(fits.items(), spans, strict=True)
            if span is not None
        ]
        return Detections(tuple(detections), view, float(reading.presence.max()))

    def fitted(
        self, image: Image, reading: RegressorOutput, view: RoadView, sides: Sequence[int] = (0, 1)
    ) -> tuple[dict[int, Fit], RoadView]:
        """What is there of a `reading` of a BGR image, by side (0 left, 1 right), moved onto the paint beneath it.

        Of the `sides` alone. `view` is the view with the network's horizon; the one that is returned has the fits'.
        """
        curves = [reading.curve(side, view) for side in sides]
        spans = visible_spans(curves, view, _TOP_SHARE) if curves else []
        there = {
            side: Candidate(curve, *span, 1.0)
            for side, curve, span in zip(sides, curves, spans, strict=True)
            if reading.presence[side] >= self.threshold and span is not None
        }
        deviations = reading.deviations[list(there)]
        doubts = np.maximum(self.doubt * view.width * deviations, _EXACT * view.depth)
        fits, view = self.refinement.refine(image, list(there.values()), view, doubts)
        return dict(zip(there, fits, strict=True)), view


def _anchor_rows(view: RoadView) -> FloatArray:
    return view.horizon + np.asarray(ANCHORS) * view.depth


def _middle(view: RoadView) -> float:
    return (view.width - 1) / 2.0
