"""The default detector: candidates, a patch for each, the classifier's word, refinement of what it accepts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Detections, Prepared
from lanestream.detection.bars import USUAL_LEANING
from lanestream.detection.curve_fit import Refinement
from lanestream.detection.ego_prior import EgoPrior
from lanestream.detection.patches import PatchCutter
from lanestream.detection.proposals import TOP_SHARE, CandidateSearch, Survey
from lanestream.road.curve import Curve, FloatArray, curve_columns, curves_through
from lanestream.road.results import Candidate, Detection
from lanestream.road.view import Image, RoadView, visible_spans

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
    cutter: PatchCutter = PatchCutter()
    refinement: Refinement = Refinement()
    same: float = 0.12
    alike: float = 0.25
    separation: float = 0.8

    def survey(self, image: Image, horizon: float | None = None) -> Survey:
        """What can be seen of a BGR image (H, W, 3) before there is a prior; `horizon` as for `prepare`."""
        return self.search.survey(image, horizon)

    def prepare(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        prior: EgoPrior | None = None,
        survey: Survey | None = None,
    ) -> Prepared:
        """Patches of the candidates of a BGR image (H, W, 3) uint8; `horizon` is about its row, where known.

        A `prior` tells where to look; without one, edges and ridges alone do. `survey` is what `survey` found.
        """
        proposals = self.search.propose(image, horizon, expected, prior, survey)
        patches = self.cutter.parts(image, proposals.candidates, proposals.view)
        return Prepared(image, patches, proposals.view, proposals.candidates, proposals.weight)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Detections:
        """Detections from the classifier's probabilities (N, 2) for the patches of `prepare`, left to right.

        A glance's word on their places decides with the classifier's which candidates are accepted. Where exactly a
        line runs the patches tell better.
        """
        told = outputs[:, TRUE_LANE].astype(np.float64)
        probability = self.judged(prepared, outputs)
        order = np.argsort(-told, kind="stable")
        accepted = order[probability[order] >= self.threshold]
        candidates = [prepared.candidates[i] for i in accepted]
        if not candidates:
            return Detections((), prepared.view, prepared.horizon_weight)
        away = np.abs(_gaps([candidate.curve for candidate in candidates], prepared.view)).max(axis=2)
        chosen = _kept(away > self.same)
        together = self._together(candidates, told[accepted], away, chosen, prepared.view)
        fits, view = self.refinement.refine(prepared.image, together, prepared.view)
        spans = visible_spans([fit.curve for fit in fits], view, TOP_SHARE)
        detections = [
            Detection(fit.curve, fit.covariance, *span, float(probability[accepted[i]]))
            for i, fit, span in zip(chosen, fits, spans, strict=True)
            if span is not None
        ]
        detections.sort(key=lambda detection: -detection.probability)
        return Detections(tuple(self._apart(detections, view)), view, prepared.horizon_weight)

    @staticmethod
    def judged(prepared: Prepared, outputs: NDArray[np.float32]) -> FloatArray:
        """How likely each candidate (N,) is a boundary: the classifier's word, and a glance's on where it runs."""
        told = outputs[:, TRUE_LANE].astype(np.float64)
        if prepared.prior is None:
            return told
        odds = prepared.prior.odds([candidate.curve for candidate in prepared.candidates])
        return np.asarray(told * odds / (1.0 - told + told * odds))

    def _together(
        self,
        candidates: Sequence[Candidate],
        probability: FloatArray,
        away: FloatArray,
        chosen: Sequence[int],
        view: RoadView,
    ) -> list[Candidate]:
        """Of each chosen candidate the mean with all that are like it: each errs in its own way, the less sure more."""
        rows = view.horizon + np.asarray(_ROWS) * view.depth
        curves = [candidate.curve for candidate in candidates]
        leaning = np.hypot(1.0, [float(curves[i].slope(rows[1])) for i in chosen]) / USUAL_LEANING
        alike = away[chosen] <= self.alike * np.maximum(1.0, leaning)[:, None]
        weights = alike * probability**8
        columns = weights @ curve_columns(curves, rows) / weights.sum(axis=1, keepdims=True)
        means = curves_through(view.horizon, rows, columns)
        spans = visible_spans(means, view, TOP_SHARE)
        return [
            Candidate(mean, *(span or (candidates[i].top, candidates[i].bottom)), candidates[i].strength)
            for i, mean, span in zip(chosen, means, spans, strict=True)
        ]

    def _apart(self, detections: Sequence[Detection], view: RoadView) -> list[Detection]:
        """The detections, most probable first, that keep their distance from all better ones; then left to right."""
        gaps = _gaps([detection.curve for detection in detections], view)
        on_one_side = (gaps > 0.0).all(axis=2) | (gaps < 0.0).all(axis=2)
        kept = _kept(on_one_side & (np.abs(gaps).min(axis=2) > self.separation))
        return sorted((detections[i] for i in kept), key=lambda d: float(d.curve.x(view.bottom)))


def _kept(apart: NDArray[np.bool_]) -> list[int]:
    """Places of those, the first ones first, that are `apart` (N, N) from all that are kept before them."""
    kept: list[int] = []
    for i, others in enumerate(apart):
        if others[kept].all():
            kept.append(i)
    return kept


def _gaps(curves: Sequence[Curve], view: RoadView) -> FloatArray:
    """How far each curve is right of each other one at three depths, in rows below the horizon (N, N, 3)."""
    rows = np.array([view.row_at(0.25), view.row_at(0.5), view.row_at(1.0)])
    places = curve_columns(curves, rows) / (rows - view.horizon)
    return places[:, None] - places
