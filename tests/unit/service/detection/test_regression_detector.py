"""The second detector: its canvas, what it reads from the network's answer, its training samples and its loss."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lanestream.detection import Pipeline, answered
from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.detection.regression_detector import (
    ANCHORS,
    HORIZONS,
    OUTPUTS,
    RegressionDetector,
    RegressorOutput,
    RoadCropGeometry,
)
from lanestream.road.curve import Curve
from lanestream.road.view import Image, RoadView
from lanestream_exporter.alexnet import Shape
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import WHOLE, LabelledFrame, LabelledLane
from lanestream_exporter.regressor import LaneRegressor, RegressorPrediction, at_shares, lateral_loss, logs_at_shares
from lanestream_exporter.samples.road_crops import SHARES, Warp, plain_warp, warped_road_crop
from lanestream_exporter.samples.road_frames import RoadFrame, read_frames, write_frames

WIDTH, HEIGHT, HORIZON = 640, 360, 150.0
VIEW = RoadView(WIDTH, HEIGHT, HORIZON)
MIDDLE = (WIDTH - 1) / 2.0
LEFT, RIGHT = Curve(HORIZON, (MIDDLE + 8.0, -1.1, 300.0)), Curve(HORIZON, (MIDDLE + 8.0, 1.3, 300.0))


def road() -> Image:
    """A grey road with both boundaries in white."""
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for curve in (LEFT, RIGHT):
        cv2.polylines(
            image, [points(curve).round().astype(np.int32)], isClosed=False, color=(255, 255, 255), thickness=3
        )
    return image


def points(curve: Curve) -> NDArray[np.float64]:
    rows = np.linspace(HEIGHT - 1.0, HORIZON + 12.0, 120)
    inside = np.stack([curve.x(rows), rows], axis=1)
    return inside[(inside[:, 0] >= 0) & (inside[:, 0] <= WIDTH - 1)]


@pytest.fixture(scope="module")
def frame() -> RoadFrame:
    lanes = tuple(LabelledLane(points(curve)) for curve in (LEFT, RIGHT))
    made = RoadFrame.of(LabelledFrame(WIDTH, HEIGHT, lanes, "drive", "drawn", WHOLE), road())
    assert made is not None
    return made


class Told:
    """A network that gives the answers it was told, one a call."""

    name, provider, reason, buckets = "told", "cpu", "a test", (16,)
    metadata: dict[str, object] = {}  # noqa: RUF012

    def __init__(self, *answers: NDArray[np.float32]) -> None:
        self.answers = list(answers)
        self.seen: list[NDArray[np.uint8]] = []

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.seen.append(inputs)
        return both(self.answers.pop(0)[None])


class SecondIsBest(Told):
    """A network that is surer of the second of all canvases than of the others, and sees the horizon a bit lower."""

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.seen.append(inputs)
        outputs = np.tile(answer(0.02), (len(inputs) // 2, 1))
        outputs[1:2, 6:12] = 0.005
        return both(outputs)


def both(outputs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Answers (N, 15) to straight canvases, and the same answers (2 N, 15) to them and to their mirrored copies."""
    mirrored = outputs.copy()
    mirrored[:, :3], mirrored[:, 3:6] = -outputs[:, 3:6], -outputs[:, :3]
    mirrored[:, 6:9], mirrored[:, 9:12] = outputs[:, 9:12], outputs[:, 6:9]
    mirrored[:, 12:14] = outputs[:, [13, 12]]
    return np.concatenate([outputs, mirrored])


def answer(horizon: float = 0.0, presence: tuple[float, float] = (0.9, 0.9)) -> NDArray[np.float32]:
    """What a network should say of the road, seen in a view whose horizon is `horizon` depths too high."""
    rows = HORIZON + np.array(ANCHORS) * VIEW.depth
    columns = [(curve.x(rows) - MIDDLE) / WIDTH for curve in (LEFT, RIGHT)]
    return np.concatenate([*columns, np.full(6, 0.01), presence, [horizon]]).astype(np.float32)


def test_the_answer_is_read_as_the_curves_it_was_made_of() -> None:
    reading = RegressorOutput.of(answer())
    for side, curve in enumerate((LEFT, RIGHT)):
        np.testing.assert_allclose(reading.curve(side, VIEW).coefficients, curve.coefficients, rtol=1e-3)


def test_boundaries_are_told_from_the_threshold_on_with_the_horizon_that_was_seen() -> None:
    detector = RegressionDetector(threshold=0.5)
    prepared = detector.prepare(road(), HORIZON)
    assert prepared.inputs.shape == (2, 224, 224, 3)
    np.testing.assert_array_equal(prepared.inputs[1], prepared.inputs[0, :, ::-1])
    outputs = both(answer(0.1, (0.4, 0.9))[None])
    assert [d.probability for d in detector.finish(prepared, outputs).detections] == [pytest.approx(0.9)]
    assert detector.read(prepared, outputs)[1].horizon == pytest.approx(HORIZON + 0.1 * VIEW.depth)


def test_the_canvas_keeps_the_horizon_in_its_place_and_the_middle_in_the_middle() -> None:
    geometry = RoadCropGeometry(size=113, above=0.12)
    columns, rows = geometry.grid(VIEW)
    np.testing.assert_allclose(rows[12], HORIZON, atol=1e-6)
    np.testing.assert_allclose(rows[-1], HEIGHT - 1.0)
    np.testing.assert_allclose(columns[:, 56], MIDDLE)
    np.testing.assert_allclose(columns[-1, [0, -1]], [MIDDLE - WIDTH / 2, MIDDLE + WIDTH / 2])
    assert columns[0, -1] - columns[0, 0] == pytest.approx(0.6 * WIDTH)


def test_a_horizon_far_off_is_looked_at_again() -> None:
    network = Told(answer(0.2), answer())
    prior = answered(EgoPriorEstimator(RegressionDetector(), network).look(road(), HORIZON - 0.2 * VIEW.depth))
    assert len(network.seen) == 2
    assert not np.array_equal(network.seen[0], network.seen[1])
    assert prior.left is not None
    assert prior.right is not None


def test_a_frame_whose_horizon_is_not_known_is_looked_at_once_more_where_it_was_seen() -> None:
    detector, network = RegressionDetector(), Told(answer())
    pipeline = Pipeline("regression", detector, network, first_look=EgoPriorEstimator(detector, network))
    assert len(answered(pipeline.prepare(road(), HORIZON)).inputs) == 2
    assert not network.seen, "of a stream's frame one look is enough"
    network = SecondIsBest()
    pipeline = Pipeline("regression", detector, network, first_look=EgoPriorEstimator(detector, network))
    prepared = answered(pipeline.prepare(road()))
    assert [len(inputs) for inputs in network.seen] == [2 * len(HORIZONS)]
    assert [look.horizon for look in prepared.looks] == [
        pytest.approx(HORIZONS[1] * HEIGHT + 0.02 * VIEW.depth, abs=1.0)
    ]


def test_paint_tells_a_horizon_that_was_seen_too_low() -> None:
    low = RoadView(WIDTH, HEIGHT, HORIZON + 8.0)
    rows = low.horizon + np.array(ANCHORS) * low.depth
    columns = [(curve.x(rows) - MIDDLE) / WIDTH for curve in (LEFT, RIGHT)]
    said = np.concatenate([*columns, np.full(6, 0.01), (0.9, 0.9), (0.0,)]).astype(np.float32)
    detector = RegressionDetector()
    found = detector.finish(detector.prepare(road(), low.horizon), both(said[None]))
    assert abs(found.view.horizon - HORIZON) < 4.0
    for detection, curve in zip(found.detections, (LEFT, RIGHT), strict=True):
        assert abs(float(detection.curve.x(HORIZON + 16.0) - curve.x(HORIZON + 16.0))) < 3.0


def test_what_is_not_there_is_no_prior() -> None:
    prior = answered(EgoPriorEstimator(RegressionDetector(), Told(answer(presence=(0.9, 0.1)))).look(road(), HORIZON))
    assert prior.right is None
    assert len(prior.curves) == 1


def test_a_glance_tells_its_boundaries_on_the_paint_too() -> None:
    said = answer()
    said[:6] += 0.012
    said[6:12] = 0.03
    prior = answered(EgoPriorEstimator(RegressionDetector(), Told(said)).look(road(), HORIZON))
    rows = HORIZON + np.array(ANCHORS) * VIEW.depth
    for seen, painted, curve in zip(prior.curves, prior.painted, (LEFT, RIGHT), strict=True):
        assert np.abs(seen.x(rows) - curve.x(rows)).min() > 7.0
        assert np.abs(painted.x(rows) - curve.x(rows)).max() < 2.0


def test_no_paint_is_looked_for_beneath_a_boundary_that_is_followed() -> None:
    glance = EgoPriorEstimator(RegressionDetector(), Told(answer(), answer()))
    followed = Curve(HORIZON, (LEFT.coefficients[0], LEFT.coefficients[1] + 0.03, LEFT.coefficients[2]))
    prior = answered(glance.look(road(), HORIZON, (followed,)))
    assert prior.left is not None
    assert prior.right is not None
    assert (prior.left.painted is None, prior.right.painted is None) == (True, False)
    aside = Curve(HORIZON, (LEFT.coefficients[0], LEFT.coefficients[1] + 0.3, LEFT.coefficients[2]))
    assert len(answered(glance.look(road(), HORIZON, (aside,))).painted) == 2


def test_labels_tell_the_horizon_they_share() -> None:
    assert shared_horizon([points(LEFT), points(RIGHT)], HEIGHT, None) == pytest.approx(HORIZON, abs=1.0)
    assert shared_horizon([points(LEFT)], HEIGHT, None) is None
    assert shared_horizon([], HEIGHT, 140.0) == 140.0


def test_a_road_unlike_the_model_keeps_the_horizon_of_its_drive() -> None:
    lanes = [points(LEFT), points(RIGHT)]
    # What the model describes, it is believed, even where the drive says otherwise.
    assert shared_horizon(lanes, HEIGHT, HORIZON + 8.0) == pytest.approx(HORIZON, abs=1.0)
    # A sharp bend that begins far ahead, its inner boundary more bent than its outer one.
    for lane, bend in zip(lanes, (2e4, 6e4), strict=True):
        lane[:, 0] += bend / (lane[:, 1] - HORIZON + 10.0) ** 2
    alone = shared_horizon(lanes, HEIGHT, None)
    told = shared_horizon(lanes, HEIGHT, HORIZON)
    assert alone is not None
    assert abs(alone - HORIZON) > 8.0
    assert told == pytest.approx(HORIZON, abs=4.0)


@pytest.mark.parametrize(
    "warp",
    [
        Warp(),
        Warp(pan=0.05),
        Warp(side=0.2),
        Warp(zoom=1.15),
        Warp(curvature=0.01),
        Warp(assumed=0.1),
        Warp(flipped=True),
        Warp(pan=-0.04, side=-0.15, zoom=0.9, curvature=-0.01, assumed=-0.05, flipped=True),
    ],
)
def test_a_moved_frame_shows_its_paint_where_the_target_says(frame: RoadFrame, warp: Warp) -> None:
    geometry = RoadCropGeometry()
    canvas, target = warped_road_crop(frame, geometry, warp)
    view = RoadView(frame.width, frame.height, frame.horizon)
    seen = RoadView(frame.width, frame.height, frame.horizon + warp.assumed * view.depth)
    grid_columns, grid_rows = geometry.grid(seen)
    checked = 0
    for side in (0, 1):
        for share, x, known in zip(SHARES, target.columns[side], target.known[side], strict=True):
            row = int(np.argmin(np.abs(grid_rows[:, 0] - (view.horizon + share * view.depth))))
            column = (frame.width - 1) / 2.0 + x * frame.width
            if known < 1.0 or share < 0.2 or not grid_columns[row, 8] < column < grid_columns[row, -9]:
                continue
            at = int(np.argmin(np.abs(grid_columns[row] - column)))
            bright = canvas[row, at - 8 : at + 9, 0].astype(float) - 90.0
            assert bright.max() > 60.0
            assert abs(float((bright.clip(0) * np.arange(-8, 9)).sum() / bright.clip(0).sum())) < 2.5
            checked += 1
    assert checked >= 6
    assert target.presence.tolist() == [1.0, 1.0]
    assert target.horizon == pytest.approx((view.horizon - seen.horizon) / seen.depth)


def test_a_plain_warp_takes_an_unknown_horizon_for_the_nearest_look(frame: RoadFrame) -> None:
    assert plain_warp(frame, known=True) == Warp()
    depth = frame.height - 1.0 - frame.horizon
    assert frame.horizon + plain_warp(frame, known=False).assumed * depth == pytest.approx(0.39 * frame.height)


def test_without_a_horizon_the_look_counts_that_the_network_is_surest_of() -> None:
    detector = RegressionDetector()
    prepared = detector.prepare(road())
    assert prepared.inputs.shape == (10, 224, 224, 3)
    offsets = [(HORIZON - view.horizon) / view.depth for view in prepared.looks]
    outputs = both(np.stack([answer(offset) for offset in offsets]))
    assert detector.finish(prepared, outputs).view.horizon == pytest.approx(HORIZON, abs=1.0)
    assert abs(detector.read(prepared, outputs)[0].horizon) == pytest.approx(min(abs(o) for o in offsets))
    outputs[:, 6:12] *= 5.0
    outputs[[4, 9], 6:12] /= 5.0
    assert detector.read(prepared, outputs)[0].horizon == pytest.approx(offsets[4])


def test_frames_survive_their_file(frame: RoadFrame, tmp_path: Path) -> None:
    path = tmp_path / "frames.npz"
    assert write_frames(path, [frame, frame]) == 2
    again = read_frames(path)[1]
    np.testing.assert_allclose(again.lanes[0], frame.lanes[0], atol=1e-3)
    assert (again.jpeg, again.horizon, again.group) == (frame.jpeg, frame.horizon, "drive")


def test_the_loss_is_least_at_the_truth() -> None:
    generator = torch.Generator().manual_seed(0)
    columns = torch.rand((4, 2, 3), generator=generator) - 0.5
    truth = {
        "columns": columns @ at_shares().T,
        "known": torch.ones(4, 2, len(SHARES)),
        "presence": torch.ones(4, 2),
        "horizon": torch.zeros(4),
    }
    sure, certain = torch.full((4, 2, 3), -5.0), torch.full((4, 2), 8.0)
    best = lateral_loss(RegressorPrediction(columns, sure, certain, torch.zeros(4)), truth)
    for worse in (
        RegressorPrediction(columns + 0.02, sure, certain, torch.zeros(4)),
        RegressorPrediction(columns, sure + 2.0, certain, torch.zeros(4)),
        RegressorPrediction(columns, sure, -certain, torch.zeros(4)),
        RegressorPrediction(columns, sure, certain, torch.full((4,), 0.1)),
    ):
        assert lateral_loss(worse, truth) > best + 0.05


def test_deviations_are_interpolated_between_the_anchors() -> None:
    weights = logs_at_shares()
    np.testing.assert_allclose(weights.sum(dim=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(weights[0], [1.0, 0.0, 0.0], atol=1e-6)


def test_folding_leaves_the_same_function() -> None:
    torch.manual_seed(0)
    network = LaneRegressor(Shape(112, 0.5, 64))
    for norm in (
        module for module in network.modules() if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d)
    ):
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        torch.nn.init.uniform_(norm.running_var, 0.5, 1.5)  # type: ignore[arg-type]
        torch.nn.init.normal_(norm.running_mean)  # type: ignore[arg-type]
    network.eval()
    canvases = torch.randn(2, 3, 112, 112)
    with torch.inference_mode():
        plain = network.folded()
        assert not [
            module for module in plain.modules() if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d)
        ]
        np.testing.assert_allclose(plain(canvases), network(canvases), rtol=1e-3, atol=1e-3)
        assert RegressorPrediction.of(plain(canvases)).served().shape == (2, OUTPUTS)


def test_boundaries_are_moved_onto_the_paint_beneath_them() -> None:
    off = answer()
    off[:6] += 0.012
    detector = RegressionDetector()
    found = detector.finish(detector.prepare(road(), HORIZON), both(off[None]))
    rows = np.array([340.0, 260.0, 200.0])
    for detection, curve in zip(found.detections, (LEFT, RIGHT), strict=True):
        inside = rows[np.abs(curve.x(rows) - MIDDLE) < MIDDLE - 4.0]
        np.testing.assert_allclose(detection.curve.x(inside), curve.x(inside), atol=2.5)
        assert (np.linalg.eigvalsh(detection.covariance) > 0.0).all()


def test_what_the_network_is_sure_of_is_moved_by_less() -> None:
    detector, row = RegressionDetector(), 300.0

    def off(deviation: float) -> float:
        told = answer()
        told[:6] += 0.012
        told[6:12] = deviation
        found = detector.finish(detector.prepare(road(), HORIZON), both(told[None]))
        return max(abs(float(d.curve.x(row) - c.x(row))) for d, c in zip(found.detections, (LEFT, RIGHT), strict=True))

    assert off(0.02) < 1.5 < off(0.001) < 0.013 * WIDTH
