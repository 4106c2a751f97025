"""Which of the boundaries of a frame are accepted, and how probable they are then."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
import roads

from lanestream.detection.acceptance import SHIPPED, Acceptance, Reliability
from lanestream.road.appearance import Appearance
from lanestream.road.results import Detection
from lanestream.road.view import RoadView

VIEW = RoadView(640, 360, 150.0)
STRICT = Acceptance(
    ego=Reliability(1.0, -1.0, least=0.5),
    outer=Reliability(1.0, -2.0, least=0.6),
    beside_lane=Reliability(1.0, -1.5, least=0.5),
)


def found(position: float, probability: float, road_edge: float = 0.0) -> Detection:
    curve = roads.straight(VIEW, position)
    return Detection(curve, np.eye(3), 200.0, 359.0, probability, appearance=Appearance(road_edge))


def accepted(
    detections: Sequence[Detection],
    acceptance: Acceptance = STRICT,
    tracked: Sequence[bool] | None = None,
    threshold: float = 0.5,
) -> dict[float, float]:
    """Returns the probabilities of the accepted boundaries by their lateral positions."""
    chosen = acceptance.accepted(detections, tracked or [False] * len(detections), VIEW, threshold)
    return {round(each.curve.coefficients[1], 2): each.probability for each in chosen}


def test_a_probability_changes_by_its_logit() -> None:
    reliability = Reliability(0.5, 1.0)
    assert reliability.probability(0.5) == pytest.approx(1.0 / (1.0 + np.exp(-1.0)))
    assert reliability.probability(0.9) == pytest.approx(1.0 / (1.0 + np.exp(-(0.5 * np.log(9.0) + 1.0))))
    assert [reliability.probability(certain) for certain in (0.0, 1.0)] == [0.0, 1.0]
    assert Reliability().probability(0.3) == pytest.approx(0.3)


def test_outer_boundaries_must_be_more_probable_than_those_of_the_ego_lane() -> None:
    result = accepted([found(position, 0.9) for position in (-3.4, -1.2, 1.2, 3.4)])
    assert list(result) == [-1.2, 1.2], "the outer ones would have 0.55"
    assert list(result.values()) == pytest.approx([9.0 / (9.0 + np.e)] * 2)
    result = accepted([found(position, 0.97) for position in (-3.4, -1.2, 1.2, 3.4)])
    assert list(result) == [-3.4, -1.2, 1.2, 3.4], "from left to right"
    assert result[-3.4] < result[-1.2]


@pytest.mark.parametrize(
    ("right_one", "road_edge", "certain"),
    [(0.98, 0.2, True), (0.97, 0.2, False), (0.98, 0.8, False), (None, 0.0, False)],
    ids=["two certain markings", "a less certain one", "an edge", "one boundary"],
)
def test_outer_boundaries_are_usual_beside_a_lane_with_two_certain_markings(
    right_one: float | None, road_edge: float, certain: bool
) -> None:
    detections = [found(-3.4, 0.85), found(-1.2, 0.99)]
    if right_one is not None:
        detections.append(found(1.2, right_one, road_edge))
    result = accepted(detections)
    assert (-3.4 in result) == certain, "0.56 beside such a lane, else 0.43"
    if certain:
        assert result[-3.4] == pytest.approx(STRICT.beside_lane.probability(0.85))


def test_the_nearest_accepted_boundary_of_a_side_is_that_of_the_ego_lane() -> None:
    result = accepted([found(0.6, 0.6), found(1.2, 0.8)])
    assert list(result) == [1.2], "the nearer one has only 0.36, so the other one is judged as the ego boundary"
    assert result[1.2] == pytest.approx(STRICT.ego.probability(0.8))


def test_what_was_tracked_needs_only_the_threshold() -> None:
    detections = [found(-1.2, 0.6), found(1.2, 0.99), found(3.4, 0.6), found(5.6, 0.4)]
    assert list(accepted(detections)) == [1.2]
    result = accepted(detections, tracked=[True, False, True, True])
    assert list(result) == [-1.2, 1.2, 3.4], "the last one is below the threshold"
    assert result[-1.2] == pytest.approx(STRICT.ego.probability(0.6)), "being tracked does not make it more probable"
    assert result[3.4] == pytest.approx(STRICT.outer.probability(0.6))


def test_the_road_ends_at_its_edge() -> None:
    detections = [found(1.2, 0.9), found(3.4, 0.95, road_edge=1.0), found(5.6, 0.9)]
    assert list(accepted(detections, Acceptance())) == [1.2, 3.4]
    marking = [*detections[:1], found(3.4, 0.95), detections[2]]
    assert list(accepted(marking, Acceptance())) == [1.2, 3.4, 5.6], "beyond a marking the road goes on"
    assert accepted(marking, Acceptance())[5.6] == pytest.approx(0.9)


def test_the_shipped_acceptance_is_monotonic_and_stricter_than_the_decisions() -> None:
    for reliability in (SHIPPED.ego, SHIPPED.outer, SHIPPED.beside_lane):
        values = [reliability.probability(decided) for decided in np.linspace(0.01, 0.99, 50).tolist()]
        assert all(low < high for low, high in pairwise(values))
        assert reliability.probability(0.9) < 0.9, "a classifier is too certain of the best of many candidates"
    assert SHIPPED.outer.least > SHIPPED.beside_lane.least > SHIPPED.ego.least
