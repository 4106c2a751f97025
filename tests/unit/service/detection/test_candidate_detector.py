"""Candidates and the detector on rendered scenes, whose boundaries are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.ego_prior import EgoPrior, PriorBoundary
from lanestream.detection.patches import PatchCutter
from lanestream.detection.proposals import CandidateSearch
from lanestream.road.curve import Curve
from lanestream.road.results import Candidate
from lanestream.road.view import RoadView
from lanestream_exporter.datasets.labels import WHOLE
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, ego_labels, match
from lanestream_exporter.evaluation.score import BoundaryCounts
from lanestream_exporter.samples.patches import TRUE, TruthRule, fitted_candidate
from lanestream_exporter.scenes import Drive, RenderedFrame, render_still, sample_clip

SIZES = [(320, 180), (640, 360), (640, 480), (480, 640), (1280, 720), (3840, 2160)]


def fair_scene(width: int, height: int, seed: int = 24) -> RenderedFrame:
    """A highway on a clear day."""
    clip = sample_clip(
        np.random.default_rng(seed), width, height, frames=1, fps=25.0, drive=Drive("highway", fair=True)
    )
    return render_still(clip.scene_at(0))


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_ego_boundaries_are_proposed_at_any_size(width: int, height: int) -> None:
    still = fair_scene(width, height)
    proposals = CandidateSearch().propose(still.image)
    assert 2 <= len(proposals.candidates) <= 16
    assert proposals.view.horizon == pytest.approx(still.horizon, abs=0.04 * height)
    rule = TruthRule(near=16.0)
    for lane in ego_labels(still.labels):
        alone = type(still.labels)(width, height, (lane,), "scene", "rendered", WHOLE)
        assert TRUE in rule.judge(proposals.candidates, alone, proposals.view)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_an_oracle_network_gives_exact_boundaries(width: int, height: int) -> None:
    """With the truth in the classifier's place, what is left is the geometry: refinement must be sub-pixel exact."""
    still = fair_scene(width, height)
    detector = CandidateDetector()
    prepared = detector.prepare(still.image)
    assert prepared.inputs.shape == (len(prepared.candidates), 112, 112, 3)
    verdicts = TruthRule(near=16.0).judge(prepared.candidates, still.labels, prepared.view)
    outputs = np.stack([verdicts != TRUE, verdicts == TRUE], axis=1).astype(np.float32)
    found = [ReportedBoundary(d.curve, d.top, d.bottom, 0) for d in detector.finish(prepared, outputs).detections]
    tally = BoundaryCounts()
    tally.add(match(found, ego_labels(still.labels), still.labels))
    assert tally.missed == 0
    assert tally.mean_error < 2.5


def test_a_known_horizon_is_kept_but_for_a_nod() -> None:
    still = fair_scene(640, 360)
    for horizon in (still.horizon, still.horizon + 8.0):
        assert CandidateSearch().propose(still.image, horizon).view.horizon == pytest.approx(horizon, abs=20.0)


def is_told_anew(curve: Curve, known: Curve, bottom: float) -> bool:
    """Whether a candidate's curve is a known one, told from the horizon that the search has found."""
    rows = np.linspace(known.horizon + 0.15 * (bottom - known.horizon), bottom, 20)
    return bool(np.abs(curve.x(rows) - known.x(rows)).max() < 0.1)


def test_followed_boundaries_come_first_and_fewer_others_with_them() -> None:
    still = fair_scene(640, 360)
    search = CandidateSearch(faintest=0.0)
    found = search.propose(still.image).candidates
    expected = [found[-1].curve]
    followed = search.propose(still.image, still.horizon, expected).candidates
    assert len(found) == 16
    assert len(followed) == 12
    assert is_told_anew(followed[0].curve, expected[0], 359.0)


def test_the_line_beside_a_boundary_of_the_prior_is_a_candidate_too_unless_boundaries_are_followed() -> None:
    still = fair_scene(640, 360)
    view = RoadView(640, 360, still.horizon)
    fits = (fitted_candidate(lane, view) for lane in ego_labels(still.labels))
    left, right = (fit.curve for fit in fits if fit is not None)
    aside = Curve(left.horizon, (left.coefficients[0], left.coefficients[1] + 0.06, left.coefficients[2]))
    spread = np.full(2, 0.05)
    prior = EgoPrior(view, PriorBoundary(aside, spread, 1.0), PriorBoundary(right, spread, 1.0))

    def beside(twin: float, expected: list[Curve]) -> int:
        search = CandidateSearch(twin=twin)
        found = search.propose(still.image, still.horizon, expected, prior).candidates
        assert is_told_anew(found[0].curve, (expected or [aside])[0], view.bottom)
        near = [abs(float(candidate.curve.x(view.bottom) - left.x(view.bottom))) for candidate in found]
        return sum(off < 0.03 * view.depth for off in near)

    assert beside(0.02, []) == 1  # the paint itself
    assert beside(0.05, []) == 0  # the prior's boundary alone, as all that is near is a repetition of it
    assert beside(0.02, [aside]) == 0


def test_the_boundaries_of_the_prior_are_candidates_on_the_paint_too_unless_they_are_followed_there() -> None:
    bare = np.full((360, 640, 3), 100, np.uint8)
    view = RoadView(640, 360, 150.0)
    seen, painted = (Curve(150.0, (320.0, slope, 0.0)) for slope in (-1.2, -1.14))
    prior = EgoPrior(view, PriorBoundary(seen, np.full(2, 0.05), 1.0, painted), None)

    def proposed(curve: Curve, expected: list[Curve]) -> int:
        found = CandidateSearch().propose(bare, 150.0, expected, prior).candidates
        return sum(is_told_anew(candidate.curve, curve, view.bottom) for candidate in found)

    assert [proposed(curve, []) for curve in (seen, painted)] == [1, 1]
    assert proposed(painted, [painted]) == 1


def test_a_glance_that_saw_no_boundary_still_tells_the_horizon() -> None:
    bare = np.full((360, 640, 3), 100, np.uint8)
    prior = EgoPrior(RoadView(640, 360, 180.0), None, None)
    assert CandidateSearch().propose(bare, 150.0, (), prior).view.horizon == pytest.approx(180.0, abs=7.0)
    assert CandidateSearch().propose(bare, 150.0).view.horizon == pytest.approx(150.0, abs=7.0)


def test_faint_lines_are_no_candidates() -> None:
    still = fair_scene(640, 360)
    every = CandidateSearch(faintest=0.0).propose(still.image).candidates
    strong = CandidateSearch(faintest=0.3).propose(still.image).candidates
    assert min(c.strength for c in every) < 0.3 <= min(c.strength for c in strong)
    assert strong == every[: len(strong)]


@pytest.mark.parametrize("share", [0.0001, 0.1, 0.9, 0.99, 0.9999])
@pytest.mark.parametrize(("width", "height"), [(64, 64), (320, 64), (64, 320), (640, 360)])
def test_a_senseless_horizon_does_no_harm(share: float, width: int, height: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)
    detector = CandidateDetector()
    prepared = detector.prepare(noise, share * height)
    accepted = np.tile(np.array([[0.0, 1.0]], np.float32), (len(prepared.candidates), 1))
    assert prepared.view.depth > 0.0
    assert all(np.isfinite(d.covariance).all() for d in detector.finish(prepared, accepted).detections)


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
def test_images_without_a_road_do_no_harm(image: NDArray[np.uint8]) -> None:
    detector = CandidateDetector()
    prepared = detector.prepare(image)
    accepted = np.tile(np.array([[0.0, 1.0]], np.float32), (len(prepared.candidates), 1))
    for detection in detector.finish(prepared, accepted).detections:
        assert np.isfinite(detection.curve.coefficients).all()
        assert np.isfinite(detection.covariance).all()


def test_the_marking_stands_upright_in_its_patch() -> None:
    image = np.full((360, 640, 3), 70, np.uint8)
    curve = Curve(160.0, (320.0, 1.1, 0.0))
    for y in range(170, 360):
        half = 0.05 * (y - 160)
        x = float(curve.x(y))
        image[y, max(0, round(x - half)) : round(x + half) + 1] = 230
    patch = PatchCutter().cut(image, [Candidate(curve, 178.0, 359.0, 1.0)], RoadView(640, 360, 160.0))[0]
    bright = patch[15:, :, 0] > 150
    centres = np.array([np.flatnonzero(row).mean() for row in bright])
    widths = bright.sum(axis=1)
    np.testing.assert_allclose(centres, 55.5, atol=3.0)
    np.testing.assert_allclose(widths[30:], 11.0, atol=3.0)


def test_patches_are_rgb() -> None:
    image = np.zeros((360, 640, 3), np.uint8)
    image[:] = (10, 20, 200)  # red in BGR
    patch = PatchCutter().cut(
        image, [Candidate(Curve(160.0, (320.0, 0.0, 0.0)), 180.0, 359.0, 1.0)], RoadView(640, 360, 160.0)
    )
    assert tuple(patch[0, 100, 100]) == (200, 20, 10)
