"""Lanes in meters: each curve of the image is a parabola on the road."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from lanestream.errors import ProtocolError
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.protocol import CameraModel, LanesMessage, StartMessage, json_schemas, parse_client_message
from lanestream.road.camera import Camera
from lanestream.road.curve import Curve
from lanestream.road.results import EgoLane, FrameResult, LaneBoundary

WIDTH, HEIGHT, HORIZON = 1280, 720, 300.0
MODEL = CameraModel(height=1.4, field_of_view=62.0)
STAGES = ("decode", "propose", "queue", "infer", "track", "total")

Ground = tuple[float, float, float]


def focal_length(field_of_view: float) -> float:
    """Returns it in pixels: half the field of view is between the middle and the right edge, WIDTH / 2 from it."""
    return WIDTH / 2.0 / math.tan(math.radians(field_of_view / 2.0))


def project(ground: Ground, camera: Camera, forward: float) -> tuple[float, float]:
    """Returns the pixel (x, y) of the point `forward` meters ahead on a ground parabola, by a pinhole camera."""
    a, b, c = ground
    left = a * forward**2 + b * forward + c
    scale = focal_length(camera.field_of_view) / forward
    return (WIDTH - 1) / 2.0 - scale * left, HORIZON + scale * camera.height


def in_image(ground: Ground, model: CameraModel = MODEL) -> Curve:
    """Returns the curve through the pixels of three points of a ground parabola."""
    camera = Camera(model.height, model.field_of_view)
    columns, rows = zip(*(project(ground, camera, forward) for forward in (5.0, 12.0, 30.0)), strict=True)
    return Curve.through(HORIZON, np.array(rows), np.array(columns))


def message(
    sides: dict[int, Ground], *, ego: EgoLane | None = None, camera: CameraModel | None = MODEL
) -> LanesMessage:
    """Returns the message for a road with the boundaries `sides` by track id; 1 is ego left, 2 is ego right."""
    lanes = tuple(
        LaneBoundary(track, -1 if track == 1 else 1, "detected", 0.9, in_image(ground), np.eye(3), 340.0, 719.0, 1.0)
        for track, ground in sides.items()
    )
    ego = ego or EgoLane(1 if 1 in sides else None, 2 if 2 in sides else None, 0.0)
    result = FrameResult(lanes, ego, HORIZON, timing_ms=dict.fromkeys(STAGES, 1.0))
    frame = ProcessedFrame((WIDTH, HEIGHT), result)
    return lanes_message(frame, seq=0, timestamp=0.0, camera=camera)


@given(
    height=st.floats(0.3, 4.0),
    field_of_view=st.floats(20.0, 150.0),
    a=st.floats(-2e-3, 2e-3),
    b=st.floats(-0.2, 0.2),
    c=st.floats(-8.0, 8.0),
)
def test_a_ground_parabola_is_recovered_exactly(
    height: float, field_of_view: float, a: float, b: float, c: float
) -> None:
    camera, focal = Camera(height, field_of_view), focal_length(field_of_view)
    curve = Curve(HORIZON, ((WIDTH - 1) / 2.0 - focal * b, -c / height, -a * focal**2 * height))
    for forward in (3.0, 10.0, 40.0):
        x, y = project((a, b, c), camera, forward)
        if y - HORIZON > 1.0:  # nearer to the horizon a row offset counts as 1
            assert float(curve.x(y)) == pytest.approx(x, abs=1e-6), "the curve is what a pinhole camera sees"
    assert camera.ground(curve, WIDTH) == pytest.approx((a, b, c), rel=1e-9, abs=1e-12)


def test_a_wider_view_has_a_shorter_focal_length() -> None:
    assert Camera(1.4, 90.0).focal_length(1280) == pytest.approx(640.0)
    assert Camera(1.4, 90.0).focal_length(640) == pytest.approx(320.0)
    assert Camera(1.4, 60.0).focal_length(1280) == pytest.approx(1108.513, abs=1e-3)


def test_a_straight_centered_lane_has_no_offset_and_its_width() -> None:
    lanes = message({1: (0.0, 0.0, 1.75), 2: (0.0, 0.0, -1.75)})
    assert [lane.ground for lane in lanes.lanes] == [
        pytest.approx((0.0, 0.0, 1.75), abs=1e-6),
        pytest.approx((0.0, 0.0, -1.75), abs=1e-6),
    ]
    ego = lanes.ego
    assert (ego.offset_m, ego.lane_width_m, ego.heading, ego.curvature) == pytest.approx((0.0, 3.5, 0.0, 0.0), abs=1e-6)


def test_a_camera_right_of_the_center_in_a_lane_that_turns_left() -> None:
    curvature, heading = 1.0 / 400.0, 0.03
    a, b = curvature / 2.0, math.tan(heading)
    ego = message({1: (a, b, 2.0), 2: (a, b, -1.4)}).ego
    assert (ego.offset_m, ego.lane_width_m) == pytest.approx((0.3, 3.4), abs=1e-3), (
        "positive to the right, like `offset`"
    )
    assert (ego.heading, ego.curvature) == pytest.approx((heading, curvature), abs=1e-6)
    top = [lane.line.top[0] - lane.line.bottom[0] for lane in message({2: (a, b, 0.0), 3: (-a, -b, 0.0)}).lanes]
    assert top[0] < 0.0 < top[1], "what turns left on the ground turns left in the image"


def test_the_offset_in_meters_has_the_sign_of_the_offset_in_lane_widths() -> None:
    """The lane's center is left of the image's middle, so the camera is right of it."""
    left, right = in_image((0.0, 0.0, 2.5)), in_image((0.0, 0.0, -1.0))
    center = (float(left.x(719.0)) + float(right.x(719.0))) / 2.0
    assert center < (WIDTH - 1) / 2.0
    assert (message({1: (0.0, 0.0, 2.5), 2: (0.0, 0.0, -1.0)}).ego.offset_m or 0.0) == pytest.approx(0.75, abs=1e-3)


def test_one_boundary_gives_the_direction_of_the_lane_but_not_its_width() -> None:
    ego = message({2: (5e-4, 0.01, -1.6)}).ego
    assert (ego.offset_m, ego.lane_width_m) == (None, None)
    assert (ego.heading, ego.curvature) == pytest.approx((0.01, 1e-3), abs=1e-5)
    other = message({2: (5e-4, 0.01, -1.6)}, ego=EgoLane())
    assert other.lanes[0].ground == pytest.approx((5e-4, 0.01, -1.6), abs=1e-6)
    assert other.ego.model_dump(exclude_none=True) == {}


@given(a=st.floats(-2e-3, 2e-3), b=st.floats(-0.2, 0.2), c=st.floats(-8.0, 8.0))
def test_a_message_is_exact_to_a_millimeter_at_a_hundred_meters(a: float, b: float, c: float) -> None:
    ground = message({1: (a, b, c)}).lanes[0].ground
    assert ground is not None
    for forward in (0.0, 20.0, 100.0):
        left = a * forward**2 + b * forward + c
        assert ground[0] * forward**2 + ground[1] * forward + ground[2] == pytest.approx(left, abs=1e-3)


def test_without_a_camera_all_meters_are_null() -> None:
    lanes = message({1: (0.0, 0.0, 1.75), 2: (0.0, 0.0, -1.75)}, camera=None)
    assert [lane.ground for lane in lanes.lanes] == [None, None]
    assert lanes.ego.model_dump(exclude_none=True) == {"left": 1, "right": 2, "offset": 0.0}
    assert '"ground":null' in lanes.model_dump_json()


def test_a_start_message_has_a_camera() -> None:
    start = parse_client_message('{"type": "start", "camera": {"height": 1.4, "field_of_view": 62}}')
    assert isinstance(start, StartMessage)
    assert start.camera == MODEL


@pytest.mark.parametrize(
    ("camera", "where"),
    [
        ('{"height": 0.2, "field_of_view": 62}', "camera.height"),
        ('{"height": 4.1, "field_of_view": 62}', "camera.height"),
        ('{"height": NaN, "field_of_view": 62}', "camera.height"),
        ('{"height": 1.4, "field_of_view": 19}', "camera.field_of_view"),
        ('{"height": 1.4, "field_of_view": 151}', "camera.field_of_view"),
        ('{"height": 1.4}', "camera.field_of_view"),
        ('{"height": 1.4, "field_of_view": 62, "pitch": 2}', "camera.pitch"),
        ("1.4", "camera"),
    ],
)
def test_an_invalid_camera_is_an_error_of_one_line(camera: str, where: str) -> None:
    with pytest.raises(ProtocolError, match=where) as caught:
        parse_client_message(f'{{"type": "start", "camera": {camera}}}')
    assert "\n" not in str(caught.value)


def test_an_invalid_camera_cannot_be_built() -> None:
    with pytest.raises(ValidationError, match=r"greater than or equal to 0\.3"):
        CameraModel(height=0.0, field_of_view=62.0)


def test_the_schemas_describe_cameras_and_meters() -> None:
    schemas = json_schemas()
    camera = schemas["client"]["$defs"]["CameraModel"]["properties"]
    assert (camera["height"]["minimum"], camera["height"]["maximum"]) == (0.3, 4.0)
    assert (camera["field_of_view"]["minimum"], camera["field_of_view"]["maximum"]) == (20.0, 150.0)
    assert "camera" in schemas["client"]["$defs"]["StartMessage"]["properties"]
    assert "ground" in schemas["server"]["$defs"]["LaneModel"]["properties"]
    ego = schemas["server"]["$defs"]["EgoModel"]["properties"]
    assert {"offset_m", "lane_width_m", "heading", "curvature"} <= set(ego)
