"""The default detector: candidates, a patch for each, the classifier's word, refinement of what it accepts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Findings, Prepared
from lanestream.detection.candidates import TOP_SHARE, CandidateSearch
from lanestream.detection.prior import RoadPrior
from lanestream.detection.refinement import USUAL_LEANING, Refinement
from lanestream.detection.strips import StripCutter
from lanestream.geometry import RoadView, visible_rows
from lanestream.lanes import Candidate, Curve, Detection, FloatArray, Image

TRUE_LANE = 1

# The shares of the depth at which curves are averaged: three tell a curve.
_ROWS: Final = (1.0, 0.45, 0.15)


@dataclass(frozen=True)
class CandidateDetector:
    """Finds boundaries by proposing many and letting the classifier choose.

    A candidate is accepted from the probability `threshold` on. Candidates that are nowhere more than `same` times the
    rows below the horizon apart follow the same marking, and those that are nowhere more than `alike` apart, across the
    line, tell together where it runs. Of two boundaries that come nearer than `separation`, or that cross, one is
    wrong: the more probable one stays.
    """

    threshold: float = 0.5
    search: CandidateSearch = CandidateSearch()
    cutter: StripCutter = StripCutter()
    refinement: Refinement = Refinement()
    same: float = 0.12
    alike: float = 0.25
    separation: float = 0.8

    def prepare(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        prior: RoadPrior | None = None,
    ) -> Prepared:
        """Patches of the candidates of a BGR image (H, W, 3) uint8; `horizon` is about its row, where known.

        A `prior` tells where to look; without one, edges and ridges alone do.
        """
        proposals = self.search.propose(image, horizon, expected, prior)
        patches = self.cutter.cut(image, proposals.candidates, proposals.view)
        return Prepared(image, patches, proposals.view, proposals.candidates, proposals.weight)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Findings:
        """Detections from the classifier's probabilities (N, 2) for the patches of `prepare`, left to right."""
        probability = outputs[:, TRUE_LANE]
        accepted = [int(i) for i in np.argsort(-probability, kind="stable") if probability[i] >= self.threshold]
        chosen = self._different(accepted, prepared)
        together = [self._together(index, accepted, prepared, probability) for index in chosen]
        fits = self.refinement.refine(prepared.image, together, prepared.view)
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

    def _together(
        self, index: int, accepted: Sequence[int], prepared: Prepared, probability: NDArray[np.float32]
    ) -> Candidate:
        """The mean of a candidate and the accepted ones like it: each errs in its own way, the less sure ones more."""
        view, best = prepared.view, prepared.candidates[index]
        rows = view.horizon + np.asarray(_ROWS) * view.depth
        reach = self.alike * max(1.0, float(np.hypot(1.0, best.curve.slope(rows[1]))) / USUAL_LEANING)
        alike = [i for i in accepted if np.abs(_gaps(prepared.candidates[i].curve, best.curve, view)).max() <= reach]
        columns = np.stack([prepared.candidates[i].curve.x(rows) for i in alike])
        curve = Curve.through(view.horizon, rows, np.average(columns, axis=0, weights=probability[alike] ** 8))
        return Candidate(curve, *(visible_rows(curve, view, TOP_SHARE) or (best.top, best.bottom)), best.strength)

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
