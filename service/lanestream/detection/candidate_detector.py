"""The candidate detector: proposes candidates, classifies a patch of each, and fits curves to the accepted ones."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.acceptance import Acceptance
from lanestream.detection.classification import Classification
from lanestream.detection.curve_fit import USUAL_OBLIQUITY, fit_curves
from lanestream.detection.ego_prior import RoadRegressor
from lanestream.detection.features import Channels
from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.detection.patches import cut_patches
from lanestream.detection.proposals import (
    MOST_CANDIDATES,
    Proposals,
    are_duplicates,
    non_maximum_suppression,
    propose,
)
from lanestream.detection.regression_detector import fit_output
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import ANCHORS, Curves, FloatArray
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_spans

# Distances between candidates are compared at these shares of the depth.
_COMPARED: Final = np.array([0.25, 0.5, 1.0])
# Candidates whose largest distance is at most _SAME, in row offsets, follow the same marking. The position of a marking
# is the mean of the candidates within _AVERAGED of it, measured across the line.
_SAME: Final = 0.12
_AVERAGED: Final = 0.25
# Within this distance of a tracked boundary, in row offsets, is the same boundary. The prior's boundaries are fitted to
# the paint and become candidates too, except near a confirmed boundary, which is on the paint already.
_TRACKED: Final = 0.16
# If two boundaries come closer than this, in row offsets, or cross, one of them is wrong. An edge of the road may be
# closer to a marking.
_CLOSEST: Final = 0.8
_CLOSEST_EDGE: Final = 0.2


@dataclass(frozen=True)
class CandidateDetector:
    """Finds boundaries among candidates whose probability reaches `threshold`, and reports those that it accepts.

    A `regressor`, if given, guides the search.
    """

    threshold: float
    patch: PatchGeometry = PatchGeometry()
    regressor: RoadRegressor | None = None
    acceptance: Acceptance = Acceptance()

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        """Returns the boundaries in a BGR working image (H, 640, 3) uint8."""
        proposals = self.propose(image, context, infer)
        patches = cut_patches(image, proposals.curves, proposals.spans, proposals.view, self.patch)
        return self.decide(proposals, Classification.of(infer("classifier", patches)))

    def propose(self, image: Image, context: FrameContext, infer: Infer, limit: int = MOST_CANDIDATES) -> Proposals:
        """Returns the candidates of a BGR working image."""
        channels = Channels.of(image)
        if self.regressor is None:
            return propose(channels, context, None, None, limit)
        output, view = self.regressor.predict(
            image, context.expected_horizon, infer, is_given=context.is_given, is_doubtful=context.is_doubtful
        )
        is_tracking = context.tracked is not None and len(context.tracked) > 0
        prior = self.regressor.prior(output, view, is_tracking=is_tracking)
        sides: Sequence[int] = (0, 1)
        if context.confirmed is not None:
            is_tracked = are_duplicates(output.curves(view), context.confirmed, view, _TRACKED)
            sides = np.flatnonzero(~is_tracked.any(axis=1)).tolist()
        _, fits = fit_output(channels, output, view, self.regressor.threshold, sides)
        return propose(channels, context, prior, fits.curves, limit)

    @staticmethod
    def with_prior(proposals: Proposals, classification: Classification) -> Classification:
        """Returns the classification of the candidates after the prior has changed the odds of their kinds."""
        prior = proposals.prior
        return classification if prior is None else classification.with_odds(prior.odds(proposals.curves))

    def decide(self, proposals: Proposals, classification: Classification) -> Detections:
        """Returns the boundaries among `proposals`, given the `classification` of their patches.

        The prior influences which candidates are accepted. Their exact position depends on the classifier alone, which
        is more precise.
        """
        started = time.perf_counter()
        own, decided = classification.boundary, self.with_prior(proposals, classification)
        probability = decided.boundary
        order = np.argsort(-own, kind="stable")
        accepted = order[probability[order] >= self.threshold]
        prior = proposals.prior
        prior_horizon, uncertainty = (None, 0.0) if prior is None else (prior.view.horizon, prior.uncertainty)
        if not len(accepted):
            return Detections((), proposals.view, proposals.horizon_weight, prior_horizon, 0.0, uncertainty)
        curves, spans = proposals.curves.take(accepted), proposals.spans.take(accepted)
        gaps = np.abs(_gaps(curves, proposals.view)).max(axis=2)
        chosen = non_maximum_suppression(gaps <= _SAME)
        near = own[accepted] ** 8 * (gaps[chosen] <= _SAME)
        appearances = decided.take(accepted).appearances(near)
        is_edge = np.array([appearance.kind == "road_edge" for appearance in appearances])
        kinds = decided.kinds[accepted]
        is_alike = is_edge[:, None] == (kinds[:, 1] > kinds[:, 0])
        means = _means(curves, own[accepted] ** 8 * is_alike, gaps, chosen, proposals.view)
        fits = fit_curves(proposals.channels, means, spans.take(chosen), proposals.view, is_edge=is_edge)
        visible = visible_spans(fits.curves, fits.view)
        expected = np.zeros(len(chosen), bool) if prior is None else prior.expects(curves.take(chosen))
        detections = [
            Detection(
                fits.curves[i],
                fits.covariances[i],
                float(visible.top[i]),
                float(visible.bottom[i]),
                p,
                float(fits.paint[i]),
                expected=bool(expected[i]),
                appearance=appearances[i],
            )
            for i, p in enumerate(probability[accepted[chosen]].tolist())
            if visible.visible[i]
        ]
        separated = _separated(sorted(detections, key=lambda detection: -detection.probability), fits.view)
        boundaries = self.acceptance.accepted(separated, _are_tracked(separated, proposals), fits.view, self.threshold)
        fit_s = time.perf_counter() - started
        return Detections(boundaries, fits.view, proposals.horizon_weight, prior_horizon, fit_s, uncertainty)


def _means(curves: Curves, weights: FloatArray, gaps: FloatArray, chosen: NDArray[np.intp], view: RoadView) -> Curves:
    """Returns the weighted mean of each chosen candidate and all candidates close to it.

    Their errors are largely independent. `weights` (M, N) are low for less probable candidates, and zero for those of
    the other kind.
    """
    rows = view.horizon + ANCHORS * view.depth
    slope = curves.take(chosen).slope(rows[1:2])[:, 0]
    obliquity = np.maximum(1.0, np.hypot(1.0, slope) / USUAL_OBLIQUITY)
    weights = weights * (gaps[chosen] <= _AVERAGED * obliquity[:, None])
    return Curves.through(view.horizon, rows, weights @ curves.x(rows) / weights.sum(axis=1, keepdims=True))


def _separated(detections: list[Detection], view: RoadView) -> tuple[Detection, ...]:
    """Returns the detections that neither cross a more probable one nor come close to it, from left to right.

    `detections` are sorted by falling probability.
    """
    if not detections:
        return ()
    gaps = _gaps(Curves.of([detection.curve for detection in detections]), view)
    on_one_side = (gaps > 0.0).all(axis=2) | (gaps < 0.0).all(axis=2)
    is_edge = np.array([detection.appearance.kind == "road_edge" for detection in detections])
    closest = np.where(is_edge[:, None] == is_edge, _CLOSEST, _CLOSEST_EDGE)
    kept = non_maximum_suppression(~on_one_side | (np.abs(gaps).min(axis=2) <= closest))
    return tuple(sorted((detections[i] for i in kept.tolist()), key=lambda each: float(each.curve.x(view.bottom))))


def _are_tracked(detections: Sequence[Detection], proposals: Proposals) -> list[bool]:
    """Returns which of the detections are at the place of a boundary that was tracked to this frame."""
    tracked = proposals.tracked
    if tracked is None or not len(tracked) or not detections:
        return [False] * len(detections)
    curves = Curves.of([detection.curve for detection in detections])
    horizon, bottom = proposals.view.horizon, proposals.view.bottom
    same = are_duplicates(curves.below(horizon, bottom), tracked.below(horizon, bottom), proposals.view, _TRACKED)
    near: list[bool] = np.asarray(same.any(axis=1)).tolist()
    return near


def _gaps(curves: Curves, view: RoadView) -> FloatArray:
    """Returns how far each curve is to the right of every other one at three rows, in row offsets (N, N, 3)."""
    below = _COMPARED * view.depth
    positions = curves.x(view.horizon + below) / below
    return np.asarray(positions[:, None] - positions)
