"""The regression detector and the ego-lane prior on a drawn road; the network is a fake."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import roads
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.ego_prior import (
    REGRESSOR_ANCHORS,
    UNKNOWN_HORIZONS,
    EgoPrior,
    RegressorOutput,
    RoadRegressor,
)
from lanestream.detection.features import Channels
from lanestream.detection.interface import Detections, FrameContext, ModelRole
from lanestream.detection.regression_detector import RegressionDetector, fit_output
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import RoadView

Outputs = NDArray[np.float32]

WIDTH, HEIGHT, HORIZON = 640, 360, 150.0
VIEW = RoadView(WIDTH, HEIGHT, HORIZON)
LEFT, RIGHT = Curve(HORIZON, (VIEW.middle + 8.0, -1.1, 300.0)), Curve(HORIZON, (VIEW.middle + 8.0, 1.3, 300.0))
ROAD = roads.in_color(roads.draw_road(VIEW, [LEFT, RIGHT], width=0.06, paint=255))
REGRESSOR = RoadRegressor(0.5)
DETECTOR = RegressionDetector(REGRESSOR)


def output_for(
    view: RoadView,
    presence: tuple[float, float] = (0.9, 0.9),
    horizon: float = 0.0,
    road_edge: tuple[float, float] = (0.1, 0.1),
) -> Outputs:
    """Returns the output (17,) of a network that sees the road's boundaries in `view`, and its `horizon` in depths."""
    rows = view.horizon + REGRESSOR_ANCHORS * view.depth
    columns = [(curve.x(rows) - VIEW.middle) / WIDTH for curve in (LEFT, RIGHT)]
    return np.concatenate([*columns, np.full(6, 0.01), presence, [horizon], road_edge]).astype(np.float32)


def off_the_paint(sigma: float) -> Outputs:
    """Returns an output whose boundaries are 8 pixels right of their paint."""
    output = output_for(VIEW)
    output[:6] += 0.012
    output[6:12] = sigma
    return output


class FakeRegressor:
    """Returns `looks` for the crops of several horizons, and `output` for a crop and its mirror image.

    Records its inputs.
    """

    def __init__(self, output: Outputs, looks: Outputs | None = None) -> None:
        self.output, self.looks = output, looks
        self.inputs: list[NDArray[np.uint8]] = []

    def __call__(self, role: ModelRole, inputs: NDArray[np.uint8]) -> Outputs:
        assert role == "regressor"
        self.inputs.append(inputs)
        if len(inputs) != 1:
            assert self.looks is not None
            return self.looks
        is_mirrored = len(self.inputs) > 1 and np.array_equal(inputs[0], self.inputs[-2][0, :, ::-1])
        return (mirrored(self.output) if is_mirrored else self.output)[None]


def mirrored(output: Outputs) -> Outputs:
    """Returns what the network outputs for the mirror image of a crop for which it returns `output`."""
    left, right, left_sigma, right_sigma = np.split(output[:12], 4)
    return np.concatenate([-right, -left, right_sigma, left_sigma, output[[13, 12, 14, 16, 15]]])


def detect(output: Outputs, horizon: float = HORIZON) -> Detections:
    return DETECTOR.detect(ROAD, FrameContext(horizon), FakeRegressor(output))


def test_an_output_is_read_as_the_curves_it_was_made_of() -> None:
    curves = RegressorOutput.of(output_for(VIEW)).curves(VIEW)
    for curve, expected in zip(curves, (LEFT, RIGHT), strict=True):
        np.testing.assert_allclose(curve.coefficients, expected.coefficients, rtol=1e-3)


def test_the_output_of_a_mirrored_crop_is_mirrored_back() -> None:
    output = off_the_paint(0.02)
    output[6:12] = np.linspace(0.01, 0.06, 6)
    output[12:17] = 0.7, 0.8, 0.1, 0.2, 0.9
    straight, back = RegressorOutput.of(output), RegressorOutput.of(mirrored(output)).mirrored
    mean = straight.mean(back)
    for name in ("columns", "sigma", "presence", "horizon", "road_edge"):
        np.testing.assert_allclose(getattr(back, name), getattr(straight, name), rtol=1e-6)
        np.testing.assert_allclose(getattr(mean, name), getattr(straight, name), rtol=1e-6)


def test_an_older_network_knows_only_markings() -> None:
    older = RegressorOutput.of(output_for(VIEW, road_edge=(0.9, 0.9))[:15])
    assert older.road_edge.tolist() == [0.0, 0.0]
    assert older.presence == pytest.approx([0.9, 0.9])
    assert {each.appearance.kind for each in detect(output_for(VIEW)[:15]).boundaries} == {"marking"}


@pytest.mark.parametrize(("sigma", "calls"), [(0.01, 1), (0.03, 2)])
def test_an_uncertain_network_gets_the_mirrored_crop_too(sigma: float, calls: int) -> None:
    output = output_for(VIEW, road_edge=(0.2, 0.9))
    output[6:12] = sigma
    infer = FakeRegressor(output)
    prediction, _ = REGRESSOR.predict(ROAD, HORIZON, infer)
    assert len(infer.inputs) == calls
    np.testing.assert_allclose(prediction.columns, RegressorOutput.of(output).columns, rtol=1e-5)
    np.testing.assert_allclose(prediction.road_edge, RegressorOutput.of(output).road_edge, rtol=1e-5)
    if calls == 2:
        np.testing.assert_array_equal(infer.inputs[1][0], infer.inputs[0][0, :, ::-1])


def test_the_network_gets_a_road_crop() -> None:
    infer = FakeRegressor(output_for(VIEW, horizon=0.1))
    output, view = REGRESSOR.predict(ROAD, HORIZON, infer)
    (inputs,) = infer.inputs
    assert inputs.shape == (1, 224, 224, 3)
    assert output.horizon == pytest.approx(0.1)
    assert view.horizon == pytest.approx(HORIZON + 0.1 * VIEW.depth)


def test_boundaries_are_reported_from_the_threshold_on() -> None:
    detections = detect(output_for(VIEW, presence=(0.4, 0.9)))
    assert [each.probability for each in detections.boundaries] == [pytest.approx(0.9)]
    assert float(detections.boundaries[0].curve.x(300.0)) == pytest.approx(float(RIGHT.x(300.0)), abs=2.5)
    assert detections.horizon_weight == pytest.approx(0.9)


def looks_at(views: Sequence[RoadView], sigmas: Sequence[float], horizon: float = 0.02) -> Outputs:
    """Returns the outputs for the crops at `views`: the horizon is a little lower, and the uncertainty is `sigmas`."""
    outputs = np.stack([output_for(view, horizon=horizon) for view in views])
    outputs[:, 6:12] = np.array(sigmas)[:, None]
    return outputs


SEARCHED = [VIEW.with_horizon(share * HEIGHT) for share in UNKNOWN_HORIZONS]


def test_an_unknown_horizon_is_looked_for_at_several_rows_and_then_where_it_was_seen() -> None:
    looks = looks_at(SEARCHED, [0.05, 0.005, *[0.05] * 6])
    infer = FakeRegressor(output_for(VIEW), looks)
    _, view = REGRESSOR.predict(ROAD, None, infer)
    assert [len(inputs) for inputs in infer.inputs] == [len(UNKNOWN_HORIZONS), 1, 1]
    assert view.horizon == pytest.approx(SEARCHED[1].horizon + 0.02 * SEARCHED[1].depth, abs=1.0)
    assert len(set(map(bytes, infer.inputs[0]))) == len(UNKNOWN_HORIZONS), "the crops differ"
    known = FakeRegressor(output_for(VIEW))
    REGRESSOR.predict(ROAD, HORIZON, known)
    assert [len(inputs) for inputs in known.inputs] == [1], "one look is enough for a known horizon"


def test_a_horizon_that_was_found_is_refined_until_it_hardly_moves() -> None:
    infer = FakeRegressor(output_for(VIEW, horizon=0.05), looks_at(SEARCHED, [0.05, 0.015, *[0.05] * 6]))
    _, view = REGRESSOR.predict(ROAD, None, infer)
    assert len(infer.inputs) == 1 + 3 + 1, "it always moves"
    row = SEARCHED[1].horizon + 0.02 * SEARCHED[1].depth
    for _ in range(4):
        row += 0.05 * (HEIGHT - 1.0 - row)
    assert view.horizon == pytest.approx(row, abs=1.0)


@pytest.mark.parametrize(("sigma", "presence"), [(0.005, 0.9), (0.015, 0.3)], ids=["less certain", "no road"])
def test_a_horizon_is_not_refined_towards_less_certainty_or_without_a_road(sigma: float, presence: float) -> None:
    looks = looks_at(SEARCHED, [0.05, sigma, *[0.05] * 6])
    looks[:, 12:14] = presence
    infer = FakeRegressor(output_for(VIEW, horizon=0.05), looks)
    _, view = REGRESSOR.predict(ROAD, None, infer)
    row = SEARCHED[1].horizon + 0.02 * SEARCHED[1].depth
    assert view.horizon == pytest.approx(row + 0.05 * (HEIGHT - 1.0 - row), abs=1.0), "only the last look moved it"


@pytest.mark.parametrize(
    ("sigmas", "presence", "found"),
    [(0.03, 0.9, True), (0.045, 0.9, False), (0.03, 0.3, False)],
    ids=["clearly another row", "another row, not clearly", "no road there"],
)
def test_a_doubtful_horizon_competes_with_a_search(sigmas: float, presence: float, found: bool) -> None:
    views = [VIEW, *SEARCHED]
    looks = looks_at(views, [0.05, 0.08, sigmas, *[0.08] * 6], horizon=0.0)
    looks[2, 12:14] = presence
    infer = FakeRegressor(output_for(VIEW), looks)
    _, view = REGRESSOR.predict(ROAD, HORIZON, infer, is_doubtful=True)
    assert len(infer.inputs[0]) == len(views)
    assert view.horizon == pytest.approx(SEARCHED[1].horizon if found else HORIZON, abs=1.0)


def test_a_given_horizon_is_never_searched_for() -> None:
    infer = FakeRegressor(output_for(VIEW, horizon=0.3))
    _, view = REGRESSOR.predict(ROAD, HORIZON, infer, is_given=True, is_doubtful=True)
    assert [len(inputs) for inputs in infer.inputs] == [1]
    assert view.horizon == pytest.approx(HORIZON + 0.05 * VIEW.depth)


def test_of_equally_certain_looks_the_one_counts_that_sees_the_horizon_where_it_is() -> None:
    views = [VIEW.with_horizon(share * HEIGHT) for share in UNKNOWN_HORIZONS]
    offsets = [(HORIZON - view.horizon) / view.depth for view in views]
    looks = np.stack([output_for(view, horizon=off) for view, off in zip(views, offsets, strict=True)])
    _, view = REGRESSOR.predict(ROAD, None, FakeRegressor(output_for(VIEW), looks))
    assert view.horizon == pytest.approx(HORIZON, abs=1.0)


def test_paint_corrects_a_horizon_that_was_seen_too_low() -> None:
    low = VIEW.with_horizon(HORIZON + 8.0)
    detections = detect(output_for(low), low.horizon)
    assert abs(detections.view.horizon - HORIZON) < 4.0
    for detection, curve in zip(detections.boundaries, (LEFT, RIGHT), strict=True):
        assert float(detection.curve.x(HORIZON + 16.0)) == pytest.approx(float(curve.x(HORIZON + 16.0)), abs=3.0)


def test_boundaries_are_moved_onto_the_paint_near_them() -> None:
    detections = detect(off_the_paint(0.01))
    rows = np.array([340.0, 260.0, 200.0])
    for detection, curve in zip(detections.boundaries, (LEFT, RIGHT), strict=True):
        inside = rows[np.abs(curve.x(rows) - VIEW.middle) < VIEW.middle - 4.0]
        np.testing.assert_allclose(detection.curve.x(inside), curve.x(inside), atol=2.5)
        assert (np.linalg.eigvalsh(detection.covariance) > 0.0).all()


def test_boundaries_of_which_the_network_is_certain_are_moved_by_less() -> None:
    def error(sigma: float) -> float:
        found = zip(detect(off_the_paint(sigma)).boundaries, (LEFT, RIGHT), strict=True)
        return max(abs(float(detection.curve.x(300.0) - curve.x(300.0))) for detection, curve in found)

    assert error(0.02) < 1.5 < error(0.001) < 0.013 * WIDTH


def test_only_the_wanted_sides_are_fitted() -> None:
    output, channels = RegressorOutput.of(off_the_paint(0.03)), Channels.of(ROAD)
    for wanted, expected in (([0, 1], [0, 1]), ([1], [1]), ([], [])):
        sides, fits = fit_output(channels, output, VIEW, 0.5, wanted)
        assert sides == expected
        assert len(fits.curves) == len(expected)


def test_edges_of_the_road_are_fitted_to_the_surfaces_beside_them() -> None:
    grass, asphalt = (45, 100, 80), (90, 90, 90)
    image = roads.draw_surfaces(VIEW, [LEFT, RIGHT], [grass, asphalt, grass])
    output = output_for(VIEW, road_edge=(0.9, 0.8))
    output[:6] += 0.012
    found = DETECTOR.detect(image, FrameContext(HORIZON), FakeRegressor(output)).boundaries
    assert [each.appearance.kind for each in found] == ["road_edge", "road_edge"]
    assert [each.appearance.road_edge for each in found] == pytest.approx([0.9, 0.8])
    rows = np.array([260.0, 200.0])
    for detection, curve in zip(found, (LEFT, RIGHT), strict=True):
        np.testing.assert_allclose(detection.curve.x(rows), curve.x(rows), atol=2.5)


# --- The prior ------------------------------------------------------------------------------------------------------


def prior_of(output: Outputs) -> EgoPrior:
    return REGRESSOR.prior(*REGRESSOR.predict(ROAD, HORIZON, FakeRegressor(output)))


def test_a_boundary_that_is_absent_is_not_in_the_prior() -> None:
    prior = prior_of(output_for(VIEW, presence=(0.9, 0.1)))
    assert prior.sides == (-1,)
    assert len(prior.curves) == len(prior.sigma) == len(prior.presence) == 1
    assert prior.curves[0].coefficients == pytest.approx(LEFT.coefficients, rel=1e-3)
    assert prior_of(output_for(VIEW, presence=(0.1, 0.2))).sides == ()


def test_the_prior_has_the_kinds_of_its_boundaries() -> None:
    assert prior_of(output_for(VIEW, road_edge=(0.1, 0.9))).road_edge == pytest.approx([0.1, 0.9])
    assert prior_of(output_for(VIEW, presence=(0.1, 0.9), road_edge=(0.1, 0.9))).road_edge == pytest.approx([0.9])


def test_a_boundary_that_is_too_uncertain_is_not_in_the_prior() -> None:
    output = output_for(VIEW)
    output[6:9] = 0.2
    assert prior_of(output).sides == (1,)


# --- The regressor guides the search for candidates -----------------------------------------------------------------

CANDIDATES = CandidateDetector(0.5, PatchGeometry(), REGRESSOR)
ROWS = np.array([180.0, 220.0, 260.0])

Distance = Callable[[Curve], float]


def nearest(output: Outputs, tracked: Curves | None = None) -> tuple[Curves, Distance]:
    """Returns the candidates, and a function that returns the greatest distance of the nearest one from a curve."""
    context = FrameContext(HORIZON, tracked)
    curves = CANDIDATES.propose(ROAD, context, FakeRegressor(output)).curves

    def distance(curve: Curve) -> float:
        return float(np.abs(curves.x(ROWS) - curve.x(ROWS)).max(axis=1).min())

    return curves, distance


def test_the_boundaries_of_the_prior_and_their_fits_to_the_paint_are_candidates() -> None:
    output = off_the_paint(0.03)
    output[:6] += 0.008
    seen = RegressorOutput.of(output).curves(VIEW)
    _, distance = nearest(output)
    for curve, painted in zip(seen, (LEFT, RIGHT), strict=True):
        assert distance(curve) < 1.0
        assert distance(painted) < 2.5


def test_a_boundary_that_is_tracked_has_no_candidate_of_its_paint() -> None:
    beside = Curve(HORIZON, (LEFT.coefficients[0], LEFT.coefficients[1] + 0.03, LEFT.coefficients[2]))
    curves, _ = nearest(output_for(VIEW), Curves.of([beside]))
    near = np.abs(curves.x(ROWS) - LEFT.x(ROWS)).max(axis=1) < 0.05 * 110.0
    assert near.sum() == 1


def test_the_horizon_that_the_prior_saw_is_kept_for_the_next_frame() -> None:
    infer = FakeRegressor(output_for(VIEW, horizon=0.05))
    patches: list[int] = []

    def with_classifier(role: ModelRole, inputs: NDArray[np.uint8]) -> Outputs:
        if role == "regressor":
            return infer(role, inputs)
        patches.append(len(inputs))
        return np.tile(np.array([[0.1, 0.9]], np.float32), (len(inputs), 1))

    first = CANDIDATES.detect(ROAD, FrameContext(HORIZON), with_classifier)
    assert first.prior_horizon == pytest.approx(HORIZON + 0.05 * VIEW.depth)
    CANDIDATES.detect(ROAD, FrameContext(HORIZON + 90.0, prior_horizon=HORIZON), with_classifier)
    np.testing.assert_array_equal(infer.inputs[0], infer.inputs[1], "the prior's horizon is preferred")
    assert min(patches) >= 2
