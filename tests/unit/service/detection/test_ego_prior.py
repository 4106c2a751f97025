"""The ego-lane prior: the odds that it gives, the lanes beside the ego lane, and how the detector uses it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import roads
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.classification import Classification
from lanestream.detection.ego_prior import EgoPrior, LaneSpacing, RegressorOutput, RoadRegressor
from lanestream.detection.features import Channels
from lanestream.detection.interface import FrameContext
from lanestream.detection.proposals import Proposals, propose
from lanestream.road.curve import Curve, Curves
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_spans

VIEW = RoadView(640, 360, 150.0)


def lines(*positions: float) -> Curves:
    """Returns straight boundaries that cross the bottom row so many depths right of the middle."""
    return Curves(150.0, np.array([[320.0, position, 0.0] for position in positions]).reshape(-1, 3))


def prior_at(
    left: float | None, right: float | None, sigma: float = 0.05, presence: float = 0.98, road_edge: float = 0.0
) -> EgoPrior:
    seen = {side: position for side, position in ((-1, left), (1, right)) if position is not None}
    number = len(seen)
    of_each = np.full((number, 2), sigma), np.full(number, presence), np.full(number, road_edge)
    return EgoPrior(VIEW, tuple(seen), lines(*seen.values()), *of_each)


def marking_odds(prior: EgoPrior, *positions: float) -> NDArray[np.float64]:
    """Returns the factors by which the odds of lines at these positions to be markings change."""
    return prior.odds(lines(*positions))[:, 0]


def edge_odds(prior: EgoPrior, *positions: float) -> NDArray[np.float64]:
    """Returns the factors by which the odds of lines at these positions to be edges of the road change."""
    return prior.odds(lines(*positions))[:, 1]


def test_markings_are_likelier_where_the_prior_saw_them_and_hardly_possible_in_the_lane() -> None:
    left, right, inside = marking_odds(prior_at(-1.2, 1.2), -1.2, 1.2, 0.0)
    assert left == pytest.approx(right)
    assert left > 10.0
    assert inside < 0.01


def test_lanes_repeat_outside_the_ego_lane() -> None:
    prior = prior_at(-1.2, 1.2)
    next_lane, between = marking_odds(prior, 3.6, 2.4)
    assert next_lane > 1.0
    # Half a lane outside the ego lane are walls and curbs: a line there must be more probable.
    assert between == pytest.approx(0.075, rel=0.05)
    assert len(decided(prior, {-1.2: 0.9, 1.2: 0.9, 2.4: 0.9, 3.6: 0.9})) == 3
    assert len(decided(prior, {-1.2: 0.9, 1.2: 0.9, 2.4: 0.97})) == 3


def test_edges_of_the_road_may_be_anywhere_outside_the_lane() -> None:
    prior = prior_at(-1.2, 1.2)
    assert edge_odds(prior, -3.6, -2.4, -1.6, 1.6, 2.4, 3.6) == pytest.approx(1.0, abs=0.02)
    assert edge_odds(prior, 0.0)[0] < 0.01
    outside = decided(prior, {-1.2: 0.9, 1.2: 0.9}, edges={2.4: 0.6})
    assert [each.appearance.kind for each in outside] == ["marking", "marking", "road_edge"]
    assert len(decided(prior, {-1.2: 0.9, 1.2: 0.9}, edges={0.0: 0.9})) == 2


def test_a_boundary_that_the_prior_saw_as_an_edge_is_likelier_to_be_one() -> None:
    marking, mixed, edge = (prior_at(-1.2, 1.2, road_edge=share) for share in (0.0, 0.5, 1.0))
    as_marking = [marking_odds(prior, 1.2)[0] for prior in (marking, mixed, edge)]
    as_edge = [edge_odds(prior, 1.2)[0] for prior in (marking, mixed, edge)]
    assert as_marking[0] > 10.0 > 1.0 > as_marking[2]
    assert as_edge[2] > 10.0 > 1.0 > as_edge[0]
    assert as_marking[1] == pytest.approx(0.5 * (as_marking[0] + as_marking[2]))
    assert as_edge[1] == pytest.approx(0.5 * (as_edge[0] + as_edge[2]))


def test_an_uncertain_prior_changes_odds_less() -> None:
    certain, uncertain = (marking_odds(prior_at(-1.2, 1.2, sigma), 1.2, 0.0) for sigma in (0.05, 0.4))
    assert 1.0 < uncertain[0] < certain[0]
    assert certain[1] < uncertain[1] < 1.0


def test_a_boundary_that_is_less_present_has_lower_odds() -> None:
    present, absent = (marking_odds(prior_at(-1.2, 1.2, presence=presence), 1.2)[0] for presence in (0.98, 0.3))
    assert 1.0 < absent < present


def test_one_boundary_alone_says_nothing_of_the_lane() -> None:
    odds = marking_odds(prior_at(-1.2, None), -1.2, 0.0, 1.2)
    assert odds[0] > 10.0
    assert odds[1:] == pytest.approx(1.0, abs=0.02)
    assert edge_odds(prior_at(-1.2, None), -1.2, 0.0, 1.2) == pytest.approx(1.0)
    assert prior_at(None, None).odds(lines(0.0)) == pytest.approx(1.0)


def decided(
    prior: EgoPrior | None, markings: Mapping[float, float], edges: Mapping[float, float] | None = None
) -> tuple[Detection, ...]:
    """Returns the boundaries on a gray road if the classifier gives these probabilities to lines at these positions.

    The probabilities are those of markings, and of edges of the road.
    """
    of_edges = edges or {}
    curves = lines(*markings, *of_edges)
    kinds = np.array([[p, 0.0] for p in markings.values()] + [[0.0, p] for p in of_edges.values()])
    gray = roads.channels(np.full((360, 640), 90, np.uint8))
    proposals = Proposals(gray, curves, visible_spans(curves, VIEW), VIEW, 1.0, prior)
    return CandidateDetector(0.5).decide(proposals, Classification(kinds)).boundaries


def positions(detections: tuple[Detection, ...]) -> list[float]:
    return [detection.curve.coefficients[1] for detection in detections]


def test_an_uncertain_edge_is_accepted_where_the_prior_saw_one() -> None:
    prior = prior_at(-1.2, 1.2, road_edge=1.0)
    assert len(decided(None, {}, edges={1.2: 0.3})) == 0
    (edge,) = decided(prior, {}, edges={1.2: 0.3})
    assert edge.appearance.kind == "road_edge"
    assert edge.expected


def test_a_line_in_the_lane_is_not_a_boundary_even_if_the_classifier_accepts_it() -> None:
    probabilities = {-1.2: 0.95, 0.0: 0.95, 1.2: 0.95}
    assert positions(decided(None, probabilities)) == pytest.approx([-1.2, 0.0, 1.2], abs=0.05)
    assert positions(decided(prior_at(-1.2, 1.2), probabilities)) == pytest.approx([-1.2, 1.2], abs=0.05)


def test_an_uncertain_candidate_is_accepted_where_the_prior_saw_a_boundary() -> None:
    probabilities = {-1.2: 0.95, 1.2: 0.3, 3.6: 0.3}
    assert positions(decided(None, probabilities)) == pytest.approx([-1.2], abs=0.05)
    detections = decided(prior_at(-1.2, 1.2), probabilities)
    assert positions(detections) == pytest.approx([-1.2, 1.2], abs=0.05)
    assert all(0.5 < detection.probability < 1.0 for detection in detections)


# --- Lane spacing ---------------------------------------------------------------------------------------------------


def test_lines_at_whole_lane_widths_have_the_most_weight() -> None:
    spacing = LaneSpacing(-1.0, 1.4, 0.3)
    assert spacing.neighbors == pytest.approx((-3.4, 3.8))
    weight = spacing.weight(np.array([-1.0, 1.4, -3.4, 3.8, 6.2, 0.2]))
    assert weight[:5] == pytest.approx([1.0, 1.0, 1.0, 1.0, 0.6])
    assert weight[5] < 0.4


def test_beside_a_single_boundary_a_lane_of_the_usual_width_is_assumed() -> None:
    assert prior_at(-1.2, None).spacing(np.array([-1.2]), 0.3).right == pytest.approx(1.2)
    assert prior_at(None, 1.2).spacing(np.array([1.2]), 0.3).left == pytest.approx(-1.2)
    both = prior_at(-1.0, 1.4).spacing(np.array([-1.0, 1.4]), 0.3)
    assert (both.left, both.right) == (-1.0, 1.4)


def test_the_lane_width_is_limited_to_that_of_lanes() -> None:
    assert 1.0 < LaneSpacing(-0.1, 0.1, 0.3).width < 2.0
    assert LaneSpacing(-5.0, 5.0, 0.3).width < 5.0


# --- The search around a prior --------------------------------------------------------------------------------------


def faint_road(curvature: float) -> tuple[Image, EgoPrior, list[Curve]]:
    """Returns a road of two lanes whose boundaries are hardly visible, a prior of the ego lane, and the boundaries."""
    curves = [Curve(150.0, (320.0, b, curvature * VIEW.depth**2)) for b in (-1.2, 1.2, 3.6)]
    image = roads.in_color(roads.draw_road(VIEW, curves, width=0.03, paint=roads.ROAD + 25, noise=4.0))
    prior = EgoPrior(VIEW, (-1, 1), Curves.of(curves[:2]), np.full((2, 2), 0.05), np.ones(2), np.zeros(2))
    return image, prior, curves


@pytest.mark.parametrize("curvature", [0.0, 0.02])
def test_the_boundaries_of_the_prior_and_their_neighbors_come_first(curvature: float) -> None:
    image, prior, curves = faint_road(curvature)
    proposals = propose(Channels.of(image), FrameContext(), prior, None)
    first = proposals.curves.take(np.arange(4))
    assert proposals.view.horizon == pytest.approx(VIEW.horizon, abs=7.0)
    rows = np.array([200.0, 250.0])
    for curve in curves:
        assert np.abs(first.x(rows) - curve.x(rows)).max(axis=1).min() < 6.0


def test_a_prior_without_boundaries_changes_no_candidates() -> None:
    channels = Channels.of(faint_road(0.0)[0])
    plain, with_prior = (propose(channels, FrameContext(), prior, None) for prior in (None, prior_at(None, None)))
    assert list(plain.curves) == list(with_prior.curves)


def test_a_prior_without_boundaries_still_shows_the_horizon() -> None:
    bare, context = roads.channels(np.full((360, 640), 100, np.uint8)), FrameContext(horizon=150.0)
    nothing = Curves.none(180.0)
    prior = EgoPrior(RoadView(640, 360, 180.0), (), nothing, np.empty((0, 2)), np.empty(0), np.empty(0))
    assert propose(bare, context, prior, None).view.horizon == pytest.approx(180.0, abs=7.0)
    assert propose(bare, context, None, None).view.horizon == pytest.approx(150.0, abs=7.0)


def test_tracked_boundaries_come_after_those_of_the_prior_and_before_lines() -> None:
    image, prior, _ = faint_road(0.0)
    tracked = lines(-0.6)
    without = propose(Channels.of(image), FrameContext(150.0), prior, None).curves
    curves = propose(Channels.of(image), FrameContext(150.0, tracked), prior, None).curves
    rows = np.linspace(180.0, 359.0, 20)  # the search finds another horizon, near which curves differ
    place = int(np.abs(curves.x(rows) - tracked.x(rows)).max(axis=1).argmin())
    np.testing.assert_allclose(curves[place].x(rows), tracked[0].x(rows), atol=0.1)
    np.testing.assert_allclose(curves.x(rows)[:place], without.x(rows)[:place])
    assert place >= len(prior.sides)


@pytest.mark.parametrize(
    ("presence", "is_tracking", "expected"),
    [
        ((0.3, 0.49), False, 0.0),
        ((0.1, 0.5), False, 1.0),
        ((0.1, 0.26), True, 1.0),
        ((0.1, 0.24), True, 0.0),
    ],
)
def test_a_frame_in_which_neither_ego_boundary_is_likely_has_no_boundaries(
    presence: tuple[float, float], is_tracking: bool, expected: float
) -> None:
    output = RegressorOutput(np.full((2, 3), 0.1), np.full((2, 3), 0.01), np.array(presence), 0.0, np.zeros(2))
    prior = RoadRegressor(0.6).prior(output, VIEW, is_tracking=is_tracking)
    assert prior.sides == ()
    np.testing.assert_array_equal(prior.odds(lines(-1.0, 0.4)), np.full((2, 2), expected))
