"""Candidates and the detector on rendered and drawn roads, whose boundaries are known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import roads
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.classification import Classification
from lanestream.detection.ego_prior import EgoPrior
from lanestream.detection.features import Channels
from lanestream.detection.interface import Detections, FrameContext, ModelRole
from lanestream.detection.proposals import (
    MOST_CANDIDATES,
    MOST_WITH_TRACKS,
    Proposals,
    are_duplicates,
    non_maximum_suppression,
    propose,
)
from lanestream.images.resizing import working_image
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import Image, RoadView, visible_spans
from lanestream_exporter.scenes import Drive, render_still, sample_clip

Array = NDArray[np.float64]

SIZES = [(320, 180), (640, 360), (640, 480), (480, 640), (1280, 720), (3840, 2160)]
VIEW = RoadView(640, 360, 150.0)
DETECTOR = CandidateDetector(0.5)
GRAY = roads.channels(np.full((360, 640), 90, np.uint8))


@dataclass(frozen=True)
class LabeledRoad:
    """A working image, its horizon's row, and its boundaries as polylines (N, 2) by position."""

    image: Image
    horizon: float
    labels: dict[int, Array]

    @property
    def ego(self) -> list[Array]:
        return [self.labels[position] for position in (-1, 1)]


def highway(width: int = 640, height: int = 360, seed: int = 24) -> LabeledRoad:
    """Returns a rendered highway on a clear day."""
    rng = np.random.default_rng(seed)
    clip = sample_clip(rng, width, height, frames=1, fps=25.0, drive=Drive("highway", fair=True))
    still = render_still(clip.scene_at(0))
    image, scaling = working_image(still.image)
    labels = {lane.position: scaling.to_working(lane.points) for lane in still.labels.lanes}
    return LabeledRoad(image, scaling.to_working(still.horizon), labels)


def mean_errors(curves: Curves | Sequence[Curve], top: Array, bottom: Array, label: Array, view: RoadView) -> Array:
    """Returns the mean distance of curves (N,) from a label across the line, inf if they share too few of its rows."""
    order = np.argsort(label[:, 1])
    rows = np.linspace(max(label[:, 1].min(), view.row_at(0.08)), label[:, 1].max(), 48)
    columns = np.interp(rows, label[order, 1], label[order, 0])
    found = []
    for curve, first, last in zip(curves, top.tolist(), bottom.tolist(), strict=True):
        covered = (rows >= first - 1.0) & (rows <= last + 1.0)
        across = np.abs(curve.x(rows) - columns) / np.hypot(1.0, curve.slope(rows))
        found.append(across[covered].mean() if covered.mean() >= 0.6 else np.inf)
    return np.array(found)


def proposal_errors(proposals: Proposals, label: Array) -> Array:
    return mean_errors(proposals.curves, proposals.spans.top, proposals.spans.bottom, label, proposals.view)


def oracle(proposals: Proposals, road: LabeledRoad) -> NDArray[np.float32]:
    """Returns what a perfect classifier outputs: candidates within 8 pixels of a label are boundaries."""
    errors = np.array([proposal_errors(proposals, label) for label in road.labels.values()])
    is_boundary = (errors.min(axis=0) <= 8.0).astype(np.float32)
    return np.stack([1.0 - is_boundary, is_boundary], axis=1)


def accept_all(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
    assert role == "classifier"
    return np.tile(np.array([[0.0, 1.0]], np.float32), (len(inputs), 1))


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_ego_boundaries_are_proposed_at_any_size(width: int, height: int) -> None:
    road = highway(width, height)
    proposals = propose(Channels.of(road.image), FrameContext(), None, None)
    assert 2 <= len(proposals.curves) <= MOST_CANDIDATES
    assert proposals.view.horizon == pytest.approx(road.horizon, abs=0.04 * len(road.image))
    assert all(proposal_errors(proposals, label).min() <= 8.0 for label in road.ego)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_perfect_classifier_gives_exact_boundaries(width: int, height: int) -> None:
    """With the truth instead of the classifier only the geometry is left, which must be exact to a pixel or two."""
    road = highway(width, height)
    patches: list[NDArray[np.uint8]] = []

    def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        patches.append(inputs)
        return oracle(DETECTOR.propose(road.image, FrameContext(), infer), road)

    detections = DETECTOR.detect(road.image, FrameContext(), infer)
    (inputs,) = patches
    assert inputs.shape[1:] == (112, 112, 3)
    found = detections.boundaries
    top, bottom = np.array([(each.top, each.bottom) for each in found]).T
    curves = [each.curve for each in found]
    errors = [mean_errors(curves, top, bottom, label, detections.view).min() for label in road.ego]
    assert np.mean(errors) < 2.5


@pytest.mark.parametrize("off", [0.0, 8.0])
def test_a_known_horizon_moves_only_by_a_pitch(off: float) -> None:
    road = highway()
    horizon = road.horizon + off
    proposals = propose(Channels.of(road.image), FrameContext(horizon), None, None)
    assert proposals.view.horizon == pytest.approx(horizon, abs=20.0)


def follows(curves: Curves, known: Curve, bottom: float) -> NDArray[np.bool_]:
    """Returns which curves are a known one, re-expressed below the horizon that the search has found."""
    rows = np.linspace(known.horizon + 0.15 * (bottom - known.horizon), bottom, 20)
    return np.asarray(np.abs(curves.x(rows) - known.x(rows)).max(axis=1) < 0.1)


def test_tracked_boundaries_come_first_and_fewer_others_with_them() -> None:
    lines = [roads.straight(VIEW, position) for position in np.arange(-4.0, 4.1, 0.4).tolist()]
    channels = roads.channels(roads.draw_road(VIEW, lines))
    plain = propose(channels, FrameContext(150.0), None, None)
    assert len(plain.curves) == MOST_CANDIDATES == 16
    tracked = plain.curves.take([15])
    proposals = propose(channels, FrameContext(150.0, tracked), None, None)
    assert len(proposals.curves) == MOST_WITH_TRACKS == 12
    assert follows(proposals.curves, tracked[0], VIEW.bottom)[0]


def prior_of(*curves: Curve) -> EgoPrior:
    sides = (-1, 1)[: len(curves)]
    return EgoPrior(
        VIEW, sides, Curves.of(curves), np.full((len(curves), 2), 0.05), np.ones(len(curves)), np.zeros(len(curves))
    )


@pytest.mark.parametrize(("off", "tracked", "found"), [(0.03, False, 1), (0.16, False, 2), (0.16, True, 2)])
def test_a_line_near_a_boundary_of_the_prior_is_a_candidate_unless_it_is_a_duplicate(
    off: float, tracked: bool, found: int
) -> None:
    left, right = roads.straight(VIEW, -1.2), roads.straight(VIEW, 1.2)
    beside = roads.straight(VIEW, -1.2 + off)
    context = FrameContext(150.0, Curves.of([beside]) if tracked else None)
    proposals = propose(roads.channels(roads.draw_road(VIEW, [left, right])), context, prior_of(beside, right), None)
    assert follows(proposals.curves, beside, VIEW.bottom)[0]
    row = np.array([VIEW.bottom])
    right_of_left = (proposals.curves.x(row)[:, 0] - float(left.x(VIEW.bottom))) / VIEW.depth
    assert ((right_of_left > -0.05) & (right_of_left < 0.25)).sum() == found


def test_fits_of_the_prior_to_its_paint_are_candidates_too_unless_they_are_tracked() -> None:
    bare = roads.channels(np.full((360, 640), 100, np.uint8))
    seen, on_paint = roads.straight(VIEW, -1.2), roads.straight(VIEW, -1.1)

    def count(curve: Curve, tracked: Curves | None) -> int:
        proposals = propose(bare, FrameContext(150.0, tracked), prior_of(seen), Curves.of([on_paint]))
        return int(follows(proposals.curves, curve, VIEW.bottom).sum())

    assert [count(curve, None) for curve in (seen, on_paint)] == [1, 1]
    assert count(on_paint, Curves.of([on_paint])) == 1


def test_faint_lines_are_not_candidates() -> None:
    strong, faint = roads.straight(VIEW, -1.2), roads.straight(VIEW, 1.2)
    for rows, expected in ((0.03, 0), (0.5, 1)):
        gray = roads.draw_road(VIEW, [strong])
        gray = roads.draw_road(
            VIEW, [faint], is_painted=lambda share, rows=rows: abs(share - 0.5) < 0.5 * rows, gray=gray
        )
        proposals = propose(roads.channels(gray), FrameContext(150.0), None, None)
        row = np.array([VIEW.row_at(0.5)])
        near = np.abs(proposals.curves.x(row)[:, 0] - float(faint.x(row[0]))) < 8.0
        assert near.sum() == expected


@pytest.mark.parametrize("share", [0.0001, 0.1, 0.9, 0.99, 0.9999])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (320, 64), (64, 320), (640, 360)])
def test_an_absurd_horizon_is_harmless(share: float, width: int, height: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    image, _ = working_image(noise)
    detections = DETECTOR.detect(image, FrameContext(share * len(image)), accept_all)
    assert detections.view.depth > 0.0
    require_sane(detections)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((360, 640, 3), np.uint8),
        np.full((360, 640, 3), 255, np.uint8),
        np.random.default_rng(0).integers(0, 256, (360, 640, 3), dtype=np.uint8),
        np.tile(np.linspace(0, 255, 640, dtype=np.uint8)[None, :, None], (360, 1, 3)),
    ],
    ids=["black", "white", "noise", "gradient"],
)
def test_images_without_a_road_are_harmless(image: NDArray[np.uint8]) -> None:
    require_sane(DETECTOR.detect(image, FrameContext(), accept_all))


def require_sane(detections: Detections) -> None:
    """Fails unless boundaries are finite, ordered from left to right, and do not cross where both are visible."""
    for detection in detections.boundaries:
        assert np.isfinite(detection.curve.coefficients).all()
        assert np.isfinite(detection.covariance).all()
        assert detection.top < detection.bottom
    if detections.boundaries:
        rows = detections.view.horizon + np.array([0.25, 0.5, 1.0]) * detections.view.depth
        columns = Curves.of([detection.curve for detection in detections.boundaries]).x(rows)
        assert (np.diff(columns, axis=0) > 0.0).all()


def test_the_more_probable_of_two_crossing_lines_is_reported() -> None:
    curves = Curves(150.0, np.array([[320.0, 0.9, 0.0], [620.0, -0.4, 0.0], [320.0, -1.2, 0.0]]))
    proposals = Proposals(GRAY, curves, visible_spans(curves, VIEW), VIEW, 1.0, None)
    outputs = np.array([[0.1, 0.9], [0.3, 0.7], [0.2, 0.8]], np.float32)
    boundaries = DETECTOR.decide(proposals, Classification.of(outputs)).boundaries
    assert [each.probability for each in boundaries] == pytest.approx([0.8, 0.9])


def test_candidates_of_one_marking_become_one_boundary_at_their_mean_weighted_by_probability() -> None:
    curves = Curves(150.0, np.array([[320.0, position, 0.0] for position in (-1.21, -1.17, -1.1, 1.2)]))
    proposals = Proposals(GRAY, curves, visible_spans(curves, VIEW), VIEW, 0.7, None)
    outputs = np.array([[0.1, 0.9], [0.1, 0.9], [0.48, 0.52], [0.05, 0.95]], np.float32)
    detections = DETECTOR.decide(proposals, Classification.of(outputs))
    assert detections.horizon_weight == 0.7
    assert [each.curve.coefficients[1] for each in detections.boundaries] == pytest.approx([-1.19, 1.2], abs=0.01)
    assert [each.probability for each in detections.boundaries] == pytest.approx([0.9, 0.95])


def test_without_accepted_candidates_there_are_no_boundaries() -> None:
    curves = Curves(150.0, np.array([[320.0, 1.2, 0.0]]))
    proposals = Proposals(GRAY, curves, visible_spans(curves, VIEW), VIEW, 0.7, None)
    detections = DETECTOR.decide(proposals, Classification.of(np.array([[0.6, 0.4]], np.float32)))
    assert (detections.boundaries, detections.view) == ((), VIEW)


@given(st.integers(0, 7), st.integers(0, 2**32 - 1))
def test_suppression_keeps_the_best_that_do_not_conflict(number: int, seed: int) -> None:
    random = np.random.default_rng(seed).random((number, number)) < 0.3
    conflicts = random | random.T
    kept = non_maximum_suppression(conflicts).tolist()
    expected: list[int] = []
    for index in range(number):
        if not any(conflicts[index, better] for better in expected):
            expected.append(index)
    assert kept == expected


def test_duplicates_are_near_at_both_rows_across_the_line() -> None:
    curves = Curves(150.0, np.array([[320.0, position, 0.0] for position in (0.0, 0.04, 0.06, 3.0, 3.1)]))
    duplicates = are_duplicates(curves, curves, VIEW)
    assert duplicates[0].tolist() == [True, True, False, False, False]
    assert duplicates[3].tolist() == [False, False, False, True, True], (
        "an oblique line is farther away for its columns"
    )
    turned = Curves(150.0, np.array([[320.0, 0.0, 0.0], [380.0, -0.28, 0.0]]))
    assert not are_duplicates(turned, turned, VIEW)[0, 1]
