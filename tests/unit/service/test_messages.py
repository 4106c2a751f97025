"""Results converted into messages: exact to a hundredth of a pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.images.decoding import DecodedImage
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.protocol import LanesMessage, parse_server_message
from lanestream.road.curve import Curve, curve_basis
from lanestream.road.results import EgoLane, FrameResult, LaneBoundary, LaneChange

STAGES = ("decode", "propose", "queue", "infer", "fit", "track", "total")


def boundary(curve: Curve, top: float, bottom: float) -> LaneBoundary:
    covariance = np.diag([1.0 / 3.0, 1e-7 / 3.0, 2e6 / 3.0])
    return LaneBoundary(5, -1, "predicted", 0.98765, curve, covariance, top, bottom, 1.23456)


def as_message(result: FrameResult) -> LanesMessage:
    """Returns the message for `result`, sent and parsed."""
    result = FrameResult(result.lanes, result.ego, result.horizon, result.events, dict.fromkeys(STAGES, 1.23456))
    frame = ProcessedFrame((3840, 2160), result)
    message = parse_server_message(lanes_message(frame, seq=3, timestamp=0.12, dropped=2).model_dump_json())
    assert isinstance(message, LanesMessage)
    return message


def test_all_fields_are_reported() -> None:
    lane = boundary(Curve(870.123456789, (1919.5, -1.25, 5000.0)), 1000.0, 2159.0)
    message = as_message(FrameResult((lane,), EgoLane(5, None), 870.123456789, (LaneChange(5, "left"),)))
    assert (message.seq, message.timestamp, message.width, message.height, message.dropped) == (3, 0.12, 3840, 2160, 2)
    assert (message.horizon, message.timing_ms.total, message.timing_ms.fit) == (870.12, 1.235, 1.235)
    assert message.ego.model_dump(exclude_none=True) == {"left": 5}
    assert message.events[0].model_dump() == {"type": "lane_change", "track_id": 5, "direction": "left"}
    (reported,) = message.lanes
    assert (reported.track_id, reported.position, reported.state) == (5, -1, "predicted")
    assert (reported.probability, reported.age_s) == (0.9877, 1.235)
    assert reported.covariance[2][2] == 666667.0
    assert len(reported.points) == 24
    assert reported.points[0] == reported.line.bottom
    assert reported.points[-1] == reported.line.top
    assert [y for _, y in reported.points] == sorted((y for _, y in reported.points), reverse=True)


def test_lanes_of_a_reduced_image_are_reported_in_pixels_of_its_file() -> None:
    lane = boundary(Curve(100.0, (300.0, -1.25, 500.0)), 120.0, 359.0)
    result = FrameResult((lane,), EgoLane(5, None), 100.0)
    picture = DecodedImage(np.zeros((360, 640, 3), np.uint8), reduction=2)
    frame = ProcessedFrame.of(picture, result, dict.fromkeys(STAGES, 1.0))
    (moved,) = frame.result.lanes
    assert (frame.size, frame.result.horizon, moved.top, moved.bottom) == ((1280, 720), 200.5, 240.5, 718.5)
    for row in (130.0, 200.0, 359.0):
        assert moved.curve.x(2.0 * row + 0.5) == pytest.approx(2.0 * float(lane.curve.x(row)) + 0.5, abs=1e-9)
        # One pixel of the reduced image is two pixels of the file, so variances grow fourfold.
        before, after = (
            float(basis @ covariance @ basis)
            for basis, covariance in (
                (curve_basis(100.0, np.array([row]))[0], lane.covariance),
                (curve_basis(200.5, np.array([2.0 * row + 0.5]))[0], moved.covariance),
            )
        )
        assert after == pytest.approx(4.0 * before)
    message = lanes_message(frame, seq=0, timestamp=0.0)
    assert (message.width, message.height, message.lanes[0].line.bottom[1]) == (1280, 720, 718.5)


@given(
    horizon=st.floats(100.0, 1500.0),
    v=st.floats(-500.0, 4500.0),
    b=st.floats(-4.0, 4.0),
    k=st.floats(-50_000.0, 50_000.0),
    top=st.floats(0.1, 0.5),
)
def test_curves_and_points_are_exact(horizon: float, v: float, b: float, k: float, top: float) -> None:
    curve = Curve(horizon, (v, b, k))
    top_row, bottom = horizon + top * (2159.0 - horizon), 2159.0
    (lane,) = as_message(FrameResult((boundary(curve, top_row, bottom),), EgoLane(), horizon)).lanes
    for y in np.linspace(top_row, bottom, 50):
        assert lane.x(float(y)) == pytest.approx(float(curve.x(y)), abs=0.01)
    for x, y in lane.points:
        assert x == pytest.approx(float(curve.x(y)), abs=0.01)
