"""Boundaries become polylines of a few points, and frames are as hard as the detectors disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lanestream.detection.interface import Detections
from lanestream.road.appearance import Appearance
from lanestream.road.curve import Curve
from lanestream.road.results import Detection, EgoLane, FrameResult, LaneBoundary
from lanestream.road.view import RoadView
from lanestream_exporter.labeling.difficulty import compare
from lanestream_exporter.labeling.prelabels import polyline, prelabels

VIEW = RoadView(640, 360, 160.0)


def boundary(curve: Curve, top: float = 190.0, bottom: float = 350.0, **fields: object) -> LaneBoundary:
    made = LaneBoundary(3, -1, "detected", 0.9, curve, np.eye(3), top, bottom, 1.0)
    return replace(made, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("k", [0.0, 800.0, -3000.0])
def test_a_polyline_follows_its_curve_with_few_points(k: float) -> None:
    curve = Curve(160.0, (320.0, -1.2, k))
    points = polyline(boundary(curve))
    assert points[0, 1] == 350.0
    assert points[-1, 1] == 190.0
    assert (np.diff(points[:, 1]) < 0).all()
    assert len(points) == 2 if k == 0.0 else 3 <= len(points) <= 20
    rows = np.arange(190.0, 351.0)
    across = 1.0 / np.hypot(1.0, curve.slope(rows))  # of a column's distance from the line
    columns = np.interp(rows, points[::-1, 1], points[::-1, 0])
    assert (np.abs(columns - curve.x(rows)) * across).max() < 0.6


def test_kinds_types_and_ids_of_pre_labels() -> None:
    painted = Appearance(0.1, types=(0.1, 0.7, 0.1, 0.1), colors=(0.2, 0.8))
    curve = Curve(160.0, (320.0, -1.0, 0.0))
    boundaries = [
        boundary(curve, appearance=painted),
        boundary(curve, appearance=Appearance(0.9)),
        boundary(curve, appearance=Appearance()),
        boundary(Curve(160.0, (320.0, -9.0, 0.0)), top=340.0),  # entirely outside
    ]
    lanes = prelabels(FrameResult(tuple(boundaries), EgoLane(), 160.0), 640, 360, with_ids=True)
    assert [(lane.kind, lane.type, lane.color, lane.lane_id) for lane in lanes] == [
        ("marking", "dashed", "yellow", 3),
        ("road_edge", "edge", None, 3),
        ("marking", None, None, 3),
    ]
    assert prelabels(FrameResult((boundaries[0],), EgoLane(), 160.0), 640, 360, with_ids=False)[0].lane_id is None


def detections(*positions: float, probability: float = 1.0, road_edge: float = 0.0) -> Detections:
    found = [
        Detection(
            Curve(160.0, (320.0, at, 0.0)), np.eye(3), 190.0, 359.0, probability, appearance=Appearance(road_edge)
        )
        for at in positions
    ]
    return Detections(tuple(found), VIEW, 1.0)


def test_equal_detections_are_easy() -> None:
    found = compare(detections(-1.2, 1.2), detections(-1.2, 1.2))
    assert found.score == 0.0
    assert (
        found.reason
        == "left: 0.00 lane widths apart, probability 1.00; right: 0.00 lane widths apart, probability 1.00"
    )


@pytest.mark.parametrize(
    ("other", "score", "reason"),
    [
        # A quarter of a lane 2.4 wide on one of two sides.
        (detections(-1.8, 1.2), 0.125, "left: 0.25 lane widths apart"),
        (detections(-1.2), 0.5, "right: only candidates finds a boundary, with probability 1.00"),
        (detections(), 1.0, "left: only candidates finds a boundary"),
        (detections(-1.2, 1.2, probability=0.6), 0.2, "probability 0.60"),
        (detections(-1.2, 1.2, road_edge=0.9), 0.5, "marking or road_edge"),
    ],
)
def test_frames_are_as_hard_as_the_detectors_disagree(other: Detections, score: float, reason: str) -> None:
    found = compare(detections(-1.2, 1.2), other)
    assert found.score == pytest.approx(score, abs=0.02)
    assert reason in found.reason


def test_a_side_without_any_boundary_may_be_missed_by_both() -> None:
    found = compare(detections(-1.2), detections(-1.2))
    assert found.score == 0.125
    assert found.reason.endswith("right: no boundary found")
    assert compare(detections(), detections(1.2)).reason == (
        "left: no boundary found; right: only regression finds a boundary, with probability 1.00"
    )
