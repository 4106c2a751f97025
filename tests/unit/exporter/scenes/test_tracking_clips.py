"""Clips for trackers: their meters, ids, events and times agree with what their images show."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import av
import numpy as np
import pytest
from click.testing import CliRunner

from lanestream_exporter.scene_commands import scene
from lanestream_exporter.scenes.render import render_still
from lanestream_exporter.scenes.tracking_clips import GAP_LENGTHS, KINDS, sample_tracking_clip
from lanestream_exporter.scenes.tracking_truth import VEHICLE_WIDTH

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from lanestream_exporter.scenes.tracking_truth import TrackingClip

SMALL = (320, 180)
Record = dict[str, Any]


def truths(clip: TrackingClip, first: int = 0, last: int | None = None, step: int = 1) -> list[Record]:
    """Returns the records of some of the delivered frames."""
    return [truth for _, truth in replace(clip, deliveries=clip.deliveries[first:last:step]).frames()]


def flat(clip: TrackingClip) -> TrackingClip:
    """Returns the same clip on a flat road, without objects."""
    parts = []
    for part in clip.parts:
        course = replace(part.clip.scene.road.course, vertical_curvature=0.0)
        road = replace(part.clip.scene.road, course=course)
        bare = replace(part.clip.scene, road=road, walls=(), items=(), bridges=(), traffic=())
        parts.append(replace(part, clip=replace(part.clip, scene=bare)))
    return replace(clip, parts=tuple(parts))


def on_road(truth: Record, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns X and Y in meters of image points on a flat road, in the frame of a vehicle with the record's camera."""
    camera = truth["camera"]
    focal = truth["width"] / (2.0 * math.tan(math.radians(camera["field_of_view"]) / 2.0))
    row = (truth["height"] - 1) / 2.0
    pitch = math.atan((row - truth["horizon"]) / focal)
    ray_x = (points[:, 0] - (truth["width"] - 1) / 2.0) / focal
    ray_y = (points[:, 1] - row) / focal
    depth = camera["height"] / (ray_y * math.cos(pitch) + math.sin(pitch))
    ahead, left = depth * (math.cos(pitch) - ray_y * math.sin(pitch)), -depth * ray_x
    ahead += camera["height"] * math.tan(pitch)  # the tilted camera is so far ahead of the renderer's upright one
    yaw = math.radians(camera.get("yaw", 0.0))
    return ahead * math.cos(yaw) - left * math.sin(yaw), ahead * math.sin(yaw) + left * math.cos(yaw)


def expected_road(clip: TrackingClip, truth: Record) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Returns X and Y in meters of the ego lane's boundaries, integrated from the record's ego lane and the course."""
    ego, part = truth["ego"], clip.parts[0].clip
    along = np.arange(0.0, 60.0, 0.01)
    s = part.scene.pose.s + part.motion.speed * truth["time"] + along
    curvature = part.scene.road.course.curvature(s)
    turned = np.concatenate([[0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2.0 * 0.01)])
    direction = ego["heading"] + turned
    left, right = part.scene.road.beside(float(s[0]), part.scene.pose.u + part.motion.lateral(truth["time"]))
    center = (part.scene.road.boundaries[left[0]].u + part.scene.road.boundaries[right[0]].u) / 2.0
    step = 0.01 * (1.0 - curvature * center)
    x = np.concatenate([[0.0], np.cumsum((step * np.cos(direction))[:-1])])
    y = ego["offset_m"] + np.concatenate([[0.0], np.cumsum((step * np.sin(direction))[:-1])])
    half = ego["lane_width_m"] / 2.0
    return {
        position: (x + position * half * np.sin(direction), y - position * half * np.cos(direction))
        for position in (-1, 1)
    }


@pytest.mark.parametrize(
    ("kind", "seed"),
    [("keeping", 0), ("keeping", 1), ("lane_change", 3), ("curve", 5)],
)
def test_the_boundaries_in_the_image_agree_with_the_meters(kind: str, seed: int) -> None:
    clip = flat(sample_tracking_clip(kind, seed))
    assert clip.size == (640, 360)
    for truth in truths(clip, 10, None, 60):
        expected = expected_road(clip, truth)
        for lane in truth["lanes"]:
            if lane["position"] in expected:
                x, y = on_road(truth, np.array(lane["points"]))
                errors = np.abs(y - np.interp(x, *expected[lane["position"]]))
                assert (x < 10.0).sum() > 20
                assert errors[x < 10.0].max() < 0.001
                assert errors[x < 30.0].max() < 0.0025  # 0.005 degrees


@pytest.mark.parametrize("kind", KINDS)
def test_equal_arguments_give_equal_clips(kind: str) -> None:
    first, second, other = (next(sample_tracking_clip(kind, seed, SMALL).frames()) for seed in (7, 7, 8))
    assert np.array_equal(first[0], second[0])
    assert first[1] == second[1]
    assert not np.array_equal(first[0], other[0])
    assert first[1]["clip"] == f"{kind}-7"


@pytest.mark.parametrize("kind", KINDS)
def test_labels_are_inside_the_image_and_start_at_its_lowest_row(kind: str) -> None:
    for truth in truths(sample_tracking_clip(kind, 4, SMALL), 0, None, 50):
        positions = [lane["position"] for lane in truth["lanes"] if lane["position"]]
        assert positions == sorted(set(positions))
        for lane in truth["lanes"]:
            x, y = np.array(lane["points"]).T
            assert x.min() >= 0.0
            assert x.max() <= SMALL[0] - 1
            assert (np.diff(y) < 0.0).all()
            reaches_side = min(x[0], SMALL[0] - 1 - x[0]) < 6.0 * abs(x[1] - x[0]) + 2.0
            assert y[0] == SMALL[1] - 1 or reaches_side or lane["position"] == 0
            assert 0.0 <= lane["paint"] <= 1.0


@pytest.mark.parametrize("seed", range(6))
def test_the_event_of_a_lane_change_is_when_the_vehicle_crosses_the_boundary(seed: int) -> None:
    clip = sample_tracking_clip("lane_change", seed, SMALL)
    crossings = clip.parts[0].crossings()
    assert len(crossings) == 1
    event = crossings[0]
    assert event["direction"] == ("left" if seed % 2 == 0 else "right")
    at = math.floor(event["timestamp"] * 25.0)
    before, after = truths(clip, at, at + 2)
    assert before["events"] == []
    assert after["events"] == crossings
    crossed, next_one = ("left", "right") if event["direction"] == "left" else ("right", "left")
    near, far = before["ego"][crossed], -after["ego"][next_one]
    assert near > 0.0 > far
    assert before["timestamp"] + 0.04 * near / (near - far) == pytest.approx(event["timestamp"], abs=0.001)
    sides = [{lane["id"]: lane["position"] for lane in truth["lanes"]} for truth in (before, after)]
    sign = 1 if event["direction"] == "right" else -1
    assert (sides[0][event["lane_id"]], sides[1][event["lane_id"]]) == (sign, -sign)


def test_lane_changes_take_two_to_six_seconds_and_other_kinds_have_none() -> None:
    durations = [sample_tracking_clip("lane_change", seed).parts[0].clip.motion.moves[0].duration for seed in range(40)]
    assert 2.0 <= min(durations) < 2.6
    assert 5.4 < max(durations) <= 6.0
    for kind in KINDS.keys() - {"lane_change"}:
        for seed in range(5):
            assert not any(part.crossings() for part in sample_tracking_clip(kind, seed).parts)


@pytest.mark.parametrize(("kind", "first"), [("lane_change", 90), ("merge", 110)])
def test_ids_stay_with_their_boundaries(kind: str, first: int) -> None:
    last: dict[int, tuple[str, float]] = {}
    changed = 0
    for truth in truths(sample_tracking_clip(kind, 2, SMALL), first, first + 70):
        row = truth["horizon"] + 0.4 * (truth["height"] - truth["horizon"])
        now: dict[int, tuple[str, float]] = {}
        for lane in truth["lanes"]:
            x, y = np.array(lane["points"]).T
            if y[-1] < row < y[0]:
                now[lane["id"]] = (lane["type"], float(np.interp(row, y[::-1], x[::-1])))
        for key in now.keys() & last.keys():
            assert now[key][0] == last[key][0]
            assert abs(now[key][1] - last[key][1]) < 5.0
        changed += now.keys() != last.keys()
        last = now
    assert len(last) >= 2
    assert changed <= 4


@pytest.mark.parametrize("seed", range(10))
def test_the_paint_of_the_ego_lane_disappears_in_gaps_two_seconds_apart(seed: int) -> None:
    clip = sample_tracking_clip("occlusion", seed, SMALL)
    part = clip.parts[0]
    spans = sorted({(gap.first, gap.first + gap.frames) for gap in part.gaps})
    assert len(spans) == 4
    assert {end - first for first, end in spans} <= set(GAP_LENGTHS)
    assert all(after - end >= 50 for (_, end), (after, _) in pairwise(spans))
    gap = min(part.gaps, key=lambda gap: gap.frames)
    first, last = gap.first - 1, gap.first + gap.frames
    for frame, truth in zip(range(first, last + 1), truths(clip, first, last + 1), strict=True):
        lane = next(lane for lane in truth["lanes"] if lane["id"] == gap.boundary)
        hidden = gap.covers(frame)
        assert (lane["gap"], lane["gap_length"]) == ((frame - gap.first + 1, gap.frames) if hidden else (0, 0))
        assert lane["position"] in (-1, 1)
        if hidden:
            assert lane["paint"] == 0.0
        marking = part.scene_at(frame).road.boundaries[gap.boundary].marking
        assert (marking is None or marking.wear == 1.0) == hidden


def test_a_vehicle_on_the_line_covers_paint() -> None:
    clip = next(
        clip for clip in (sample_tracking_clip("occlusion", s, SMALL) for s in range(9)) if clip.parts[0].riders
    )
    part = clip.parts[0]
    rider = part.riders[0]
    move = rider.moves[0]
    arrived = math.ceil((move.start + move.duration) * 25.0)
    gap = next(gap for gap in part.gaps if abs(gap.first - arrived) <= 1)
    whole = replace(clip, parts=(replace(part, gaps=()),))
    shares = [
        next(lane["paint"] for lane in truth["lanes"] if lane["id"] == gap.boundary)
        for truth in truths(whole, gap.first - 30, gap.first + 1, 30)
    ]
    assert shares[1] < shares[0] - 0.2
    with_rider, without = (
        render_still(replace(part, riders=riders).scene_at(gap.first)).image.astype(int) for riders in (part.riders, ())
    )
    assert np.abs(with_rider - without).max() > 40


@pytest.mark.parametrize("seed", range(4))
def test_a_lane_ends_or_begins(seed: int) -> None:
    records = truths(sample_tracking_clip("merge", seed, SMALL), 0, None, 25)
    counts = [len(truth["lanes"]) for truth in records]
    ids = [{lane["id"] for lane in truth["lanes"]} for truth in records]
    if seed < 2:
        assert len(ids[0] - ids[-1]) >= 1
    else:
        assert len(ids[-1] - ids[0]) >= 1
    assert all(truth["ego"]["offset_m"] is not None for truth in records)
    assert max(counts) >= 3


def test_bumps_pitch_the_camera_by_half_to_two_degrees_for_a_third_of_a_second() -> None:
    for seed in range(6):
        part = sample_tracking_clip("bump", seed).parts[0]
        camera = part.clip.scene.camera
        quiet = replace(part.clip, motion=replace(part.clip.motion, bumps=()))
        shifts = [
            part.clip.scene_at(frame).camera.horizon - quiet.scene_at(frame).camera.horizon
            for frame in range(part.clip.frames)
        ]
        pitches = np.degrees(np.arctan(np.abs(shifts) / camera.focal))
        moving = np.flatnonzero(pitches > 0.01)
        bumps = np.split(moving, np.flatnonzero(np.diff(moving) > 1) + 1)
        assert len(bumps) == 4
        assert all(len(bump) <= 8 for bump in bumps)
        assert 0.4 < max(pitches) <= 2.0


def test_a_cut_begins_another_scene_with_new_ids() -> None:
    clip = sample_tracking_clip("cut", 1, SMALL)
    at = clip.parts[0].clip.frames
    before, after = truths(clip, at - 1, at + 1)
    assert (before["scene"], after["scene"]) == (0, 1)
    assert after["timestamp"] == pytest.approx(before["timestamp"] + 0.04)
    assert not {lane["id"] for lane in before["lanes"]} & {lane["id"] for lane in after["lanes"]}
    assert before["camera"] == after["camera"]


@pytest.mark.parametrize("seed", range(5))
def test_frames_are_lost_doubled_or_late(seed: int) -> None:
    for number in range(seed, 40, 5):
        clip = sample_tracking_clip("bad_time", number)
        frames = np.array([delivery.frame for delivery in clip.deliveries])
        stamps = np.array([delivery.timestamp for delivery in clip.deliveries])
        late = stamps - frames / 25.0
        repeated = np.diff(frames) == 0
        assert (np.diff(stamps) >= 0.0).all()
        assert (np.diff(frames) >= 0).all()
        if seed == 0:  # lost
            assert 0.15 < 1.0 - len(frames) / 250.0 < 0.55
            assert np.abs(late).max() < 1e-9
        elif seed == 1:  # doubled with the same timestamp
            assert set(frames) == set(range(250))
            assert 0.15 < repeated.mean() < 0.4
            assert (np.diff(stamps)[repeated] == 0.0).all()
        elif seed == 2:  # repeated in the place of the next
            assert len(frames) == 250
            assert np.diff(stamps) == pytest.approx(0.04)
            assert repeated.sum() > 20
        elif seed == 3:  # late
            assert list(frames) == list(range(250))
            assert 0.0 <= late.min() < 0.01
            assert 0.05 < late.max() <= 0.08
        else:
            assert repeated.any()
            assert (np.diff(frames) > 1).any()
            assert late.max() > 0.02


def test_a_repeated_frame_has_the_same_image_and_truth() -> None:
    clip = sample_tracking_clip("bad_time", 1, SMALL)
    at = next(n for n in range(1, 99) if clip.deliveries[n].frame == clip.deliveries[n - 1].frame)
    (image, truth), (again, repeated) = replace(clip, deliveries=clip.deliveries[at - 1 : at + 1]).frames()
    assert np.array_equal(image, again)
    assert (truth["repeated"], repeated["repeated"]) == (False, True)
    assert (truth["ego"], truth["time"]) == (repeated["ego"], repeated["time"])


@pytest.mark.parametrize("seed", range(6))
def test_a_drift_crosses_the_line_or_stays_inside(seed: int) -> None:
    clip = sample_tracking_clip("drift", seed, SMALL)
    records = truths(clip, 0, None, 10)
    side = records[0]["drift"]["side"]
    distances = [truth["drift"]["wheel_distance"][side] for truth in records]
    speeds = [abs(truth["ego"]["lateral_speed"]) for truth in records]
    assert [truth["ego"][side] - VEHICLE_WIDTH / 2.0 for truth in records] == pytest.approx(distances, abs=1e-6)
    if seed % 2 == 0:
        assert -0.75 < min(distances) < -0.5
        assert 0.1 <= records[0]["drift"]["speed"] <= 0.8
        assert max(speeds) == pytest.approx(records[0]["drift"]["speed"], rel=0.3)
        assert min(truth["ego"][side] for truth in records) > 0.0  # its middle stays in the lane
    else:
        assert 0.3 <= min(distances) < 0.55


def test_the_command_writes_the_video_and_the_truth(tmp_path: Path) -> None:
    video = tmp_path / "merge.mp4"
    arguments = [str(video), "--kind", "merge", "--size", "320x180", "--fps", "2", "--seed", "5"]
    result = CliRunner().invoke(scene, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    records = [json.loads(line) for line in (tmp_path / "merge.jsonl").read_text().splitlines()]
    with av.open(str(video)) as container:
        assert sum(1 for _ in container.decode(video=0)) == len(records) == 22
    expected = truths(sample_tracking_clip("merge", 5, (320, 180), 2.0))
    assert records == [truth | {"clip": "merge.mp4"} for truth in expected]


def test_options_of_an_ordinary_drive_are_refused_for_a_kind(tmp_path: Path) -> None:
    result = CliRunner().invoke(scene, [str(tmp_path / "x.mp4"), "--kind", "curve", "--style", "lane"])
    assert result.exit_code == 2
    assert "--seconds, --style and --any-weather don't apply to a --kind" in result.output
