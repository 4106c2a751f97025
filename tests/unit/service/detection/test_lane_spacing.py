"""Where boundaries are expected once the ego lane is known, and how a prior changes the candidates."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from lanestream.detection.lattice import LaneSpacing

from lanestream.detection.ego_prior import EgoPrior, PriorBoundary
from lanestream.detection.proposals import CandidateSearch
from lanestream.road.curve import Curve
from lanestream.road.view import Image, RoadView


def test_lines_at_places_of_the_lattice_are_trusted_most() -> None:
    lattice = LaneSpacing(-1.0, 1.4)
    assert lattice.neighbours == pytest.approx((-3.4, 3.8))
    trust = lattice.trust(np.array([-1.0, 1.4, -3.4, 3.8, 6.2, 0.2]))
    assert trust[:5] == pytest.approx([1.0, 1.0, 1.0, 1.0, 0.6])
    assert trust[5] < 0.4


def test_one_boundary_stands_for_a_usual_lane() -> None:
    assert LaneSpacing.of(-1.2, None).right > 0.0
    assert LaneSpacing.of(None, 1.2).left < 0.0
    with pytest.raises(ValueError, match="boundary"):
        LaneSpacing.of(None, None)


def test_a_lane_that_can_be_none_does_not_set_the_width() -> None:
    assert 1.0 < LaneSpacing(-0.1, 0.1).width < 2.0
    assert LaneSpacing(-5.0, 5.0).width < 5.0


def faint_road(bend: float) -> tuple[Image, EgoPrior]:
    """A bent road of two lanes whose boundaries can hardly be seen, and a prior that knows the ego lane."""
    rng = np.random.default_rng(3)
    view = RoadView(640, 360, 150.0)
    image = rng.normal(100.0, 4.0, (360, 640, 3))
    curves = [Curve(150.0, (320.0, b, bend * view.depth**2)) for b in (-1.2, 1.2, 3.6)]
    rows = np.linspace(359.0, 165.0, 100)
    for curve in curves:
        line = np.stack([curve.x(rows), rows], axis=1).round().astype(np.int32)
        cv2.polylines(image, [line], isClosed=False, color=(125.0, 125.0, 125.0), thickness=3)
    left, right = (PriorBoundary(curve, np.full(2, 0.05), 1.0) for curve in curves[:2])
    return image.clip(0, 255).astype(np.uint8), EgoPrior(view, left, right)


@pytest.mark.parametrize("bend", [0.0, 0.02])
def test_a_prior_puts_its_own_boundaries_and_their_neighbours_first(bend: float) -> None:
    image, prior = faint_road(bend)
    proposals = CandidateSearch(limit=4).propose(image, prior=prior)
    assert proposals.view.horizon == pytest.approx(prior.view.horizon, abs=7.0)
    rows = np.array([200.0, 250.0])
    outer = Curve(150.0, (320.0, 3.6, bend * prior.view.depth**2))
    for wanted in (*prior.curves, outer):
        off = [np.abs(candidate.curve.x(rows) - wanted.x(rows)).max() for candidate in proposals.candidates]
        assert min(off) < 6.0


def test_a_prior_without_boundaries_is_none() -> None:
    image, prior = faint_road(0.0)
    nothing = EgoPrior(prior.view, None, None)
    plain, guided = (CandidateSearch().propose(image, prior=given) for given in (None, nothing))
    assert [c.curve for c in plain.candidates] == [c.curve for c in guided.candidates]


def test_boundaries_of_the_last_frame_come_before_the_prior() -> None:
    image, prior = faint_road(0.0)
    expected = Curve(150.0, (320.0, -0.6, 0.0))
    proposals = CandidateSearch().propose(image, 150.0, [expected], prior)
    rows = np.linspace(180.0, 359.0, 20)  # told from the horizon that the search has found
    np.testing.assert_allclose(proposals.candidates[0].curve.x(rows), expected.x(rows), atol=0.1)
