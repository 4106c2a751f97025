"""The bridge to ROS 2: images and cameras from messages, results to messages, and the packages around it."""

from __future__ import annotations

import ast
import configparser
import math
import re
from array import array
from typing import Any

import fakes
import numpy as np
import pytest
from defusedxml import ElementTree
from lanestream_bridge.bridge import BridgeSettings, BridgeStatus, FrameQueue
from lanestream_bridge.conversion import (
    ConversionError,
    MessageTypes,
    camera_of_info,
    camera_of_parameters,
    frame_of_compressed_image,
    frame_of_image,
    lanes_message,
    markers_message,
)
from rosmessages import EXAMPLE, message

from lanestream.errors import SettingsError
from lanestream.protocol import DepartureModel, EgoModel, LaneModel, LanesMessage, LineModel, MarkingModel
from lanestream_client import SourceFrame

PACKAGE = EXAMPLE / "lanestream_bridge"
TYPES = MessageTypes(*map(message, ("Lanes", "Lane", "Point32", "Point", "Marker", "MarkerArray")))
PIXELS = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)


def header(sec: int = 12, nanosec: int = 500_000_000) -> Any:
    return message("Header")(stamp=message("Time")(sec=sec, nanosec=nanosec), frame_id="front_camera")


def image(pixels: Any, encoding: str, padding: int = 0) -> Any:
    """Returns a message with rows that are `padding` bytes longer than their pixels."""
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)), constant_values=99)
    data = array("B", rows.tobytes())
    return message("Image")(
        header=header(), height=height, width=width, encoding=encoding, step=rows.shape[1], data=data
    )


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("bgr8", PIXELS),
        ("rgb8", PIXELS[:, :, ::-1]),
        ("bgra8", np.dstack([PIXELS, np.full((2, 3), 7, np.uint8)])),
        ("rgba8", np.dstack([PIXELS[:, :, ::-1], np.full((2, 3), 7, np.uint8)])),
    ],
)
def test_images_become_bgr_without_their_padding(encoding: str, pixels: Any, padding: int) -> None:
    frame = frame_of_image(image(pixels, encoding, padding), 7)
    assert (frame.seq, frame.timestamp) == (7, 12.5)
    np.testing.assert_array_equal(frame.pixels, PIXELS)


def test_gray_images_have_three_equal_channels() -> None:
    pixels = frame_of_image(image(PIXELS[:, :, :1], "mono8", 1), 0).pixels
    np.testing.assert_array_equal(pixels, PIXELS[:, :, [0, 0, 0]])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"encoding": "bayer_rggb8"}, "encoding 'bayer_rggb8' is not accepted; use bgr8, rgb8"),
        ({"step": 8}, "18 bytes are not 2 rows of 3 pixels in steps of 8"),
        ({"height": 3}, "18 bytes are not 3 rows"),
        ({"height": 0}, "18 bytes are not 0 rows"),
    ],
)
def test_bad_images_are_refused(changes: dict[str, Any], text: str) -> None:
    bad = image(PIXELS, "bgr8")
    for name, value in changes.items():
        setattr(bad, name, value)
    with pytest.raises(ConversionError, match=re.escape(text)):
        frame_of_image(bad, 0)


def test_compressed_images_are_passed_on() -> None:
    file = fakes.image_file()
    compressed = message("CompressedImage")(
        header=header(0, 0), format="rgb8; jpeg compressed bgr8", data=array("B", file)
    )
    frame = frame_of_compressed_image(compressed, 3)
    assert (frame.data, frame.timestamp) == (file, None)
    compressed.data = array("B", b"\0" * 12 + file)
    with pytest.raises(ConversionError, match="use JPEG, PNG or WebP"):
        frame_of_compressed_image(compressed, 3)


def info(**other: Any) -> Any:
    usual = {
        "width": 1280,
        "height": 720,
        "distortion_model": "plumb_bob",
        "d": [-0.3, 0.1, 0.0, 0.001, 0.0],
        "k": [900.0, 0.0, 640.5, 0.0, 910.0, 355.0, 0.0, 0.0, 1.0],
        "p": [880.0, 0.0, 642.0, 0.0, 0.0, 890.0, 356.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
    return message("CameraInfo")(**{**usual, **other})


def test_a_camera_comes_from_its_info() -> None:
    camera = camera_of_info(info(), 1.4, "2.5", rectified=False)
    assert (camera.height, camera.focal_length, camera.principal_point) == (1.4, (900.0, 910.0), (640.5, 355.0))
    assert (camera.image_size, camera.pitch) == ((1280, 720), 2.5)
    assert camera.distortion == (-0.3, 0.1, 0.0, 0.001, 0.0)
    rectified = camera_of_info(info(distortion_model="equidistant"), 1.4, "auto", rectified=True)
    assert (rectified.focal_length, rectified.pitch) == ((880.0, 890.0), "auto")
    assert not any(rectified.distortion)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"k": [0.0] * 9}, "CameraInfo has no focal length"),
        ({"distortion_model": "equidistant"}, "distortion model 'equidistant' is not accepted; use plumb_bob"),
        ({"binning_x": 2}, "binning and regions of interest"),
        ({"width": 100}, "the geometry of the camera is not accepted"),
    ],
)
def test_other_infos_are_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ConversionError, match=re.escape(text)):
        camera_of_info(info(**changes), 1.4, "auto", rectified=False)


def test_a_camera_comes_from_parameters() -> None:
    camera = camera_of_parameters(1.4, 62.0, "auto")
    assert (camera.height, camera.field_of_view, camera.pitch) == (1.4, 62.0, "auto")
    with pytest.raises(ConversionError, match="height of the camera is not accepted"):
        camera_of_parameters(0.0, 62.0, "auto")
    with pytest.raises(ConversionError, match="camera_pitch is 'down'; give degrees"):
        camera_of_parameters(1.4, 62.0, "down")


def lane(**other: Any) -> LaneModel:
    usual: dict[str, Any] = {
        "track_id": 4,
        "position": -1,
        "state": "detected",
        "probability": 0.98,
        "kind": "marking",
        "marking": MarkingModel(
            type="dashed", type_probability=0.9, color="yellow", color_probability=0.8, probability=0.7
        ),
        "points": [(221.4, 719.0), (255.9, 694.2)],
        "line": LineModel(bottom=(221.4, 719.0), top=(255.9, 694.2)),
        "horizon": 412.5,
        "coefficients": (611.2, -1.31, 1840.0),
        "covariance": [[1.9, -0.01, -110.0], [-0.01, 0.0001, 0.7], [-110.0, 0.7, 9800.0]],
        "age_s": 1.2,
        "ground": (0.001, 0.02, 1.7),
        "ground_covariance": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]],
    }
    return LaneModel(**{**usual, **other})


def result(*lanes: LaneModel) -> LanesMessage:
    ego = EgoModel(left=4, right=None, offset=0.1, offset_m=0.3, heading=0.01, lateral_speed=0.2)
    departure = DepartureModel(state="warning", side="right", time_to_crossing=0.8)
    return fakes.lanes(7).model_copy(update={"lanes": list(lanes), "ego": ego, "departure": departure})


def test_a_result_becomes_a_message_with_the_header_of_its_image() -> None:
    edge = lane(track_id=5, position=2, state="predicted", kind="road_edge", marking=None, ground=None)
    made = lanes_message(result(lane(), edge), kept := header(), "ground", TYPES)
    assert made.header is kept
    assert (made.ground_frame_id, made.width, made.height) == ("ground", 9, 9)
    first, second = made.lanes
    assert (first.track_id, first.position, first.state, first.kind) == (4, -1, first.DETECTED, first.MARKING)
    assert (first.marking_type, first.marking_color) == (first.DASHED, first.YELLOW)
    assert [(point.x, point.y) for point in first.points] == [(221.4, 719.0), (255.9, 694.2)]
    assert first.covariance[2] == -110.0
    assert (first.has_ground, first.ground, first.ground_covariance[3]) == (True, [0.001, 0.02, 1.7], 4.0)
    assert (second.state, second.kind, second.marking_type) == (second.PREDICTED, second.ROAD_EDGE, second.NO_TYPE)
    assert not second.has_ground
    # To the left is positive.
    assert (made.offset, made.heading, made.lateral_speed) == (-0.3, 0.01, -0.2)
    assert math.isnan(made.lane_width)
    assert (made.departure, made.departure_side) == (made.WARNING, made.RIGHT)
    assert made.time_to_crossing == 0.8


def test_a_result_without_a_camera_has_no_meters() -> None:
    made = lanes_message(fakes.lanes(0), header(), "ground", TYPES)
    assert all(math.isnan(value) for value in (made.offset, made.heading, made.lateral_speed, made.time_to_crossing))
    assert (made.departure, made.departure_side, made.lanes) == (made.NO_DEPARTURE, made.NO_SIDE, [])


def test_markers_are_lines_on_the_road() -> None:
    stamp = header().stamp
    array_of = markers_message(result(lane(), lane(track_id=6, ground=None)), stamp, "ground", TYPES)
    clear, line = array_of.markers
    assert clear.action == clear.DELETEALL
    assert (line.id, line.type, line.action, line.header.frame_id) == (4, line.LINE_STRIP, line.ADD, "ground")
    assert line.header.stamp is stamp
    assert (line.points[0].x, line.points[-1].x) == (3.0, 40.0)
    assert line.points[-1].y == pytest.approx(0.001 * 40.0**2 + 0.02 * 40.0 + 1.7)
    assert (line.color.r, line.color.b, line.color.a) == (1.0, 0.0, 1.0)


def test_settings_are_checked_and_the_key_comes_from_the_environment() -> None:
    given = {"url": "http://x", "api_key": "", "mode": "all", "detector": ""}
    settings = BridgeSettings.of(given, {"LANESTREAM_API_KEY": "lane_x"})
    assert (settings.api_key, settings.mode, settings.detector) == ("lane_x", "all", None)
    assert BridgeSettings.of({**given, "api_key": "mine"}, {"LANESTREAM_API_KEY": "lane_x"}).api_key == "mine"
    assert "lane_x" not in repr(settings)
    for name in ("mode", "detector"):
        with pytest.raises(SettingsError, match=f"the parameter {name} is 'both'"):
            BridgeSettings.of({**given, name: "both"}, {})


def test_the_newest_frames_are_kept() -> None:
    queue = FrameQueue(2)
    assert [queue.put(SourceFrame(seq, None)) for seq in range(4)] == [False, False, True, True]
    frames = iter(queue)
    assert [next(frames).seq, next(frames).seq] == [2, 3]
    queue.interrupt()
    assert list(frames) == []
    queue.put(SourceFrame(4, None))
    assert next(iter(queue)).seq == 4
    queue.close()
    assert list(queue) == []


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (BridgeStatus(), ("WARN", "no image yet")),
        (BridgeStatus(received=3, received_at=99.9), ("WARN", "no answer yet")),
        (BridgeStatus(received=3, received_at=90.0, answered_at=90.1), ("WARN", "no image for 10 s")),
        (
            BridgeStatus(received_at=99.9, answered_at=99.5, service_ms=20.4),
            ("OK", "streaming, 20 ms in the service"),
        ),
        (BridgeStatus(received_at=99.9, answered_at=90.0), ("WARN", "no answer for 10 s")),
        (BridgeStatus(received_at=99.9, answered_at=99.5, error="refused"), ("ERROR", "refused")),
    ],
)
def test_diagnosis(status: BridgeStatus, expected: tuple[str, str]) -> None:
    assert status.diagnosis(100.0) == expected


def test_the_package_declares_what_the_node_imports_and_installs_what_exists() -> None:
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("name") == "lanestream_bridge"
    tree = ast.parse((PACKAGE / "lanestream_bridge" / "node.py").read_text())
    imported = {str(node.module).partition(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    declared = {element.text for element in package if element.tag.endswith("depend")}
    assert {name for name in imported if name.endswith("_msgs")} | {"rclpy"} <= declared
    setup = (PACKAGE / "setup.py").read_text()
    assert f'version="{package.findtext("version")}"' in setup
    for path in re.findall(r'"((?:launch|config)/[^"]+|package\.xml)"', setup):
        assert (PACKAGE / path).is_file()
    assert (PACKAGE / "resource" / "lanestream_bridge").is_file()
    config = configparser.ConfigParser()
    config.read(PACKAGE / "setup.cfg")
    assert config["install"]["install_scripts"] == "$base/lib/lanestream_bridge"


def test_the_parameter_file_has_every_parameter_but_the_key() -> None:
    tree = ast.parse((PACKAGE / "lanestream_bridge" / "node.py").read_text())
    (defaults,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.AnnAssign) and node.value and getattr(node.target, "id", "") == "DEFAULTS"
    )
    text = (PACKAGE / "config" / "bridge.yaml").read_text()
    written = dict(re.findall(r"^    (\w+): (\S+)", text, re.MULTILINE))
    quoted = {name: f'"{value}"' if isinstance(value, str) else str(value).lower() for name, value in defaults.items()}
    del quoted["api_key"]
    assert written == quoted
