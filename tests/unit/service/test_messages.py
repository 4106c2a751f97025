"""Results converted into messages: exact to a hundredth of a pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.images.decoding import DecodedImage
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.protocol import LanesMessage, parse_server_message
from lanestream.road.appearance import Appearance
from lanestream.road.curve import Curve, curve_basis
from lanestream.road.results import (
    Calibration,
    CalibrationChanged,
    Departure,
    DepartureEvent,
    EgoLane,
    EgoMeters,
    Estimate,
    FrameResult,
    LaneBoundary,
    LaneChange,
    SceneCut,
)

STAGES = ("decode", "propose", "queue", "infer", "fit", "track", "total")


def boundary(curve: Curve, top: float, bottom: float) -> LaneBoundary:
    covariance = np.diag([1.0 / 3.0, 1e-7 / 3.0, 2e6 / 3.0])
    return LaneBoundary(5, -1, "predicted", 0.98765, curve, covariance, top, bottom, 1.23456)


def as_message(result: FrameResult) -> LanesMessage:
    """Returns the message for `result`, sent and parsed."""
    frame = ProcessedFrame((3840, 2160), replace(result, timing_ms=dict.fromkeys(STAGES, 1.23456)))
    message = parse_server_message(lanes_message(frame, seq=3, timestamp=0.12, dropped=2).model_dump_json())
    assert isinstance(message, LanesMessage)
    return message


def test_all_fields_are_reported() -> None:
    lane = boundary(Curve(870.123456789, (1919.5, -1.25, 5000.0)), 1000.0, 2159.0)
    message = as_message(FrameResult((lane,), EgoLane(5, None), 870.123456789))
    assert (message.seq, message.timestamp, message.width, message.height, message.dropped) == (3, 0.12, 3840, 2160, 2)
    assert (message.horizon, message.timing_ms.total, message.timing_ms.fit) == (870.12, 1.235, 1.235)
    assert message.ego.model_dump(exclude_none=True) == {"left": 5}
    assert (message.events, message.departure, message.calibration) == ([], None, None)
    (reported,) = message.lanes
    assert (reported.track_id, reported.position, reported.state) == (5, -1, "predicted")
    assert (reported.probability, reported.age_s) == (0.9877, 1.235)
    assert reported.covariance[2][2] == 666667.0
    assert len(reported.points) == 24
    assert reported.points[0] == reported.line.bottom
    assert reported.points[-1] == reported.line.top
    assert [y for _, y in reported.points] == sorted((y for _, y in reported.points), reverse=True)
    assert (reported.ground, reported.ground_covariance) == (None, None)
    assert (reported.kind, reported.kind_probability, reported.marking) == ("marking", 1.0, None)


def test_what_a_boundary_is_is_reported() -> None:
    lane = boundary(Curve(870.0, (1919.5, -1.25, 5000.0)), 1000.0, 2159.0)
    appearances = (
        Appearance(0.01234, (0.03, 0.94, 0.02, 0.01), (0.2, 0.8)),
        Appearance(0.87654, (0.25,) * 4, (0.5, 0.5)),
        Appearance(0.4, None, None),
    )
    lanes = tuple(replace(lane, appearance=appearance) for appearance in appearances)
    message = as_message(FrameResult(lanes, EgoLane(5, 6, left_kind="marking", right_kind="road_edge"), 870.0))
    marking, edge, unclassified = (
        one.model_dump(include={"kind", "kind_probability", "marking"}) for one in message.lanes
    )
    assert marking == {
        "kind": "marking",
        "kind_probability": 0.9877,
        "marking": {
            "type": "dashed",
            "type_probability": 0.94,
            "color": "yellow",
            "color_probability": 0.8,
            "probability": 0.752,
        },
    }
    assert edge == {"kind": "road_edge", "kind_probability": 0.8765, "marking": None}
    assert unclassified == {"kind": "marking", "kind_probability": 0.6, "marking": None}
    assert (message.ego.left_kind, message.ego.right_kind) == ("marking", "road_edge")


def test_meters_are_reported_with_their_sigmas() -> None:
    meters = EgoMeters(
        offset=Estimate(0.12345, 0.05432),
        heading=Estimate(-0.0123456, 0.001),
        curvature=Estimate(0.00123456789, 1e-5),
        lane_width=Estimate(3.54321, 0.08),
        lateral_speed=Estimate(-0.45678, 0.1),
    )
    ego = EgoLane(5, 6, offset=Estimate(0.034567, 0.01), meters=meters)
    lane = replace(
        boundary(Curve(870.0, (1919.5, -1.25, 5000.0)), 1000.0, 2159.0),
        state="inferred",
        ground=(0.001, 0.01, 1.75),
        ground_covariance=np.diag([1e-8, 1e-4, 1.0 / 3.0]),
    )
    message = as_message(
        FrameResult(
            (lane,),
            ego,
            870.0,
            departure=Departure("warning", "left", 0.87654),
            calibration=Calibration(Estimate(2.34567, 0.2), Estimate(-0.98765, 0.1), settled=True),
        )
    )
    assert message.ego.model_dump() == {
        "left": 5,
        "right": 6,
        "left_kind": None,
        "right_kind": None,
        "offset": 0.0346,
        "offset_sigma": 0.01,
        "offset_m": 0.123,
        "offset_m_sigma": 0.054,
        "lane_width_m": 3.543,
        "lane_width_m_sigma": 0.08,
        "heading": -0.012346,
        "heading_sigma": 0.001,
        "curvature": 0.00123457,
        "curvature_sigma": 1e-5,
        "lateral_speed": -0.457,
        "lateral_speed_sigma": 0.1,
    }
    assert message.lanes[0].state == "inferred"
    assert message.lanes[0].ground_covariance == [[1e-8, 0.0, 0.0], [0.0, 1e-4, 0.0], [0.0, 0.0, 0.333333]]
    assert message.departure is not None
    assert message.departure.model_dump() == {"state": "warning", "side": "left", "time_to_crossing": 0.877}
    assert message.calibration is not None
    assert message.calibration.model_dump() == {
        "pitch": 2.346,
        "pitch_sigma": 0.2,
        "yaw": -0.988,
        "yaw_sigma": 0.1,
        "settled": True,
    }


def test_every_event_is_reported() -> None:
    events = (
        LaneChange(5, "left", 1.23456789),
        DepartureEvent("crossed", "right", 6, 1.5),
        SceneCut(2.0),
        CalibrationChanged(2.5, 1.00049, -2.0),
    )
    message = as_message(FrameResult((), EgoLane(), 870.0, events))
    assert [event.model_dump() for event in message.events] == [
        {"type": "lane_change", "track_id": 5, "direction": "left", "timestamp": 1.234568},
        {"type": "departure", "state": "crossed", "side": "right", "track_id": 6, "timestamp": 1.5},
        {"type": "scene_cut", "timestamp": 2.0},
        {"type": "calibration_changed", "pitch": 1.0, "yaw": -2.0, "timestamp": 2.5},
    ]


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
