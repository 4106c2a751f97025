"""`lanestream calibrate`, with pictures of a chessboard that a known lens took and a drive past known boundaries."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import fakes
import numpy as np
import pytest
from click.testing import CliRunner, Result

from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.errors import SourceError
from lanestream.protocol import CameraModel, read_camera_file
from lanestream.road.camera import Camera, Distortion, Lens
from lanestream.road.curve import Curve
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_rows
from lanestream_exporter import calibration_commands
from lanestream_exporter.camera_calibration import Picture, calibrate_lens, calibrate_mount, read_pictures, views

SIZE: Final = (640, 400)
DISTORTION: Final[Distortion] = (-0.25, 0.06, 0.0, 0.0, 0.0)
LENS: Final = Lens(560.0, 556.0, 332.0, 193.0, DISTORTION)
MATRIX: Final = np.array([[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]])
DRIVE: Final = CameraModel(height=1.4, field_of_view=62.0)


def chessboard(rotation: tuple[float, float, float], place: tuple[float, float, float]) -> Image:
    """Returns a picture of a board of 10 x 7 squares, that is 9 x 6 inner corners, drawn at four times its size."""
    image = np.full((4 * SIZE[1], 4 * SIZE[0]), 225, np.uint8)
    edge = np.linspace(0.0, 1.0, 9)[:-1]
    zero, one = np.zeros(8), np.ones(8)
    outline = np.stack([[*edge, *one, *edge[::-1] + 0.125, *zero], [*zero, *edge, *one, *edge[::-1] + 0.125]], axis=1)
    for column in range(10):
        for row in range(7):
            if (column + row) % 2 == 0:
                corners = np.zeros((len(outline), 3))
                corners[:, :2] = np.array([column - 5.0, row - 3.5]) + outline
                pose = np.array(rotation), np.array(place)
                pixels, _ = cv2.projectPoints(corners, *pose, MATRIX, np.array(DISTORTION))
                cv2.fillPoly(image, [np.round(4.0 * pixels + 1.5).astype(np.int32)], 30.0)
    return np.asarray(cv2.cvtColor(cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR), np.uint8)


@pytest.fixture(scope="module")
def boards() -> list[Image]:
    """Twelve pictures from different sides, with the board in all corners."""
    rng = np.random.default_rng(5)
    places = [(x, y, 15.0) for x in (-2.0, 0.0, 2.0) for y in (-1.2, 1.2)] * 2
    return [chessboard(tuple(rng.uniform(-0.4, 0.4, 3)), place) for place in places]


def pictures(images: list[Image]) -> list[Picture]:
    return [Picture(f"{n}.png", n / 25.0, image) for n, image in enumerate(images)]


def test_a_lens_is_recovered_from_pictures_of_a_chessboard(boards: list[Image]) -> None:
    white = np.full_like(boards[0], 255)
    small = np.ascontiguousarray(boards[0][:380])
    unreadable = Picture("c.png", 0.0, None, "cut short")
    lens = calibrate_lens([*pictures([*boards, white, small]), unreadable], (9, 6))
    assert lens.size == SIZE
    assert lens.focal_length == pytest.approx((LENS.fx, LENS.fy), abs=4.0)
    assert lens.principal_point == pytest.approx((LENS.cx, LENS.cy), abs=4.0)
    assert lens.rms < 0.3
    assert len(lens.used) == 12
    assert lens.failed == (
        ("12.png", "no whole chessboard"),
        ("c.png", "cut short"),
        ("13.png", "640 x 380, not 640 x 400"),
    )
    camera = Camera(**lens.camera(1.3).model_dump())
    found = camera.lens(SIZE, SIZE)
    pixels = np.array([[40.0, 40.0], [600.0, 360.0], [320.0, 350.0]])
    assert found.rays(pixels) == pytest.approx(LENS.rays(pixels), abs=6e-3), "what counts is where the pixels look"


def test_unusable_pictures_are_an_error_of_one_line(boards: list[Image]) -> None:
    with pytest.raises(SourceError, match="no chessboard of 9x6 inner corners was found in 3 pictures"):
        calibrate_lens(pictures([np.full_like(boards[0], 255)] * 3), (9, 6))
    with pytest.raises(SourceError, match="was found in 5 pictures of the same size; 6 are needed"):
        calibrate_lens(pictures(boards[:5]), (9, 6))


@dataclass(frozen=True)
class YawedDetector(fakes.FakeDetector):
    """Sees a straight lane around a vanishing point that is not in the middle; `visible` says in which frames."""

    column: float
    visible: Iterator[bool]

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        height, width = image.shape[:2]
        view = RoadView(width, height, 140.0)
        curves = [Curve(view.horizon, (self.column, slope, 0.0)) for slope in (-1.2, 1.2)] if next(self.visible) else []
        spans = [(curve, visible_rows(curve, view)) for curve in curves]
        found = [Detection(curve, np.diag([1.0, 1e-4, 50.0]), *rows, 0.9) for curve, rows in spans if rows is not None]
        return Detections(tuple(found), view, horizon_weight=1.0)


def drive(frames: int) -> Iterator[Picture]:
    image = fakes.picture(640, 360)
    return (Picture(f"frame {n}", n / 25.0, image) for n in range(frames))


def test_pitch_and_yaw_are_recovered_from_a_drive() -> None:
    lens = Camera(1.4, 62.0).lens((640, 360), (640, 360))
    column = lens.cx + lens.fx * np.tan(np.radians(1.5))
    engine = fakes.engine(detector=YawedDetector(float(column), iter(lambda: True, False)))
    mount = calibrate_mount(drive(500), DRIVE.model_copy(update={"pitch": 9.0, "yaw": 9.0}), engine)
    assert mount.yaw == pytest.approx(1.5, abs=0.1), "what is ahead is to the right in a camera that looks left"
    assert mount.pitch == pytest.approx(np.degrees(np.arctan((lens.cy - 140.0) / lens.fy)), abs=0.1)
    assert 400 < mount.used <= mount.frames == 500


def test_a_drive_that_says_too_little_is_an_error_of_one_line() -> None:
    engine = fakes.engine(detector=YawedDetector(319.5, iter([True] * 100 + [False] * 400)))
    with pytest.raises(SourceError, match=r"\d+ of 500 frames show a straight road; 401 are needed"):
        calibrate_mount(drive(500), DRIVE, engine)
    unreadable = replace(next(drive(1)), image=None, problem="cut short")
    with pytest.raises(SourceError, match="frame 0: cut short"):
        calibrate_mount([unreadable], DRIVE, engine)


def calibrate(*arguments: object) -> Result:
    return CliRunner().invoke(calibration_commands.calibrate, [str(part) for part in arguments])


def test_the_command_writes_a_camera_file(tmp_path: Path, boards: list[Image]) -> None:
    (tmp_path / "boards").mkdir()
    for number, image in enumerate(boards):
        cv2.imwrite(str(tmp_path / "boards" / f"{number}.png"), image)
    (tmp_path / "boards" / "broken.png").write_bytes(b"\x89PNG")
    out = tmp_path / "new" / "camera.json"
    result = calibrate(tmp_path / "boards", "-o", out, "--height", 1.3)
    assert result.exit_code == 0, result.output
    assert "broken.png was not used: " in result.output
    assert "12 of 13 pictures used" in result.output
    assert "reprojection error 0." in result.output
    camera = read_camera_file(out)
    assert (camera.height, camera.image_size) == (1.3, SIZE)
    assert camera.focal_length == pytest.approx((LENS.fx, LENS.fy), abs=4.0)


def test_the_command_adds_the_direction_to_a_camera_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    engine = fakes.engine(detector=YawedDetector(319.5, iter(lambda: True, False)))
    monkeypatch.setattr("lanestream.engine.load_engine", lambda provider: engine)
    monkeypatch.setattr("lanestream_exporter.camera_calibration.read_pictures", lambda _: drive(450))
    start, out = tmp_path / "lens.json", tmp_path / "camera.json"
    start.write_text('{"height": 1.2, "field_of_view": 62, "roll": 1}')
    result = calibrate(tmp_path, "-o", out, "--camera", start, "--height", 1.5)
    assert result.exit_code == 0, result.output
    camera = read_camera_file(out)
    assert (camera.height, camera.field_of_view, camera.roll) == (1.5, 62.0, 1.0)
    assert isinstance(camera.pitch, float)
    assert isinstance(camera.yaw, float)
    assert f"yaw {camera.yaw:.2f} ± " in result.output


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["."], "the height of the camera above the road is missing: give --height"),
        ([".", "--camera", "c.json", "--field-of-view", "60"], "--field-of-view can't be used with --camera"),
        ([".", "--board", "9", "--height", "1.4"], "'9' is not a board; give its inner corners"),
        ([".", "--board", "2x6", "--height", "1.4"], "'2x6' is not supported; give 3x3 to 50x50"),
    ],
)
def test_options_that_contradict_are_refused(options: list[str], message: str) -> None:
    result = calibrate(*options, "-o", "camera.json")
    assert result.exit_code == 2
    assert message in result.output


def test_pictures_of_a_folder_come_in_natural_order_and_those_of_a_video_in_time(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        cv2.imwrite(str(tmp_path / f"{number}.png"), fakes.picture())
    assert [(picture.name, picture.timestamp) for picture in read_pictures(tmp_path)] == [
        ("1.png", 0.0),
        ("9.png", 0.04),
        ("10.png", 0.08),
    ]
    video = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (320, 180))
    for _ in range(125):
        writer.write(fakes.picture())
    writer.release()
    frames = list(read_pictures(video))
    assert [frame.timestamp for frame in frames[:3]] == pytest.approx([0.0, 0.02, 0.04])
    assert len(frames) == 125
    assert len(list(views(video))) == 63, "every second frame is enough to find boards"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("missing", "no such file or folder: "),
        ("empty", "no images in the folder "),
        ("text", "can't be read as a video"),
    ],
)
def test_an_unusable_source_is_an_error_of_one_line(tmp_path: Path, source: str, message: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").write_text("no video")
    for read in (read_pictures, views):
        with pytest.raises(SourceError, match=message):
            list(read(tmp_path / source))
