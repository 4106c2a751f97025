"""What a glance at the road says of places, and how the detector judges candidates by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lanestream.detection import Prepared
from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.ego_prior import EgoPrior, PriorBoundary
from lanestream.road.curve import Curve
from lanestream.road.results import Candidate, Detection
from lanestream.road.view import RoadView

VIEW = RoadView(640, 360, 150.0)


def line(slope: float) -> Curve:
    """A straight boundary that crosses the bottom row `slope` depths right of the middle."""
    return Curve(150.0, (320.0, slope, 0.0))


def seen(slope: float, spread: float = 0.05, presence: float = 0.98) -> PriorBoundary:
    return PriorBoundary(line(slope), np.full(2, spread), presence)


def test_boundaries_are_likelier_where_they_were_seen_and_hardly_possible_within_the_lane() -> None:
    odds = EgoPrior(VIEW, seen(-1.2), seen(1.2)).odds([line(b) for b in (-1.2, 1.2, 0.0)])
    assert odds[0] == pytest.approx(odds[1])
    assert odds[0] > 10.0
    assert odds[2] < 0.01


def test_lanes_repeat_outside_the_ego_lane() -> None:
    next_lane, between = EgoPrior(VIEW, seen(-1.2), seen(1.2)).odds([line(3.6), line(2.4)])
    assert next_lane > 1.0
    # Half a lane beside the ego lane stand walls and kerbs: a line there needs a surer word.
    assert between == pytest.approx(0.075, rel=0.05)
    assert len(found(EgoPrior(VIEW, seen(-1.2), seen(1.2)), {-1.2: 0.9, 1.2: 0.9, 2.4: 0.9, 3.6: 0.9})) == 3
    assert len(found(EgoPrior(VIEW, seen(-1.2), seen(1.2)), {-1.2: 0.9, 1.2: 0.9, 2.4: 0.97})) == 3


def test_a_glance_that_doubts_says_less() -> None:
    places = [line(b) for b in (1.2, 0.0)]
    sure, unsure = (EgoPrior(VIEW, seen(-1.2, s), seen(1.2, s)).odds(places) for s in (0.05, 0.4))
    assert 1.0 < unsure[0] < sure[0]
    assert sure[1] < unsure[1] < 1.0


def test_one_boundary_alone_tells_nothing_of_a_lane() -> None:
    odds = EgoPrior(VIEW, seen(-1.2), None).odds([line(b) for b in (-1.2, 0.0, 1.2)])
    assert odds[0] > 10.0
    assert odds[1:] == pytest.approx(1.0, abs=0.02)
    assert EgoPrior(VIEW, None, None).odds([line(0.0)]) == pytest.approx(1.0)


def found(prior: EgoPrior | None, said: dict[float, float]) -> tuple[Detection, ...]:
    """What a detector makes of lines on a grey road, which the classifier gives these probabilities by their slope."""
    detector = CandidateDetector()
    candidates = tuple(Candidate(line(slope), 171.0, 359.0, 1.0) for slope in said)
    grey = np.full((360, 640, 3), 90, np.uint8)
    outputs = np.array([[1.0 - p, p] for p in said.values()], np.float32)
    return detector.finish(replace(Prepared(grey, (), VIEW, candidates), prior=prior), outputs).detections


def slopes(detections: tuple[Detection, ...]) -> list[float]:
    return [float(d.curve.coefficients[1]) for d in detections]


def test_what_the_classifier_takes_for_a_boundary_within_the_lane_is_none() -> None:
    said = {-1.2: 0.95, 0.0: 0.95, 1.2: 0.95}
    assert slopes(found(None, said)) == pytest.approx([-1.2, 0.0, 1.2], abs=0.05)
    assert slopes(found(EgoPrior(VIEW, seen(-1.2), seen(1.2)), said)) == pytest.approx([-1.2, 1.2], abs=0.05)


def test_what_the_classifier_doubts_is_accepted_where_it_was_seen() -> None:
    said = {-1.2: 0.95, 1.2: 0.3, 3.6: 0.3}
    assert slopes(found(None, said)) == pytest.approx([-1.2], abs=0.05)
    detections = found(EgoPrior(VIEW, seen(-1.2), seen(1.2)), said)
    assert slopes(detections) == pytest.approx([-1.2, 1.2], abs=0.05)
    assert all(0.5 < d.probability < 1.0 for d in detections)
