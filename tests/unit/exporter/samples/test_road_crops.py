"""The regressor's training samples: warped road crops with their targets, and the files of road frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.road.crops import RoadCropGeometry
from lanestream.road.curve import Curve
from lanestream.road.view import Image, RoadView, Scaling
from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame, LabeledLane
from lanestream_exporter.samples.road_crops import SHARES, Warp, plain_warp, warped_road_crop
from lanestream_exporter.samples.road_frames import RoadFrame, read_frames, write_frames

WIDTH, HEIGHT, HORIZON = 640, 360, 150.0
MIDDLE = (WIDTH - 1) / 2.0
LEFT, RIGHT = Curve(HORIZON, (MIDDLE + 8.0, -1.1, 300.0)), Curve(HORIZON, (MIDDLE + 8.0, 1.3, 300.0))


def points(curve: Curve) -> NDArray[np.float64]:
    rows = np.linspace(HEIGHT - 1.0, HORIZON + 12.0, 120)
    columns = curve.x(rows)
    return np.stack([columns, rows], axis=1)[(columns >= 0) & (columns <= WIDTH - 1)]


def road() -> Image:
    """Returns a gray road with both boundaries in white."""
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    for curve in (LEFT, RIGHT):
        line = points(curve).round().astype(np.int32)
        cv2.polylines(image, [line], isClosed=False, color=(255, 255, 255), thickness=3)
    return image


@pytest.fixture(scope="module")
def frame() -> RoadFrame:
    lanes = tuple(LabeledLane(points(curve)) for curve in (LEFT, RIGHT))
    made = RoadFrame.of(LabeledFrame(WIDTH, HEIGHT, lanes, "drive", "drawn", WHOLE), road())
    assert made is not None
    return made


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
def test_a_warped_frame_has_its_paint_where_the_target_says(frame: RoadFrame, warp: Warp) -> None:
    geometry = RoadCropGeometry()
    crop, target = warped_road_crop(frame, geometry, warp)
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
            bright = (crop[row, at - 8 : at + 9, 0].astype(float) - 90.0).clip(0)
            assert bright.max() > 60.0
            assert abs(float((bright * np.arange(-8, 9)).sum() / bright.sum())) < 2.5
            checked += 1
    assert checked >= 6
    assert target.presence.tolist() == [1.0, 1.0]
    assert target.horizon == pytest.approx((view.horizon - seen.horizon) / seen.depth)


def road_frame(*types: str | None, exhaustive: bool = True) -> RoadFrame:
    """Returns a frame with the left and the right boundary, of these types."""
    lanes = tuple(LabeledLane(points(curve), type=each) for curve, each in zip((LEFT, RIGHT), types, strict=False))
    made = RoadFrame.of(LabeledFrame(WIDTH, HEIGHT, lanes, "drive", "drawn", WHOLE, "roads", HORIZON), road())
    assert made is not None
    return replace(made, exhaustive=exhaustive)


@pytest.mark.parametrize(
    ("types", "road_edge"),
    [
        (("kerb", "dashed"), [1.0, 0.0]),
        (("solid", "edge"), [0.0, 1.0]),
        ((None, "edge"), [-1.0, 1.0]),
        (("edge",), [1.0, -1.0]),
    ],
)
def test_the_target_has_the_kinds_of_the_boundaries(types: tuple[str | None, ...], road_edge: list[float]) -> None:
    frame, geometry = road_frame(*types), RoadCropGeometry(64)
    _, target = warped_road_crop(frame, geometry, Warp())
    _, flipped = warped_road_crop(frame, geometry, Warp(flipped=True))
    assert target.road_edge.tolist() == road_edge
    assert flipped.road_edge.tolist() == road_edge[::-1]
    assert target.presence.tolist() == [1.0, float(len(types) == 2)]
    _, partly = warped_road_crop(replace(frame, exhaustive=False), geometry, Warp())
    assert partly.road_edge.tolist() == road_edge


def test_the_labeled_horizon_is_the_frames_even_without_lanes() -> None:
    empty = RoadFrame.of(
        LabeledFrame(1280, 720, (), "drive", "drawn", WHOLE, "roads", -90.0), np.zeros((720, 1280, 3), np.uint8)
    )
    assert empty is not None
    assert empty.horizon == pytest.approx(Scaling(448.0 / 1280.0).to_working(-90.0))
    assert empty.kinds == ()
    _, target = warped_road_crop(empty, RoadCropGeometry(64), Warp())
    assert target.presence.tolist() == [0.0, 0.0]
    assert target.road_edge.tolist() == [-1.0, -1.0]


def test_the_errors_of_an_assumed_horizon_are_those_that_are_trained_on(frame: RoadFrame) -> None:
    """The rows that are tried for a new camera are so close that the nearest is within the errors of training."""
    trained = max(abs(Warp.random(np.random.default_rng(seed)).assumed) for seed in range(400))
    assert trained <= 0.25
    shares = np.linspace(-0.5, 0.65, 47).tolist()
    errors = [plain_warp(replace(frame, horizon=share * frame.height), known=False).assumed for share in shares]
    assert np.abs(errors).max() < trained


def test_a_plain_warp_takes_the_nearest_look_if_the_horizon_is_unknown(frame: RoadFrame) -> None:
    assert plain_warp(frame, known=True) == Warp()
    depth = frame.height - 1.0 - frame.horizon
    assert frame.horizon + plain_warp(frame, known=False).assumed * depth == pytest.approx(0.39 * frame.height)


def test_frames_keep_their_kinds_and_their_data_set(tmp_path: Path) -> None:
    frame = road_frame("kerb", None)
    write_frames(tmp_path / "frames.npz", [frame])
    (read,) = read_frames(tmp_path / "frames.npz")
    assert read.kinds == frame.kinds == ("road_edge", None)
    assert (read.dataset, read.exhaustive) == ("roads", True)


def test_frames_are_read_from_their_file_as_they_were_written(frame: RoadFrame, tmp_path: Path) -> None:
    path = tmp_path / "frames.npz"
    assert write_frames(path, [frame, frame]) == 2
    read = read_frames(path)[1]
    np.testing.assert_allclose(read.lanes[0], frame.lanes[0], atol=1e-3)
    assert (read.jpeg, read.horizon, read.group) == (frame.jpeg, frame.horizon, "drive")
