"""Edges of the road: their candidates, and what the detector reports of them and of the markings beside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import roads
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.classification import Classification
from lanestream.detection.ego_prior import EgoPrior
from lanestream.detection.features import Channels
from lanestream.detection.interface import FrameContext
from lanestream.detection.proposals import MOST_CANDIDATES, Proposals, propose
from lanestream.road.curve import Curves
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_spans

VIEW = RoadView(640, 360, 150.0)
ASPHALT, KERB, EARTH = (90, 90, 90), (125, 125, 125), (60, 70, 80)
# As bright as the asphalt in the paint channel, in which markings are searched.
GRASS = (45, 100, 80)
SURFACES = pytest.mark.parametrize("beside", [KERB, EARTH, GRASS], ids=["kerb", "earth", "grass"])


# A candidate this close to a boundary, in depths, shows it in its patch, and the fit reaches it.
CLOSE = 0.04


def road(
    edges: Sequence[float],
    beside: tuple[int, int, int],
    markings: Sequence[float] = (),
    view: RoadView = VIEW,
    noise: float = 2.0,
) -> Image:
    """Returns a road between `edges`, left and right, with `markings`; all positions are in row offsets."""
    lines = [roads.straight(view, edge) for edge in edges]
    image = roads.draw_surfaces(view, lines, [beside, ASPHALT, beside], noise)
    return roads.paint_on(image, view, [roads.straight(view, marking) for marking in markings])


def distances(proposals: Proposals, position: float, view: RoadView = VIEW) -> NDArray[np.float64]:
    """Returns how far the candidates are from a straight line at `position`, in depths, where it is in the image."""
    line = roads.straight(view, position)
    rows = view.horizon + np.linspace(0.15, 1.0, 30) * view.depth
    rows = rows[(rows >= 0.0) & (np.abs(line.x(rows) - view.middle) <= view.middle)]
    return np.asarray(np.abs(proposals.curves.x(rows) - line.x(rows)).max(axis=1) / view.depth)


# --- Candidates -----------------------------------------------------------------------------------------------------


@SURFACES
def test_the_edges_of_an_unmarked_road_are_candidates(beside: tuple[int, int, int]) -> None:
    left = Curves.of([roads.straight(VIEW, -1.6)])
    prior = EgoPrior(VIEW, (-1,), left, np.full((1, 2), 0.05), np.ones(1), np.ones(1))
    channels = Channels.of(road((-1.6, 1.3), beside, noise=0.5))
    proposals = propose(channels, FrameContext(VIEW.horizon), prior, None)
    assert distances(proposals, 1.3).min() < CLOSE


@SURFACES
@pytest.mark.parametrize("markings", [(0.0,), (-1.2, 1.2), (-3.6, -1.2, 1.2)])
def test_the_edges_of_a_marked_road_are_candidates_too(
    beside: tuple[int, int, int], markings: tuple[float, ...]
) -> None:
    proposals = propose(Channels.of(road((-4.2, 1.9), beside, markings)), FrameContext(VIEW.horizon), None, None)
    assert distances(proposals, 1.9).min() < CLOSE
    assert all(distances(proposals, marking).min() < CLOSE for marking in markings)


@SURFACES
def test_a_marking_and_the_edge_beside_it_are_candidates(beside: tuple[int, int, int]) -> None:
    # 0.4 m apart before a camera 1.4 m high.
    edge = 1.2 + 0.4 / 1.4
    proposals = propose(Channels.of(road((-4.2, edge), beside, (-1.2, 1.2))), FrameContext(VIEW.horizon), None, None)
    assert distances(proposals, 1.2).min() < CLOSE
    assert distances(proposals, edge).min() < CLOSE


def test_the_sides_of_a_marking_are_no_candidates_of_their_own() -> None:
    markings = (-1.2, 1.2)
    channels = roads.channels(roads.draw_road(VIEW, [roads.straight(VIEW, each) for each in markings]))
    proposals = propose(channels, FrameContext(VIEW.horizon), None, None)
    for marking in markings:
        near = np.abs(proposals.curves.coefficients[:, 1] - marking) < 0.2
        assert near.sum() == 1


@pytest.mark.parametrize("limit", [8, MOST_CANDIDATES])
def test_at_most_a_quarter_of_the_candidates_are_steps_and_they_come_last(limit: int) -> None:
    bright = np.arange(-4.0, 4.1, 0.5)
    stripes = roads.draw_road(VIEW, [roads.straight(VIEW, each) for each in bright.tolist()], width=0.08)
    # Bands between the markings, which differ in blue alone.
    bands = [roads.straight(VIEW, each) for each in (bright[:-1] + 0.25).tolist()]
    blue = roads.draw_surfaces(VIEW, bands, [ASPHALT, GRASS] * 8 + [ASPHALT])[:, :, 0]
    with_steps, without = (
        propose(channels, FrameContext(VIEW.horizon), None, None, limit)
        for channels in (Channels(stripes, blue), Channels(stripes, np.full_like(stripes, 90)))
    )
    assert len(with_steps.curves) == limit
    at_bands = np.abs(with_steps.curves.coefficients[:, 1:2] - (bright[:-1] + 0.25)).min(axis=1) < 0.05
    assert 1 <= at_bands.sum() <= round(0.25 * limit)
    assert not at_bands[: limit - round(0.25 * limit)].any()
    first = limit - round(0.25 * limit)
    np.testing.assert_allclose(with_steps.curves.coefficients[:first], without.curves.coefficients[:first])


def test_an_image_without_steps_has_only_bright_candidates() -> None:
    bright = np.array([-2.4, -1.2, 1.2, 2.4])
    lines = [roads.straight(VIEW, position) for position in bright.tolist()]
    proposals = propose(roads.channels(roads.draw_road(VIEW, lines)), FrameContext(VIEW.horizon), None, None)
    near = np.abs(proposals.curves.coefficients[:, 1:2] - bright) < 0.06
    assert near.any(axis=1).all()
    assert near.any(axis=0).all()


@SURFACES
def test_edges_below_a_horizon_above_the_picture_are_candidates(beside: tuple[int, int, int]) -> None:
    view = RoadView(640, 360, -0.15 * 360)
    edges, markings = (-0.6, 0.5), (-0.3, 0.2)
    channels = Channels.of(road(edges, beside, markings, view))
    proposals = propose(channels, FrameContext(horizon=view.horizon), None, None)
    assert proposals.view.horizon == pytest.approx(view.horizon, abs=16.0)
    assert all(distances(proposals, each, view).min() < CLOSE for each in (*edges, *markings))


def test_a_tracked_edge_that_is_nearly_level_in_the_image_stays_a_candidate() -> None:
    """The far edge of a wide road crosses few rows, but is long."""
    plain = roads.channels(np.full((360, 640), 100, np.uint8))
    context = FrameContext(VIEW.horizon, Curves.of([roads.straight(VIEW, 8.0)]))
    assert distances(propose(plain, context, None, None), 8.0).min() < CLOSE


# --- Boundaries -----------------------------------------------------------------------------------------------------

MARKING, EDGE = (0.95, 0.02), (0.03, 0.9)


def decided(image: Image, *candidates: tuple[float, tuple[float, float]]) -> list[Detection]:
    """Returns the boundaries if the classifier gives these probabilities, marking and edge, to lines at positions."""
    curves = Curves.of([roads.straight(VIEW, position) for position, _ in candidates])
    proposals = Proposals(Channels.of(image), curves, visible_spans(curves, VIEW), VIEW, 1.0, None)
    number = len(candidates)
    outputs = np.array([kinds for _, kinds in candidates])
    types, colors = np.tile([0.1, 0.8, 0.05, 0.05], (number, 1)), np.tile([0.3, 0.7], (number, 1))
    return list(CandidateDetector(0.5).decide(proposals, Classification(outputs, types, colors)).boundaries)


def kinds_at(detections: Sequence[Detection]) -> list[str]:
    return [detection.appearance.kind for detection in detections]


def errors(detections: Sequence[Detection], *positions: float) -> float:
    """Returns the largest distance of the boundaries from straight lines at `positions`, in pixels."""
    rows = np.linspace(200.0, 300.0, 6)
    pairs = zip(detections, positions, strict=True)
    return max(float(np.abs(each.curve.x(rows) - roads.straight(VIEW, at).x(rows)).max()) for each, at in pairs)


@SURFACES
def test_the_detector_fits_an_edge_to_the_step_between_its_surfaces(beside: tuple[int, int, int]) -> None:
    image = road((-1.6, 1.3), beside)
    found = decided(image, (-1.56, EDGE), (1.26, EDGE))
    assert kinds_at(found) == ["road_edge", "road_edge"]
    assert errors(found, -1.6, 1.3) < 1.0
    assert min(each.paint for each in found) > 0.8


# The distance of a marking from the edge beside it: 0.4 m before cameras 1.2, 1.4 and 1.8 m high.
@pytest.mark.parametrize("gap", [0.33, 0.286, 0.222])
@SURFACES
def test_a_marking_and_the_edge_beside_it_are_two_boundaries(gap: float, beside: tuple[int, int, int]) -> None:
    image = road((-4.2, 1.2 + gap), beside, (-1.2, 1.2))
    found = decided(image, (-1.2, MARKING), (1.21, MARKING), (1.2 + gap, EDGE))
    assert kinds_at(found) == ["marking", "marking", "road_edge"]
    assert errors(found, -1.2, 1.2, 1.2 + gap) < 2.0


def test_a_marking_and_an_edge_on_one_line_are_one_boundary() -> None:
    image = road((-4.2, 1.3), GRASS, (-1.2, 1.25))
    found = decided(image, (-1.2, MARKING), (1.25, MARKING), (1.3, EDGE))
    assert kinds_at(found) == ["marking", "marking"]
    assert errors(found, -1.2, 1.25) < 2.0
    assert 0.1 < found[1].appearance.road_edge < 0.5
    assert found[0].appearance.road_edge == pytest.approx(0.02 / 0.97)


def test_detections_have_the_appearance_of_their_candidates() -> None:
    (found,) = decided(road((-4.2, 1.9), GRASS, (-1.2,)), (-1.2, MARKING))
    assert found.appearance.types == pytest.approx((0.1, 0.8, 0.05, 0.05))
    assert found.appearance.colors == pytest.approx((0.3, 0.7))
    assert found.probability == pytest.approx(0.97)


def test_two_edges_as_close_as_a_marking_and_its_edge_are_one() -> None:
    found = decided(road((-4.2, 1.6), GRASS, (-1.2,)), (-1.2, MARKING), (1.3, (0.02, 0.6)), (1.6, (0.02, 0.9)))
    assert kinds_at(found) == ["marking", "road_edge"]
    assert errors(found, -1.2, 1.6) < 2.0
