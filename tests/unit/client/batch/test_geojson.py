"""What was seen along a track, as GeoJSON."""

from __future__ import annotations

from typing import Any

import fakes

from lanestream.protocol import EgoModel, LaneModel, LanesMessage, LineModel, MarkingModel
from lanestream_client.batch.geojson import SegmentLog
from lanestream_client.batch.gpx import Track

START = 1714564800.0  # 2024-05-01T12:00:00Z
# 0.001 degrees per second to the east.
TRACK = Track(tuple(START + second for second in range(20)), tuple((second / 1000, 50.0) for second in range(20)))
SOLID = MarkingModel(type="solid", type_probability=1, color="white", color_probability=1, probability=1)


def boundary(track_id: int, marking: MarkingModel | None) -> LaneModel:
    return LaneModel(
        track_id=track_id,
        position=-1,
        state="detected",
        probability=1,
        kind="road_edge" if marking is None else "marking",
        marking=marking,
        points=[],
        line=LineModel(bottom=(0, 0), top=(0, 0)),
        horizon=0,
        coefficients=(0, 0, 0),
        covariance=[],
        age_s=0,
    )


def frame(
    timestamp: float, left: MarkingModel | None = SOLID, width: float | None = 3.5, right: bool = True
) -> LanesMessage:
    """Returns a frame with a marking or an edge on the left, and perhaps an edge on the right."""
    lanes = [boundary(1, left), *([boundary(2, None)] if right else [])]
    ego = EgoModel(left=1, right=2 if right else None, offset=None, lane_width_m=width)
    return fakes.lanes(0).model_copy(update={"timestamp": timestamp, "lanes": lanes, "ego": ego})


def features(*frames: LanesMessage, start: float = START, track: Track = TRACK) -> list[dict[str, Any]]:
    log = SegmentLog()
    for each in frames:
        log.add(each)
    collection = log.feature_collection("/v/a.mp4", track, start)
    assert collection["type"] == "FeatureCollection"
    assert isinstance(collection["features"], list)
    return collection["features"]


def test_seconds_that_look_the_same_are_one_line() -> None:
    (feature,) = features(*(frame(number / 4) for number in range(13)))
    assert feature == {
        "type": "Feature",
        "geometry": {
            "type": "LineString",
            "coordinates": [[0.0, 50.0], [0.001, 50.0], [0.002, 50.0], [0.003, 50.0], [0.003, 50.0]],
        },
        "properties": {
            "file": "/v/a.mp4",
            "start": "2024-05-01T12:00:00.000Z",
            "end": "2024-05-01T12:00:03.000Z",
            "video_start_s": 0.0,
            "video_end_s": 3.0,
            "frames": 13,
            "both_ego_boundaries": 1.0,
            "lane_width_m": 3.5,
            "left_kind": "marking",
            "left_marking_type": "solid",
            "left_marking_color": "white",
            "right_kind": "road_edge",
            "right_marking_type": None,
            "right_marking_color": None,
        },
    }


def test_a_line_ends_where_most_frames_of_a_second_look_different() -> None:
    dashed = SOLID.model_copy(update={"type": "dashed"})
    frames = [frame(number / 4, dashed if number == 2 or number >= 8 else SOLID) for number in range(16)]
    found = features(*frames)
    assert [each["properties"]["left_marking_type"] for each in found] == ["solid", "dashed"]
    assert [each["properties"]["video_start_s"] for each in found] == [0.0, 2.0]
    # One begins where the other ends.
    assert found[0]["geometry"]["coordinates"][-1] == found[1]["geometry"]["coordinates"][0] == [0.002, 50.0]


def test_unknown_boundaries_and_widths() -> None:
    (feature,) = features(*(frame(number / 4, width=None, right=number == 3) for number in range(5)))
    properties = feature["properties"]
    assert (properties["right_kind"], properties["lane_width_m"], properties["both_ego_boundaries"]) == (
        None,
        None,
        0.2,
    )


def test_seconds_without_a_position_are_left_out() -> None:
    gap = Track((START, START + 2, START + 30, START + 33), ((0.0, 50.0), (0.002, 50.0), (0.03, 50.0), (0.033, 50.0)))
    found = features(*(frame(number / 2) for number in range(80)), track=gap)
    assert [(each["properties"]["video_start_s"], each["properties"]["video_end_s"]) for each in found] == [
        (0.0, 2.0),
        (30.0, 33.0),
    ]
    assert features(frame(0.0), start=START + 100) == []
