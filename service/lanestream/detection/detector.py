"""The default detector: candidates, a patch for each, the classifier's word, refinement of what it accepts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Findings, Prepared
from lanestream.detection.candidates import TOP_SHARE, CandidateSearch
from lanestream.detection.prior import RoadGlance
from lanestream.detection.refinement import Refinement
from lanestream.detection.strips import StripCutter
from lanestream.geometry import RoadView, visible_rows
from lanestream.lanes import Curve, Detection, FloatArray, Image

TRUE_LANE = 1


@dataclass(frozen=True)
class CandidateDetector:
    """Finds boundaries by proposing many and letting the classifier choose.

    A candidate is accepted from the probability `threshold` on. A `glance` at the whole road tells where to look;
    without one, edges and ridges alone do. Candidates that are nowhere more than `same` times the rows below the
    horizon apart follow the same marking. Of two boundaries that come nearer than `separation`, or that cross, one is
    wrong: the more probable one stays.
    """

    threshold: float = 0.5
    glance: RoadGlance | None = None
    search: CandidateSearch = CandidateSearch()
    cutter: StripCutter = StripCutter()
    refinement: Refinement = Refinement()
    same: float = 0.12
    separation: float = 0.8

    def prepare(self, image: Image, horizon: float | None = None, expected: Sequence[Curve] = ()) -> Prepared:
        """Patches of the candidates of a BGR image (H, W, 3) uint8; `horizon` is about its row, where known."""
        prior = None if self.glance is None else self.glance.look(image, horizon)
        proposals = self.search.propose(image, horizon, expected, prior)
        patches = self.cutter.cut(image, proposals.candidates, proposals.view)
        return Prepared(image, patches, proposals.view, proposals.candidates, proposals.weight)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Findings:
        """Detections from the classifier's probabilities (N, 2) for the patches of `prepare`, left to right."""
        probability = outputs[:, TRUE_LANE]
        accepted = [int(i) for i in np.argsort(-probability, kind="stable") if probability[i] >= self.threshold]
        chosen = self._different(accepted, prepared)
        fits = self.refinement.refine(prepared.image, [prepared.candidates[i] for i in chosen], prepared.view)
        detections = []
        for index, fit in zip(chosen, fits, strict=True):
            rows = visible_rows(fit.curve, prepared.view, TOP_SHARE)
            if rows is not None:
                detections.append(Detection(fit.curve, fit.covariance, *rows, float(probability[index])))
        apart = sorted(self._apart(detections, prepared.view), key=lambda d: float(d.curve.x(prepared.view.bottom)))
        return Findings(tuple(apart), prepared.view, prepared.horizon_weight)

    def _different(self, accepted: Sequence[int], prepared: Prepared) -> list[int]:
        """Of candidates along one marking the most probable: refinement would move them onto each other anyway."""
        kept: list[int] = []
        for index in accepted:
            curve = prepared.candidates[index].curve
            gaps = [np.abs(_gaps(curve, prepared.candidates[i].curve, prepared.view)).max() for i in kept]
            if all(gap > self.same for gap in gaps):
                kept.append(index)
        return kept

    def _apart(self, detections: Sequence[Detection], view: RoadView) -> list[Detection]:
        """The detections, most probable first, that keep their distance from all better ones."""
        kept: list[Detection] = []
        for detection in detections:
            gaps = [_gaps(detection.curve, other.curve, view) for other in kept]
            if all(np.abs(gap).min() > self.separation and (gap > 0.0).all() == (gap > 0.0).any() for gap in gaps):
                kept.append(detection)
        return kept


def _gaps(one: Curve, other: Curve, view: RoadView) -> FloatArray:
    """How far apart two curves are at three depths, in rows below the horizon; the sign tells which is on the right."""
    rows = np.array([view.row_at(0.25), view.row_at(0.5), view.row_at(1.0)])
    return (one.x(rows) - other.x(rows)) / (rows - view.horizon)
