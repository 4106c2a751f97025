"""The tracker on given detections: identities, positions, gaps, lane changes. Time is a number, so nothing sleeps."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest

from lanestream.road.curve import Curve
from lanestream.road.results import Detection, EgoLane, FrameResult, LaneChange
from lanestream.road.view import RoadView, visible_rows
from lanestream.tracking.tracker import LaneTracker

VIEW = RoadView(640, 360, 160.0)
LANE = 2.3  # the lane width in row offsets
DT = 0.04


def detection(b: float, k: float = 0.0, probability: float = 0.95, noise: float = 0.0) -> Detection:
    """Returns a boundary at the lateral position `b`, in row offsets, as a detector would report it."""
    curve = Curve(VIEW.horizon, (319.5 + noise, b, k))
    rows = visible_rows(curve, VIEW, 0.1)
    assert rows is not None
    covariance = np.diag([1.0, 1e-4, 50.0])
    return Detection(curve, covariance, *rows, probability)


def road(offset: float, lanes: Sequence[int] = (-1, 0, 1, 2)) -> list[Detection]:
    """Returns the boundaries of a road whose ego lane has its center `offset` lane widths right of the camera."""
    positions = [(number - 0.5 + offset) * LANE for number in lanes]
    return [detection(b) for b in positions if abs(b) < 5.0]


def drive(tracker: LaneTracker, frames: int, scene: Callable[[int], list[Detection]], dt: float = DT) -> FrameResult:
    result = tracker.update(scene(0), 0.0, VIEW)
    for i in range(1, frames):
        result = tracker.update(scene(i), i * dt, VIEW)
    return result


def test_the_first_frame_has_lanes_and_the_ego_pair() -> None:
    result = LaneTracker().update(road(0.0), 0.0, VIEW)
    assert [lane.position for lane in result.lanes] == [-2, -1, 1, 2]
    assert result.ego.offset == pytest.approx(0.0, abs=0.02)


def test_ids_stay_and_tracks_converge_to_the_truth() -> None:
    rng = np.random.default_rng(3)
    tracker = LaneTracker()

    def scene(_: int) -> list[Detection]:
        return [detection(b, noise=float(rng.normal(0.0, 2.0))) for b in (-1.15, 1.15)]

    first = tracker.update(scene(0), 0.0, VIEW)
    last = first
    for i in range(1, 60):
        last = tracker.update(scene(i), i * DT, VIEW)
    assert [lane.track_id for lane in last.lanes] == [lane.track_id for lane in first.lanes]
    for lane, b in zip(last.lanes, (-1.15, 1.15), strict=True):
        rows = np.array([350.0, 260.0, 200.0])
        np.testing.assert_allclose(lane.curve.x(rows), Curve(160.0, (319.5, b, 0.0)).x(rows), atol=2.0)


def test_a_later_boundary_is_confirmed_by_three_hits() -> None:
    tracker = LaneTracker()
    drive(tracker, 10, lambda _: road(0.0, (0, 1)))
    counts = [len(tracker.update(road(0.0, (0, 1, 2)), i * DT, VIEW).lanes) for i in range(10, 14)]
    assert counts == [2, 2, 3, 3]


def test_a_single_false_detection_is_never_reported() -> None:
    tracker = LaneTracker()
    drive(tracker, 10, lambda _: road(0.0, (0, 1)))
    for i in range(10, 30):
        false = [detection(0.2)] if i == 12 else []
        assert len(tracker.update(road(0.0, (0, 1)) + false, i * DT, VIEW).lanes) == 2


@pytest.mark.parametrize("dt", [0.01, 0.04, 0.1])
def test_coasting_lasts_for_seconds_not_for_frames(dt: float) -> None:
    tracker = LaneTracker()
    both = road(0.0, (0, 1))
    drive(tracker, 12, lambda _: both, dt)
    reported = []
    for i in range(12, 12 + int(1.0 / dt)):
        result = tracker.update(both[:1], i * dt, VIEW)
        reported.append([lane.state for lane in result.lanes])
    seconds = dt * sum(len(states) == 2 for states in reported)
    assert seconds == pytest.approx(0.7, abs=2 * dt)
    assert reported[0] == ["detected", "predicted"]


def test_covariance_grows_and_probability_fades_while_coasting() -> None:
    tracker = LaneTracker()
    both = road(0.0, (0, 1))
    drive(tracker, 12, lambda _: both)
    coasted = [tracker.update(both[:1], i * DT, VIEW).lanes[1] for i in range(12, 22)]
    variances = [lane.covariance[0, 0] for lane in coasted]
    assert all(later > earlier for earlier, later in pairwise(variances))
    assert coasted[-1].probability < coasted[0].probability


def test_a_coasting_boundary_moves_with_the_detected_ones() -> None:
    tracker = LaneTracker()
    drive(tracker, 12, lambda _: road(0.0, (0, 1)))
    for i in range(12, 24):
        shift = 0.015 * (i - 11)
        result = tracker.update(road(shift, (0,)), i * DT, VIEW)
    left, right = (float(lane.curve.x(VIEW.bottom)) for lane in result.lanes)
    assert right - left == pytest.approx(LANE * VIEW.depth, rel=0.08)


def test_a_boundary_that_is_detected_again_elsewhere_does_not_move_a_coasting_one() -> None:
    tracker = LaneTracker()
    drive(tracker, 12, lambda _: road(0.0, (0, 1, 2)))
    for i in range(12, 15):
        before = tracker.update(road(0.0, (0, 1)), i * DT, VIEW)
    after = tracker.update([detection(-0.5 * LANE), detection(1.62 * LANE)], 15 * DT, VIEW)
    ego_right = [next(lane for lane in result.lanes if lane.position == 1) for result in (before, after)]
    assert [lane.state for lane in ego_right] == ["detected", "predicted"]
    near = [float(lane.curve.x(VIEW.bottom)) for lane in ego_right]
    assert near[1] == pytest.approx(near[0], abs=1.0)


def test_a_coasting_boundary_is_not_reported_where_the_road_turns_but_keeps_its_id() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 12, lambda _: road(0.0, (0, 1)))
    curvatures = [180.0 * (i - 11) for i in range(12, 24)]
    numbers = [
        len(tracker.update([detection(-0.5 * LANE, k)], i * DT, VIEW).lanes) for i, k in enumerate(curvatures, 12)
    ]
    assert (numbers[0], numbers[-1]) == (2, 1)
    after = tracker.update([detection(b, curvatures[-1]) for b in (-0.5 * LANE, 0.5 * LANE)], 24 * DT, VIEW)
    assert [lane.track_id for lane in after.lanes] == [lane.track_id for lane in before.lanes]
    assert [lane.state for lane in after.lanes] == ["detected", "detected"]


def test_a_boundary_keeps_its_id_through_a_gap() -> None:
    tracker = LaneTracker()
    both = road(0.0, (0, 1))
    before = drive(tracker, 12, lambda _: both)
    for i in range(12, 26):
        tracker.update(both[:1], i * DT, VIEW)
    after = tracker.update(both, 26 * DT, VIEW)
    assert [lane.track_id for lane in after.lanes] == [lane.track_id for lane in before.lanes]
    assert after.lanes[1].state == "detected"


@pytest.mark.parametrize(("direction", "sign"), [("right", -1), ("left", 1)])
def test_a_lane_change_keeps_ids_and_moves_positions(direction: str, sign: int) -> None:
    tracker = LaneTracker()
    lanes = (-2, -1, 0, 1, 2, 3)
    before = drive(tracker, 15, lambda _: road(0.0, lanes))
    crossed = before.ego.right if direction == "right" else before.ego.left
    events: list[LaneChange] = []
    frames = 75
    for i in range(15, 15 + frames):
        offset = sign * min(1.0, (i - 14) / 60.0)
        result = tracker.update(road(offset, lanes), i * DT, VIEW)
        events += result.events
    assert events == [LaneChange(crossed, direction)]  # type: ignore[arg-type]
    positions_before = {lane.track_id: lane.position for lane in before.lanes}
    moved = {lane.track_id: lane.position for lane in result.lanes}
    stayed = set(positions_before) & set(moved)
    assert len(stayed) >= 3
    step = {-2: 1, -1: 2, 1: 1} if sign > 0 else {2: -1, 1: -2, -1: -1}
    for track_id in stayed:
        if positions_before[track_id] in step:
            assert moved[track_id] == positions_before[track_id] + step[positions_before[track_id]]


def test_driving_near_a_boundary_is_not_a_lane_change() -> None:
    tracker = LaneTracker()
    drive(tracker, 12, lambda _: road(0.0))
    for i in range(12, 120):
        offset = 0.5 + 0.05 * np.sin(i / 4.0)
        result = tracker.update(road(min(offset, (i - 11) * 0.02)), i * DT, VIEW)
        assert result.events == ()


def test_a_missing_ego_boundary_leaves_its_position_empty() -> None:
    result = LaneTracker().update(road(0.0, (-1, 1)), 0.0, VIEW)
    assert [lane.position for lane in result.lanes] == [-2, 1]
    assert result.ego.left is None
    assert result.ego.offset is None


def test_a_curve_is_followed() -> None:
    result = drive(LaneTracker(), 30, lambda _: [detection(-1.15, k=900.0), detection(1.15, k=900.0)])
    rows = np.array([350.0, 260.0, 200.0])
    np.testing.assert_allclose(result.lanes[1].curve.x(rows), detection(1.15, k=900.0).curve.x(rows), atol=1.0)


@pytest.mark.parametrize(
    "times", [[0.0, 0.04, 0.04, 0.04], [5.0, 4.0, 3.0, 2.0], [0.0, 1e6, 2e6, 3e6], [-3.0, -2.96, 0.0, 1e-9]]
)
def test_unusual_timestamps_are_harmless(times: list[float]) -> None:
    tracker = LaneTracker()
    for timestamp in times:
        result = tracker.update(road(0.0, (0, 1)), timestamp, VIEW)
    assert all(
        np.isfinite(lane.covariance).all() and np.isfinite(lane.curve.coefficients).all() for lane in result.lanes
    )


def test_after_a_long_gap_the_tracker_begins_again() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 12, lambda _: road(0.0, (0, 1)))
    after = tracker.update(road(0.4, (0, 1)), 60.0, VIEW)
    later = tracker.update(road(0.4, (0, 1)), 60.04, VIEW)
    last = tracker.update(road(0.4, (0, 1)), 60.08, VIEW)
    ids = {lane.track_id for result in (after, later, last) for lane in result.lanes}
    assert not ids & {lane.track_id for lane in before.lanes}
    assert len(last.lanes) == 2


def test_two_tracks_of_one_marking_become_one() -> None:
    tracker = LaneTracker()
    first = tracker.update([detection(-1.15), detection(1.15), detection(2.1)], 0.0, VIEW)
    assert len(first.lanes) == 3
    for i in range(1, 30):
        result = tracker.update([detection(-1.15), detection(1.15), detection(max(1.2, 2.1 - 0.05 * i))], i * DT, VIEW)
    assert len(result.lanes) == 2
    assert result.lanes[1].track_id == first.lanes[1].track_id


def test_a_moving_horizon_does_not_move_tracks() -> None:
    tracker = LaneTracker()
    truth = Curve(160.0, (319.5, 1.15, 0.0))
    for i in range(40):
        view = RoadView(640, 360, 160.0 + 0.4 * i)
        result = tracker.update([detection(-1.15), detection(1.15)], i * DT, view)
    assert len({lane.track_id for lane in result.lanes}) == 2
    rows = np.array([350.0, 280.0, 230.0])
    np.testing.assert_allclose(result.lanes[1].curve.x(rows), truth.x(rows), atol=1.5)


def test_a_boundary_that_turns_faster_than_the_filter_expects_keeps_its_id() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 15, lambda _: road(0.0, (0, 1)))
    sharp = 0.02 * VIEW.depth**2
    turned = [detection(b + 0.25 * LANE, sharp) for b in (-1.15, 1.15)]
    first, after = (tracker.update(turned, i * DT, VIEW) for i in (15, 16))
    assert {lane.state for lane in first.lanes} == {"predicted"}, "a single detection outside the gate is an error"
    assert [lane.track_id for lane in after.lanes] == [lane.track_id for lane in before.lanes]
    assert [lane.state for lane in after.lanes] == ["detected", "detected"]
    rows = np.array([330.0, 260.0])
    expected = Curve(160.0, (319.5, -1.15 + 0.25 * LANE, sharp)).x(rows)
    np.testing.assert_allclose(after.lanes[0].curve.x(rows), expected, atol=3.0)


def test_another_boundary_does_not_get_the_id_of_a_lost_one() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 15, lambda _: road(0.0, (0, 1)))
    after = tracker.update([detection(-1.15 + 0.5 * LANE), detection(1.15)], 15 * DT, VIEW)
    assert [lane.track_id for lane in after.lanes] == [lane.track_id for lane in before.lanes]
    assert [lane.state for lane in after.lanes] == ["predicted", "detected"]


def scene_at(i: int) -> list[Detection]:
    """Returns a road that moves, in which one boundary is missing now and then and false ones appear."""
    rng = np.random.default_rng(i)
    detections = road(0.3 * float(np.sin(i / 9.0)))
    missing = [detections[1:], detections[:-1], detections, detections][i % 4]
    return missing + ([detection(float(rng.uniform(-4.0, 4.0)))] if i % 5 == 0 else [])


@pytest.mark.parametrize("taken", [0, 1, 2, 7, 20, 33])
def test_a_restored_tracker_continues_exactly(taken: int) -> None:
    original = LaneTracker()
    for i in range(taken):
        original.update(scene_at(i), i * DT, VIEW)
    restored = LaneTracker.restored(original.state)
    assert restored.state == original.state
    for i in range(taken, taken + 25):
        view = VIEW.with_horizon(160.0 + 0.5 * i)
        results = [tracker.update(scene_at(i), i * DT, view) for tracker in (original, restored)]
        assert repr(results[0]) == repr(results[1])
        for one, other in zip(*(result.lanes for result in results), strict=True):
            assert one.covariance.tobytes() == other.covariance.tobytes()
            assert one.curve == other.curve
    assert restored.state == original.state


def test_a_restored_tracker_does_not_share_its_filters() -> None:
    original = LaneTracker()
    drive(original, 5, lambda _: road(0.0))
    before = original.state
    drive(LaneTracker.restored(before), 5, lambda _: road(0.2))
    assert original.state == before


def test_ids_that_may_have_been_assigned_are_not_assigned_again() -> None:
    state = LaneTracker().state
    (lane,) = LaneTracker.restored(state, ids_lost=10).update([detection(1.15)], 0.0, VIEW).lanes
    assert lane.track_id == 11


def test_the_state_of_eight_boundaries_is_small() -> None:
    tracker = LaneTracker()
    drive(tracker, 10, lambda _: [detection(b) for b in (-4.4, -3.1, -1.9, -0.7, 0.7, 1.9, 3.1, 4.4)])
    assert len(tracker.state.tracks) == 8
    assert len(json.dumps(asdict(tracker.state))) < 6_000


def test_an_incomplete_filter_is_refused() -> None:
    tracker = LaneTracker()
    drive(tracker, 3, lambda _: road(0.0))
    first, *others = tracker.state.tracks
    cut = replace(tracker.state, tracks=(replace(first, filter=first.filter[:96]), *others))
    with pytest.raises(ValueError, match="reshape"):
        LaneTracker.restored(cut)


def test_tracked_curves_are_those_of_confirmed_boundaries() -> None:
    tracker = LaneTracker()
    assert tracker.curves is None
    result = drive(tracker, 10, lambda _: road(0.0, (0, 1)))
    tracker.update([*road(0.0, (0, 1)), detection(3.5)], 10 * DT, VIEW)
    assert tracker.curves is not None
    assert len(tracker.curves) == 2
    columns = sorted(float(x) for x in tracker.curves.x(np.array([VIEW.bottom]))[:, 0])
    assert columns == pytest.approx([float(lane.curve.x(VIEW.bottom)) for lane in result.lanes], abs=1.0)
    tracker.update([], 90.0, VIEW)
    assert len(tracker.curves) == 0


def test_a_result_without_detections_is_empty() -> None:
    result = LaneTracker().update([], 0.0, VIEW)
    assert (result.lanes, result.ego, result.events) == ((), EgoLane(), ())
