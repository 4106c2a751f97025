"""Cameras: the lens, the angles and their signs, the horizon of a pitch, and cameras on the wire."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from lanestream.errors import ProtocolError
from lanestream.protocol import (
    CameraModel,
    StartMessage,
    json_schemas,
    parse_camera,
    parse_client_message,
    read_camera_file,
)
from lanestream.road.camera import Camera, Distortion, Lens, camera_from_vehicle

FRAME = (1280, 720)
WIDE: Distortion = (-0.28, 0.09, 0.0006, -0.0008, -0.012)


def seen(camera: Camera, direction: tuple[float, float, float], pitch: float = 0.0, yaw: float = 0.0) -> list[float]:
    """Returns the pixel in which a camera sees a `direction` of the vehicle frame; angles in degrees."""
    lens = camera.lens(FRAME, FRAME)
    x, y, z = camera_from_vehicle(math.radians(pitch), math.radians(yaw), math.radians(camera.roll)) @ direction
    pixel: list[float] = lens.pixels(np.array([x / z, y / z])).tolist()
    return pixel


def test_a_field_of_view_and_a_focal_length_are_the_same_lens() -> None:
    by_angle = Camera(1.4, 90.0).lens(FRAME, FRAME)
    by_length = Camera(1.4, focal_length=(640.0, 640.0)).lens(FRAME, FRAME)
    assert (by_angle.fx, by_angle.fy) == pytest.approx((by_length.fx, by_length.fy))
    assert (by_angle.cx, by_angle.cy) == (639.5, 359.5), "pixel centers are at integers"
    with pytest.raises(ValueError, match="field of view or its focal lengths"):
        Camera(1.4).lens(FRAME, FRAME)


def test_a_lens_is_resized_with_its_frames() -> None:
    camera = Camera(1.4, focal_length=(1000.0, 1010.0), principal_point=(660.0, 350.0), image_size=FRAME)
    whole, half = camera.lens((999, 9), FRAME), camera.lens((999, 9), (640, 360))
    assert whole == Lens(1000.0, 1010.0, 660.0, 350.0), "the pixels are those of the images that were calibrated"
    assert half == Lens(500.0, 505.0, 329.75, 174.75)
    without_size = Camera(1.4, focal_length=(1000.0, 1010.0), principal_point=(660.0, 350.0))
    assert without_size.lens(FRAME, (640, 360)) == half


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0, 0.0), WIDE])
def test_rays_undo_pixels(distortion: Distortion) -> None:
    lens = Lens(1100.0, 1090.0, 650.0, 340.0, distortion)
    rays = np.stack(np.meshgrid(np.linspace(-0.55, 0.55, 9), np.linspace(-0.3, 0.3, 5)), axis=-1)
    assert lens.rays(lens.pixels(rays)) == pytest.approx(rays, abs=1e-6)
    if any(distortion):
        assert lens.pixels(rays)[0, 0, 0] > Lens(1100.0, 1090.0, 650.0, 340.0).pixels(rays)[0, 0, 0], "a barrel"


def test_the_signs_of_the_angles() -> None:
    ahead = (1.0, 0.0, 0.0)
    straight = Camera(1.4, 60.0)
    assert seen(straight, ahead) == pytest.approx([639.5, 359.5])
    assert seen(straight, ahead, pitch=5.0)[1] < 300.0, "the horizon is higher in a camera that looks down"
    assert seen(straight, ahead, yaw=5.0)[0] > 700.0, "what is ahead is to the right in a camera that looks left"
    rolled = Camera(1.4, 60.0, roll=5.0)
    left, right = seen(rolled, (1.0, 0.3, 0.0)), seen(rolled, (1.0, -0.3, 0.0))
    assert left[0] < right[0]
    assert left[1] > right[1], "a level line rises to the right in a camera that is turned clockwise"


@given(
    pitch=st.floats(-10.0, 20.0), yaw=st.floats(-10.0, 10.0), roll=st.floats(-10.0, 10.0), heading=st.floats(-0.1, 0.1)
)
def test_the_pitch_follows_from_any_point_of_the_horizon(pitch: float, yaw: float, roll: float, heading: float) -> None:
    camera = Camera(1.4, focal_length=(1100.0, 1100.0), distortion=WIDE, roll=roll)
    lens = camera.lens(FRAME, FRAME)
    column, row = seen(camera, (math.cos(heading), math.sin(heading), 0.0), pitch, yaw)
    assert math.degrees(camera.pitch_at(lens, column, row)) == pytest.approx(pitch, abs=1e-4)


def test_a_configured_pitch_fixes_the_horizon() -> None:
    camera = Camera(1.4, 60.0, pitch=3.0, yaw=2.0, roll=1.5, distortion=WIDE)
    lens = camera.lens(FRAME, (640, 360))
    row = camera.horizon(lens, 360)
    column = float(lens.pixels(np.array([math.tan(math.radians(2.0)), 0.0]))[0])
    assert math.degrees(camera.pitch_at(lens, column, row)) == pytest.approx(3.0, abs=0.01)
    down = Camera(1.4, 60.0, pitch=26.0)
    row = down.horizon(down.lens(FRAME, (640, 360)), 360)
    assert row == pytest.approx(179.5 - 320.0 / math.tan(math.radians(30.0)) * math.tan(math.radians(26.0)))
    assert row < -0.2 * 360, "above the image"
    assert math.degrees(down.pitch_at(down.lens(FRAME, (640, 360)), 319.5, row)) == pytest.approx(26.0)
    assert Camera(1.4, 60.0, pitch=60.0).horizon(lens, 360) == -360.0, "no detector places a horizon higher"
    assert Camera(1.4, 60.0, pitch=-20.0).horizon(lens, 360) == pytest.approx(0.95 * 360)


@pytest.mark.parametrize(("lateral", "roll"), [(0.0, 0.0), (0.4, 0.0), (0.0, 2.0), (-0.3, -3.0)])
def test_the_middle_is_the_line_under_the_vehicle(lateral: float, roll: float) -> None:
    camera = Camera(1.3, 60.0, roll=roll, lateral=lateral)
    lens = camera.lens(FRAME, (640, 360))
    # Two points of the line, relative to the camera: near, and at infinity.
    near, far = (np.array(seen(camera, (x, -lateral, -1.3))) for x in (3.0, 1e6))
    assert camera.middle(lens) == pytest.approx((near[0] - far[0]) / (near[1] - far[1]), abs=1e-3)
    assert math.copysign(1.0, camera.middle(lens)) == math.copysign(1.0, lateral + roll)


def test_what_is_automatic() -> None:
    assert not Camera(1.4, 60.0, pitch=2.0, yaw=1.0).calibrates
    assert Camera(1.4, 60.0, pitch="auto").calibrates
    assert Camera(1.4, 60.0, yaw="auto").calibrates
    assert (Camera(1.4, 60.0, pitch="auto").fixed_pitch, Camera(1.4, 60.0, yaw="auto").fixed_yaw) == (None, None)
    assert (Camera(1.4, 60.0).fixed_pitch, Camera(1.4, 60.0).fixed_yaw) == (None, 0.0)


def test_a_start_message_has_a_camera() -> None:
    start = parse_client_message(
        '{"type": "start", "camera": {"height": 1.4, "focal_length": [1160, 1156], "principal_point": [676, 389],'
        ' "image_size": [1280, 720], "distortion": [-0.28, 0.1, 0, 0, 0], "pitch": 2, "yaw": "auto", "roll": -1,'
        ' "lateral": 0.2}}'
    )
    assert isinstance(start, StartMessage)
    camera = start.camera
    assert camera is not None
    assert Camera(**camera.model_dump()) == Camera(
        1.4, None, (1160.0, 1156.0), (676.0, 389.0), FRAME, (-0.28, 0.1, 0.0, 0.0, 0.0), 2.0, "auto", -1.0, 0.2
    )


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ('"height": 0.2, "field_of_view": 62', "camera.height: Input should be greater than or equal to 0.3"),
        ('"height": NaN, "field_of_view": 62', "camera.height"),
        ('"height": 1.4, "field_of_view": 151', "camera.field_of_view"),
        ('"height": 1.4', "camera: give either field_of_view or focal_length"),
        ('"height": 1.4, "field_of_view": 62, "focal_length": [99, 99]', "give either field_of_view or focal_length"),
        ('"height": 1.4, "focal_length": [0, 99]', "camera.focal_length.0"),
        ('"height": 1.4, "field_of_view": 62, "pitch": 61', "camera.pitch: Input should be less than or equal to 60"),
        ('"height": 1.4, "field_of_view": 62, "yaw": "left"', "camera.yaw: "),
        ('"height": 1.4, "field_of_view": 62, "roll": NaN', "camera.roll"),
        ('"height": 1.4, "field_of_view": 62, "lateral": 3', "camera.lateral"),
        ('"height": 1.4, "field_of_view": 62, "distortion": [1, 2, 3, 4]', "camera.distortion.4: Field required"),
        ('"height": 1.4, "field_of_view": 62, "distortion": [1, 2, 3, 4, Infinity]', "camera.distortion.4"),
        ('"height": 1.4, "field_of_view": 62, "image_size": [0, 9]', "camera.image_size.0"),
        (
            '"height": 1.4, "field_of_view": 62, "image_size": [1280, 720], "principal_point": [1300, 360]',
            "camera: principal_point is outside of image_size",
        ),
        ('"height": 1.4, "field_of_view": 62, "tilt": 2', "camera.tilt"),
    ],
)
def test_an_invalid_camera_is_an_error_of_one_line(fields: str, problem: str) -> None:
    with pytest.raises(ProtocolError) as caught:
        parse_client_message(f'{{"type": "start", "camera": {{{fields}}}}}')
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_invalid_camera_cannot_be_built() -> None:
    with pytest.raises(ValidationError, match=r"greater than or equal to 0\.3"):
        CameraModel(height=0.0, field_of_view=62.0)


def test_the_parameters_of_a_camera() -> None:
    simple = CameraModel(height=1.4, field_of_view=62.0)
    assert parse_camera(None, None) is None
    assert parse_camera(1.4, 62.0) == parse_camera(None, None, '{"height": 1.4, "field_of_view": 62}') == simple
    with pytest.raises(ProtocolError, match="give both the height"):
        parse_camera(1.4, None)
    with pytest.raises(ProtocolError, match="the camera is given twice"):
        parse_camera(1.4, None, "{}")
    with pytest.raises(ProtocolError, match="not a valid camera: Invalid JSON"):
        parse_camera(None, None, "{")


def test_a_camera_file_is_read_or_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "camera.json"
    file.write_text('{"height": 1.4, "field_of_view": 62}')
    assert read_camera_file(file) == CameraModel(height=1.4, field_of_view=62.0)
    file.write_text('{"height": 9}')
    with pytest.raises(ProtocolError, match=r"camera\.json: not a valid camera: height") as caught:
        read_camera_file(file)
    assert "\n" not in str(caught.value)
    with pytest.raises(ProtocolError, match=r"can't read .*missing\.json: no such file"):
        read_camera_file(tmp_path / "missing.json")


def test_the_schemas_describe_cameras_and_meters() -> None:
    schemas = json_schemas()
    camera = schemas["client"]["$defs"]["CameraModel"]["properties"]
    assert (camera["height"]["minimum"], camera["height"]["maximum"]) == (0.3, 4.0)
    assert camera.keys() >= {"focal_length", "principal_point", "image_size", "distortion", "pitch", "yaw", "roll"}
    assert "camera" in schemas["client"]["$defs"]["StartMessage"]["properties"]
    assert "ground" in schemas["server"]["$defs"]["LaneModel"]["properties"]
    ego = schemas["server"]["$defs"]["EgoModel"]["properties"]
    assert {"offset_m", "lane_width_m", "heading", "curvature"} <= set(ego)
