"""The tracker on given detections: identities, positions, gaps, lane changes. Time is a number, so nothing sleeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from drives import DT, LANE, VIEW, bottom_columns, detection, drive, ids, road

from lanestream.road.appearance import MARKING_TYPES, Appearance, BoundaryKind
from lanestream.road.curve import Curve
from lanestream.road.results import Detection, EgoLane, Event, FrameResult, LaneChange, SceneCut
from lanestream.road.view import RoadView, visible_rows
from lanestream.tracking.tracker import _MOST_TRACKS, LaneTracker
from lanestream.tracking.tracks import _COAST_S, FRAMES, HITS

NEAR = np.array([350.0, 260.0, 200.0])


def events(results: list[FrameResult]) -> list[Event]:
    return [event for result in results for event in result.events]


def expected_by_the_prior(detections: list[Detection]) -> list[Detection]:
    return [replace(one, expected=True) for one in detections]


# --- Confirmation -----------------------------------------------------------------------------------------------------


def test_boundaries_are_confirmed_by_three_hits() -> None:
    results = drive(LaneTracker(), 5, lambda _: road(0.0))
    assert [len(result.lanes) for result in results] == [0, 0, 4, 4, 4]
    assert [lane.position for lane in results[-1].lanes] == [-2, -1, 1, 2]
    assert ids(results[2]) == ids(results[-1]) == [1, 2, 3, 4]
    ego = results[-1].ego
    assert (ego.left, ego.right) == (2, 3)
    assert ego.offset is not None
    assert ego.offset.value == pytest.approx(0.0, abs=0.02)


def test_at_the_start_boundaries_that_the_prior_expects_are_reported_at_once() -> None:
    def scene(frame: int) -> list[Detection]:
        return [*expected_by_the_prior(road(0.0, (0, 1))), *road(0.0, (2,))]

    results = drive(LaneTracker(), 4, scene)
    positions = [[lane.position for lane in result.lanes] for result in results]
    assert positions == [[-1, 1], [-1, 1], [-1, 1, 2], [-1, 1, 2]]


def test_later_boundaries_are_confirmed_by_three_hits_even_if_they_are_expected() -> None:
    tracker = LaneTracker()
    drive(tracker, 10, lambda _: road(0.0, (0, 1)))
    later = drive(tracker, range(10, 14), lambda _: expected_by_the_prior(road(0.0, (0, 1, 2))))
    assert [len(result.lanes) for result in later] == [2, 2, 3, 3]


@pytest.mark.parametrize("frames", [(0, 1, 2), (0, 2, 4), (0, 1, 4), (0, 3, 4)])
def test_three_hits_within_five_frames_confirm(frames: tuple[int, ...]) -> None:
    tracker = LaneTracker()
    drive(tracker, 10, lambda _: road(0.0, (0, 1)))
    results = drive(tracker, range(10, 15), lambda i: road(0.0, (0, 1, 2) if i - 10 in frames else (0, 1)))
    assert (HITS, FRAMES) == (3, 5)
    assert [len(result.lanes) for result in results] == [3 if i >= frames[-1] else 2 for i in range(5)]


def test_of_a_single_image_all_boundaries_are_reported_as_they_were_detected() -> None:
    seen = [detection(3.45), detection(-1.15, 300.0), detection(1.15)]
    result = LaneTracker(single_image=True).update(seen, 0.0, VIEW)
    assert [lane.curve for lane in result.lanes] == [seen[1].curve, seen[2].curve, seen[0].curve]
    assert [lane.position for lane in result.lanes] == [-1, 1, 2]
    assert all((lane.covariance == seen[0].covariance).all() for lane in result.lanes)
    assert result.ego.offset is not None


@pytest.mark.parametrize("start", [0, 1, 2, 30, 31, 47])
@pytest.mark.parametrize("place", [0.2, 2.4, -3.0])
def test_a_false_candidate_in_every_third_frame_is_never_reported(start: int, place: float) -> None:
    def scene(i: int) -> list[Detection]:
        false = [detection(place)] if i >= start and (i - start) % 3 == 0 else []
        return [*road(0.0, (0, 1)), *false]

    results = drive(LaneTracker(), 90, scene)
    assert [len(result.lanes) for result in results] == [0, 0] + [2] * 88


def test_a_single_false_detection_is_never_reported() -> None:
    results = drive(LaneTracker(), 30, lambda i: road(0.0, (0, 1)) + ([detection(0.2)] if i == 12 else []))
    assert all(len(result.lanes) == 2 for result in results[2:])


def test_a_tentative_boundary_is_forgotten_once_it_cannot_be_confirmed() -> None:
    tracker = LaneTracker()
    drive(tracker, 10, lambda _: road(0.0, (0, 1)))
    numbers = []
    for i in range(10, 15):
        drive(tracker, range(i, i + 1), lambda i: road(0.0, (0, 1, 2) if i == 10 else (0, 1)))
        numbers.append(len(tracker.state.unpacked()[0]))
    assert numbers == [3, 3, 3, 2, 2]


# --- Following --------------------------------------------------------------------------------------------------------


def test_ids_stay_and_tracks_converge_to_the_truth() -> None:
    rng = np.random.default_rng(3)
    results = drive(LaneTracker(), 60, lambda _: road(0.0, (0, 1), rng))
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2)}
    errors = np.array([bottom_columns(result) for result in results[20:]]) - [319.5 - 1.15 * 199, 319.5 + 1.15 * 199]
    assert np.abs(errors).max() < 5.0
    for lane, b in zip(results[-1].lanes, (-1.15, 1.15), strict=True):
        np.testing.assert_allclose(lane.curve.x(NEAR), Curve(160.0, (319.5, b, 0.0)).x(NEAR), atol=3.0)


def test_a_curve_is_followed() -> None:
    result = drive(LaneTracker(), 30, lambda _: [detection(-1.15, k=900.0), detection(1.15, k=900.0)])[-1]
    np.testing.assert_allclose(result.lanes[1].curve.x(NEAR), detection(1.15, k=900.0).curve.x(NEAR), atol=1.5)
    assert result.road is not None
    assert result.road.curvature.value == pytest.approx(900.0, abs=60.0)


@pytest.mark.parametrize("frame", [30, 47])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_displaced_detection_hardly_moves_its_boundary(frame: int, side: float) -> None:
    displaced = 0.09 * LANE * side
    assert displaced * VIEW.depth == pytest.approx(41.2 * side, abs=0.1), "pixels at the bottom row"

    def scene(i: int) -> list[Detection]:
        return [detection(-1.15), detection(1.15 + (displaced if i == frame else 0.0)), detection(3.45)]

    results = drive(LaneTracker(), 75, scene)
    rows = np.array([359.0, 270.0, 220.0])
    columns = np.array([[lane.curve.x(rows) for lane in result.lanes] for result in results[15:]])
    assert np.abs(columns - columns[0]).max() < 3.0


def test_a_moving_horizon_does_not_move_boundaries_on_the_ground() -> None:
    truth = Curve(160.0, (319.5, 1.15, 0.0))
    tracker = LaneTracker()
    for i in range(40):
        result = tracker.update([detection(-1.15), detection(1.15)], i * DT, RoadView(640, 360, 160.0 + 0.4 * i))
    assert ids(result) == [1, 2]
    rows = np.array([350.0, 280.0, 230.0])
    np.testing.assert_allclose(result.lanes[1].curve.x(rows), truth.x(rows), atol=2.0)


def test_rows_are_chosen_again_when_the_horizon_moves() -> None:
    tracker = LaneTracker()
    for i in range(75):
        view = VIEW.with_horizon(160.0 if i < 15 else 185.0)
        result = tracker.update([detection(b, view=view) for b in (-1.15, 1.15)], i * DT, view)
        if i == 14:
            assert tracker.state.horizon == 160.0
    assert ids(result) == [1, 2]
    assert events([result]) == []
    assert tracker.state.horizon == pytest.approx(185.0, abs=10.0)
    assert tracker.state.depth == pytest.approx(359.0 - tracker.state.horizon)
    assert result.horizon == pytest.approx(185.0, abs=2.0)
    rows = np.array([350.0, 230.0])
    np.testing.assert_allclose(result.lanes[1].curve.x(rows), Curve(185.0, (319.5, 1.15, 0.0)).x(rows), atol=2.0)


def test_the_lane_width_is_learned() -> None:
    tracker = LaneTracker()
    assert tracker.state.lane_width == pytest.approx(2.4)
    drive(tracker, 150, lambda _: [detection(-1.5), detection(1.5)])
    assert tracker.state.lane_width == pytest.approx(3.0, abs=0.02)
    drive(tracker, range(150, 300), lambda _: [detection(-1.5)])
    assert tracker.state.lane_width == pytest.approx(3.0, abs=0.02), "a boundary that is not seen teaches nothing"


def test_the_offset_and_the_sideways_speed_are_the_vehicles() -> None:
    results = drive(LaneTracker(), 75, lambda i: road(0.2 - 0.004 * i))
    ego = results[-1].ego
    assert ego.offset is not None
    assert ego.lateral_speed is not None
    assert ego.offset.value == pytest.approx(-0.2 + 0.004 * 74, abs=0.02), "to the right of the lane's center"
    assert ego.lateral_speed.value == pytest.approx(0.1, abs=0.02), "a boundary moves left if the vehicle moves right"
    assert 0.0 < ego.offset.sigma < 0.1
    assert 0.0 < ego.lateral_speed.sigma < 0.2


def test_a_missing_ego_boundary_leaves_its_position_empty() -> None:
    result = drive(LaneTracker(), 3, lambda _: road(0.0, (-1, 1)))[-1]
    assert [lane.position for lane in result.lanes] == [-2, 1]
    assert (result.ego.left, result.ego.right, result.ego.offset) == (None, 2, None)


def test_positions_are_counted_from_the_vehicles_middle() -> None:
    tracker = LaneTracker()
    for i in range(5):
        result = tracker.update(road(0.0), i * DT, VIEW, middle=1.3)
    assert [lane.position for lane in result.lanes] == [-3, -2, -1, 1]


def test_a_detection_without_paint_supports_an_inferred_boundary() -> None:
    def scene(i: int) -> list[Detection]:
        return [detection(-1.15, paint=0.05), detection(1.15, paint=0.0 if i >= 10 else 0.8)]

    results = drive(LaneTracker(), 20, scene)
    states = [[lane.state for lane in result.lanes] for result in results]
    assert states[9] == ["detected", "detected"], "even where little paint is usual"
    assert states[-1] == ["detected", "inferred"]
    assert results[-1].lanes[1].covariance[1, 1] > results[-1].lanes[0].covariance[1, 1]


# --- Hidden boundaries ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hidden", [10, 30])
@pytest.mark.parametrize("speed", [0.0, 0.25])
def test_a_boundary_keeps_its_id_and_its_place_while_it_is_hidden(hidden: int, speed: float) -> None:
    """The others are seen, and the vehicle moves sideways by so many lane widths per second."""
    rng = np.random.default_rng(8)

    def scene(i: int) -> list[Detection]:
        offset = -speed * max(0.0, (i - 74) * DT)
        return road(offset, (0, 2) if 75 <= i < 75 + hidden else (0, 1, 2), rng)

    results = drive(LaneTracker(), 85 + hidden, scene)
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2, 3)}
    states = [result.lanes[1].state for result in results[75:]]
    assert states == ["predicted"] * hidden + ["detected"] * 10
    for i in range(75, 75 + hidden):
        place = (0.5 - speed * (i - 74) * DT) * LANE
        error = bottom_columns(results[i])[1] - (VIEW.middle + place * VIEW.depth)
        assert abs(error) < 0.1 * LANE * VIEW.depth, "a tenth of a lane width"


def test_coasting_lasts_for_seconds_not_for_frames() -> None:
    both, lasted = road(0.0, (0, 1)), []
    for dt in (0.02, 0.04, 0.1):
        tracker = LaneTracker()
        start = round(1.0 / dt)
        drive(tracker, start, lambda _: both, dt)
        coasted = drive(tracker, range(start, round(4.0 / dt)), lambda _: both[:1], dt)
        numbers = [len(result.lanes) for result in coasted]
        assert numbers == sorted(numbers, reverse=True), "it does not come back"
        lasted.append(dt * numbers.count(2))
    assert _COAST_S[0] < lasted[0] < _COAST_S[1]
    assert lasted == pytest.approx([lasted[0]] * 3, abs=0.2)


def test_a_boundary_that_was_seen_for_long_coasts_for_longer_but_not_forever() -> None:
    both, lasted = road(0.0, (0, 1)), []
    for seen in (5, 25, 60, 200):
        tracker = LaneTracker()
        drive(tracker, seen, lambda _: both)
        coasted = drive(tracker, range(seen, seen + 100), lambda _: both[:1])
        lasted.append([len(result.lanes) for result in coasted].count(2))
        assert len(coasted[-1].lanes) == 1
    assert lasted[0] < lasted[1] < lasted[2] <= lasted[3]
    assert lasted[3] * DT == pytest.approx(_COAST_S[1], abs=0.1)


def test_uncertainty_grows_and_probability_fades_while_coasting() -> None:
    tracker = LaneTracker()
    both = road(0.0, (0, 1))
    drive(tracker, 25, lambda _: both)
    coasted = [result.lanes[1] for result in drive(tracker, range(25, 35), lambda _: both[:1])]
    assert [lane.state for lane in coasted] == ["predicted"] * 10
    assert all(later.covariance[1, 1] > earlier.covariance[1, 1] for earlier, later in pairwise(coasted))
    assert all(later.probability < earlier.probability for earlier, later in pairwise(coasted))


def test_a_boundary_that_is_detected_again_elsewhere_does_not_move_a_coasting_one() -> None:
    tracker = LaneTracker()
    drive(tracker, 12, lambda _: road(0.0, (0, 1, 2)))
    before = drive(tracker, range(12, 15), lambda _: road(0.0, (0, 1)))[-1]
    after = tracker.update([detection(-0.5 * LANE), detection(1.62 * LANE)], 15 * DT, VIEW)
    ego_right = [next(lane for lane in result.lanes if lane.position == 1) for result in (before, after)]
    assert [lane.state for lane in ego_right] == ["detected", "predicted"]
    near = [float(lane.curve.x(VIEW.bottom)) for lane in ego_right]
    assert near[1] == pytest.approx(near[0], abs=10.0), "the other one is 55 pixels from where it was"


def test_a_hidden_boundary_turns_with_the_road() -> None:
    rng = np.random.default_rng(5)

    def scene(i: int) -> list[Detection]:
        k = 60.0 * max(0, min(i - 74, 20))
        places = (-1.15, 1.15) if i < 75 or i >= 105 else (-1.15,)
        return [detection(b + rng.normal(0.0, 0.01), k + rng.normal(0.0, 20.0)) for b in places]

    results = drive(LaneTracker(), 110, scene)
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2)}
    hidden, truth = results[104].lanes[1], detection(1.15, 1200.0).curve
    assert hidden.state == "predicted"
    np.testing.assert_allclose(hidden.curve.x(NEAR), truth.x(NEAR), atol=0.1 * LANE * 199.0)


def test_another_boundary_does_not_get_the_id_of_a_lost_one() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 15, lambda _: road(0.0, (0, 1)))[-1]
    after = tracker.update([detection(-1.15 + 0.5 * LANE), detection(1.15)], 15 * DT, VIEW)
    assert ids(after) == ids(before)
    assert [lane.state for lane in after.lanes] == ["predicted", "detected"]


@pytest.mark.parametrize("frames", [1, 4])
def test_boundaries_keep_their_ids_through_frames_without_detections(frames: int) -> None:
    tracker = LaneTracker()
    before = drive(tracker, 50, lambda _: road(0.0))[-1]
    blind = drive(tracker, range(50, 50 + frames), lambda _: [])
    assert ids(blind[-1]) == ids(before)
    assert {lane.state for lane in blind[-1].lanes} == {"predicted"}
    assert ids(drive(tracker, range(50 + frames, 52 + frames), lambda _: road(0.0))[-1]) == ids(before)


def test_without_any_detection_all_boundaries_are_deleted() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 50, lambda _: road(0.0))[-1]
    last = drive(tracker, range(50, 100), lambda _: [])[-1]
    assert (last.lanes, last.ego, last.events, last.road) == ((), EgoLane(), (), None)
    assert not set(ids(drive(tracker, range(100, 105), lambda _: road(0.0))[-1])) & set(ids(before)), "ids never return"


# --- Lane changes -----------------------------------------------------------------------------------------------------


def lane_change(sign: int, seed: int, speed: float = 0.35) -> tuple[Callable[[int], list[Detection]], float]:
    """Returns a drive that crosses a boundary once, to the left with sign 1, and the exact time of the crossing."""
    rng = np.random.default_rng(seed)

    def scene(i: int) -> list[Detection]:
        return road(sign * min(1.0, max(0.0, speed * (i * DT - 2.0))), (-2, -1, 0, 1, 2, 3), rng)

    return scene, 2.0 + 0.5 / speed


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("direction", "sign"), [("right", -1), ("left", 1)])
def test_a_lane_change_is_reported_once_at_its_time(direction: str, sign: int, seed: int) -> None:
    scene, crossing = lane_change(sign, seed)
    results = drive(LaneTracker(), 160, scene)
    (event,) = events(results)
    before, after = results[40], results[-1]
    crossed = before.ego.right if direction == "right" else before.ego.left
    assert isinstance(event, LaneChange)
    assert (event.track_id, event.direction) == (crossed, direction)
    assert event.timestamp == pytest.approx(crossing, abs=0.1)
    (reported,) = (i for i, result in enumerate(results) if result.events)
    assert -DT < reported * DT - crossing <= 0.2, "and soon"
    assert (after.ego.left if direction == "right" else after.ego.right) == crossed
    positions, moved = ({lane.track_id: lane.position for lane in result.lanes} for result in (before, after))
    assert len(set(positions) & set(moved)) >= 3
    for track_id in set(positions) & set(moved):
        number = positions[track_id] + (positions[track_id] < 0)  # without the gap between -1 and 1
        assert moved[track_id] + (moved[track_id] < 0) == number + sign


@pytest.mark.parametrize("place", [0.0, 0.03, -0.03])
def test_driving_on_a_boundary_is_not_a_row_of_lane_changes(place: float) -> None:
    """The vehicle drives on a line for 20 seconds, as far as noisy detections say."""
    rng = np.random.default_rng(4)
    found = events(drive(LaneTracker(), 500, lambda _: road(0.5 + place, noise=rng)))
    assert found == []


def test_driving_near_a_boundary_is_not_a_lane_change() -> None:
    results = drive(LaneTracker(), 120, lambda i: road(min(0.5 + 0.05 * np.sin(i / 4.0) - 0.06, max(0, i - 11) * 0.02)))
    assert events(results) == []


def test_the_middle_of_the_vehicle_crosses_not_the_camera() -> None:
    scene, crossing = lane_change(1, 0)
    tracker = LaneTracker()
    results = [tracker.update(scene(i), i * DT, VIEW, middle=0.1 * LANE) for i in range(160)]
    (event,) = events(results)
    assert isinstance(event, LaneChange)
    assert event.timestamp == pytest.approx(crossing + 0.1 / 0.35, abs=0.1)


# --- Other scenes -----------------------------------------------------------------------------------------------------


def test_a_frame_in_which_nothing_is_where_it_was_shows_another_scene() -> None:
    def scene(i: int) -> list[Detection]:
        return road(0.0) if i < 30 else [detection(b) for b in (-LANE, 0.0, LANE)]

    results = drive(LaneTracker(), 40, scene)
    assert [i for i, result in enumerate(results) if result.events] == [30]
    assert results[30].events == (SceneCut(30 * DT),)
    assert results[30].lanes == ()
    assert not set(ids(results[-1])) & set(ids(results[29]))
    assert len(results[-1].lanes) == 3


def test_a_cut_that_the_caller_saw_begins_anew() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 30, lambda _: [detection(-1.5), detection(1.5)])[-1]
    cut = tracker.update(road(0.0, (0, 1)), 30 * DT, VIEW, is_cut=True)
    assert (cut.events, cut.lanes) == ((SceneCut(30 * DT),), ())
    assert tracker.state.lane_width == pytest.approx(2.4), "that of the last scene says nothing"
    after = drive(tracker, range(31, 35), lambda _: road(0.0, (0, 1)))[-1]
    assert len(after.lanes) == 2
    assert not set(ids(after)) & set(ids(before))
    at_once = tracker.update(expected_by_the_prior(road(0.0, (0, 1))), 35 * DT, VIEW, is_cut=True)
    assert len(at_once.lanes) == 2, "as at the start of a stream"


def test_one_boundary_elsewhere_is_not_another_scene() -> None:
    results = drive(LaneTracker(), 40, lambda i: road(0.0, (0, 1)) if i < 30 else [detection(-1.15), detection(2.7)])
    assert events(results) == []


def test_after_a_long_gap_the_tracker_begins_again() -> None:
    tracker = LaneTracker()
    before = drive(tracker, 12, lambda _: road(0.0, (0, 1)))[-1]
    after = [tracker.update(road(0.4, (0, 1)), 60.0 + i * DT, VIEW) for i in range(4)]
    assert events(after) == []
    assert not {track_id for result in after for track_id in ids(result)} & set(ids(before))
    assert len(after[-1].lanes) == 2


# --- Robustness -------------------------------------------------------------------------------------------------------


def test_two_tracks_of_one_marking_become_one() -> None:
    def scene(i: int) -> list[Detection]:
        return [detection(-1.15), detection(1.15), detection(max(1.2, 2.4 - 0.05 * max(0, i - 5)))]

    results = drive(LaneTracker(), 60, scene)
    assert len(results[5].lanes) == 3
    assert len(results[-1].lanes) == 2
    assert results[-1].lanes[1].track_id == results[5].lanes[1].track_id


@pytest.mark.parametrize("jump", [0.2, 0.3, 0.34])
def test_a_boundary_that_jumps_and_stays_there_is_followed_soon_and_keeps_its_id(jump: float) -> None:
    """Its detections are not matched with it, but they are too near to be another boundary."""

    def scene(i: int) -> list[Detection]:
        return [detection(-1.15), detection(1.15 if i < 75 else 1.15 + jump * LANE)]

    results = drive(LaneTracker(), 90, scene)
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2)}
    assert [result.lanes[1].state for result in results[74:77]] == ["detected", "predicted", "predicted"]
    place = VIEW.middle + (1.15 + jump * LANE) * VIEW.depth
    assert [bottom_columns(result)[1] for result in results[80:]] == pytest.approx([place] * 10, abs=10.0)


def test_a_boundary_that_is_matched_where_it_was_not_expected_is_followed_soon() -> None:
    """A single such detection would be an outlier; several in a row are not."""
    moved = 1.15 + 0.1 * LANE
    results = drive(LaneTracker(), 90, lambda i: [detection(-1.15), detection(1.15 if i < 75 else moved)])
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2)}
    for result in results[85:]:
        assert bottom_columns(result) == pytest.approx([VIEW.middle + b * VIEW.depth for b in (-1.15, moved)], abs=10.0)


def test_more_boundaries_than_a_limit_are_not_tracked() -> None:
    places = np.linspace(-7.0, 7.0, 3 * _MOST_TRACKS)
    first = detection(0.0)
    many = [replace(first, curve=Curve(160.0, (319.5, b, 0.0))) for b in places.tolist()]
    tracker = LaneTracker()
    for i in range(10):
        result = tracker.update(many, i * DT, VIEW)
        assert len(result.lanes) <= _MOST_TRACKS
    tracker.state.validate()
    assert all(np.isfinite(lane.covariance).all() for lane in result.lanes)


@pytest.mark.parametrize(
    "times", [[0.0, 0.04, 0.04, 0.04], [5.0, 4.0, 3.0, 2.0], [0.0, 1e6, 2e6, 3e6], [-3.0, -2.96, 0.0, 1e-9]]
)
def test_unusual_timestamps_are_harmless(times: list[float]) -> None:
    tracker = LaneTracker()
    for timestamp in times:
        result = tracker.update(expected_by_the_prior(road(0.0, (0, 1))), timestamp, VIEW)
    assert len(result.lanes) == 2
    for lane in result.lanes:
        assert np.isfinite(lane.covariance).all()
        assert np.isfinite(lane.curve.coefficients).all()


def test_timestamps_in_milliseconds_are_noticed_and_understood() -> None:
    tracker = LaneTracker()
    results = [tracker.update(road(0.0, (0, 1)), 40.0 * i, VIEW) for i in range(40)]
    warned = [i for i, result in enumerate(results) if result.warnings]
    assert [results[i].warnings for i in warned] == [("timestamps_in_milliseconds",)]
    assert len({tuple(ids(result)) for result in results[10:]}) == 1
    assert results[-1].lanes[0].age_s < 3.0


def test_frames_with_equal_timestamps_are_followed_and_warned_of() -> None:
    tracker = LaneTracker()
    results = [tracker.update(road(0.004 * i, (0, 1)), 7.0, VIEW) for i in range(40)]
    assert [result.warnings for result in results if result.warnings] == [("timestamps_not_advancing",)]
    assert ids(results[-1]) == [1, 2]
    truth = [VIEW.middle + (place + 0.004 * 39) * LANE * VIEW.depth for place in (-0.5, 0.5)]
    assert bottom_columns(results[-1]) == pytest.approx(truth, abs=4.0)


@pytest.mark.parametrize("seed", range(3))
def test_results_are_finite_and_their_covariances_definite_on_a_wild_drive(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracker, now = LaneTracker(), 0.0
    for _ in range(300):
        now += float(rng.choice([0.0, 0.01, 0.04, 0.2, 1.0]))
        view = VIEW.with_horizon(float(rng.normal(160.0, 8.0)))
        seen = []
        for b in rng.uniform(-5.0, 5.0, rng.integers(0, 7)).tolist():
            curve = Curve(view.horizon, (float(rng.normal(320.0, 60.0)), b, float(rng.normal(0.0, 2000.0))))
            rows = visible_rows(curve, view)
            if rows is not None:
                seen.append(Detection(curve, np.diag([1.0, 1e-4, 50.0]), *rows, *rng.uniform(size=2).tolist()))
        result = tracker.update(seen, now, view, is_cut=bool(rng.uniform() < 0.01))
        assert np.isfinite(result.horizon)
        assert len(set(ids(result))) == len(result.lanes)
        assert len({lane.position for lane in result.lanes}) == len(result.lanes)
        for lane in result.lanes:
            assert np.isfinite(lane.curve.coefficients).all()
            scale = 1.0 / np.sqrt(lane.covariance.diagonal())
            assert np.linalg.eigvalsh(lane.covariance * np.outer(scale, scale))[0] > -1e-6
            assert 0.0 <= lane.probability <= 1.0
        tracker.state.validate()


def test_innovations_are_reported_for_known_boundaries_only() -> None:
    tracker = LaneTracker()
    tracker.update(road(0.0, (0, 1)), 0.0, VIEW)
    assert len(tracker.nis) == 0
    tracker.update(road(0.0, (0, 1, 2)), DT, VIEW)
    assert len(tracker.nis) == 2
    assert (tracker.nis < 1.0).all()


def test_tracked_curves_include_those_of_boundaries_that_are_not_yet_confirmed() -> None:
    tracker = LaneTracker()
    assert (tracker.curves, tracker.confirmed_curves) == (None, None)
    result = drive(tracker, 10, lambda _: road(0.0, (0, 1)))[-1]
    tracker.update([*road(0.0, (0, 1)), detection(3.5)], 10 * DT, VIEW)
    assert tracker.curves is not None
    assert tracker.confirmed_curves is not None
    assert len(tracker.curves) == 3
    columns = sorted(float(x) for x in tracker.confirmed_curves.x(np.array([VIEW.bottom]))[:, 0])
    assert columns == pytest.approx(bottom_columns(result), abs=1.0)
    tracker.update([], 90.0, VIEW)
    assert tracker.curves is not None
    assert len(tracker.curves) == 0


def test_a_result_without_detections_is_empty() -> None:
    result = LaneTracker().update([], 0.0, VIEW)
    assert (result.lanes, result.ego, result.events, result.road) == ((), EgoLane(), (), None)


# --- Kinds ------------------------------------------------------------------------------------------------------------

DASHED = Appearance(0.03, (0.04, 0.9, 0.03, 0.03), (0.95, 0.05))
SOLID = Appearance(0.03, (0.9, 0.04, 0.03, 0.03), (0.95, 0.05))
EDGE = Appearance(0.95, (0.25,) * 4, (0.5, 0.5))
METER = LANE / 3.5  # in row offsets


def edged_road(offset: float = 0.0, apart_m: float = 0.6) -> list[Detection]:
    """Returns a lane with a dashed marking on its left, and a solid one on its right with the road's edge beyond it."""
    right = 1.15 + offset
    return [
        detection(-1.15 + offset, appearance=DASHED),
        detection(right, appearance=SOLID),
        detection(right + apart_m * METER, paint=0.0, appearance=EDGE),
    ]


def kinds(result: FrameResult) -> list[str]:
    return [lane.appearance.kind for lane in result.lanes]


def type_of(result: FrameResult, index: int = 0) -> str:
    types = result.lanes[index].appearance.types
    assert types is not None
    return MARKING_TYPES[types.index(max(types))]


@pytest.mark.parametrize("apart_m", [0.3, 0.6, 1.1])
def test_a_marking_and_the_edge_beside_it_are_two_boundaries(apart_m: float) -> None:
    results = drive(LaneTracker(), 60, lambda _: edged_road(0.0, apart_m))
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2, 3)}
    assert {tuple(kinds(result)) for result in results[2:]} == {("marking", "marking", "road_edge")}
    last = results[-1]
    assert [lane.position for lane in last.lanes] == [-1, 1, 2]
    assert (last.ego.left, last.ego.right, last.ego.left_kind, last.ego.right_kind) == (1, 2, "marking", "marking")
    assert last.ego.offset is not None
    assert last.ego.offset.value == pytest.approx(0.0, abs=0.02)


def test_two_markings_as_close_are_one() -> None:
    results = drive(LaneTracker(), 30, lambda _: [*edged_road()[:2], detection(1.15 + 0.6 * METER, appearance=SOLID)])
    assert len(results[-1].lanes) == 2


def test_an_edge_that_comes_later_gets_its_own_identity() -> None:
    results = drive(LaneTracker(), 60, lambda i: edged_road()[: 2 if i < 30 else 3])
    assert ids(results[29]) == [1, 2]
    assert ids(results[-1]) == [1, 2, 3]


def test_a_hidden_marking_does_not_move_to_the_edge_beside_it() -> None:
    def scene(i: int) -> list[Detection]:
        return [one for number, one in enumerate(edged_road()) if number != 1 or not 40 <= i < 65]

    results = drive(LaneTracker(), 90, scene)
    assert {tuple(ids(result)) for result in results[2:]} == {(1, 2, 3)}
    columns = np.array([bottom_columns(result) for result in results[10:]])
    assert np.abs(columns - columns[0]).max() < 8.0
    assert results[64].lanes[1].state == "predicted"


def test_without_a_marking_the_edge_bounds_the_ego_lane() -> None:
    results = drive(LaneTracker(), 30, lambda _: [edged_road()[0], edged_road()[2]])
    assert (results[-1].ego.left_kind, results[-1].ego.right_kind) == ("marking", "road_edge")
    assert drive(LaneTracker(), 5, lambda _: road(0.0, (1,)))[-1].ego.left_kind is None


def test_the_type_of_a_boundary_changes_with_the_road_and_not_with_a_frame() -> None:
    def scene(i: int) -> list[Detection]:
        wrong = i == 60
        return [detection(-1.15, appearance=SOLID if i >= 100 or wrong else DASHED), detection(1.15, appearance=SOLID)]

    results = drive(LaneTracker(), 140, scene)
    assert {type_of(result) for result in results[2:100]} == {"dashed"}
    changed = next(i for i in range(100, 140) if type_of(results[i]) == "solid")
    assert 103 <= changed <= 125
    assert {type_of(result) for result in results[changed:]} == {"solid"}
    assert ids(results[-1]) == [1, 2]


def test_a_hidden_boundary_becomes_less_certain() -> None:
    results = drive(LaneTracker(), 80, lambda i: edged_road()[: 2 if i < 50 else 1])
    before, after = (results[i].lanes[1].appearance for i in (49, 79))
    assert before.types is not None
    assert after.types is not None
    assert max(after.types) < max(before.types) - 0.05
    assert after.road_edge > before.road_edge


def test_of_a_single_image_kinds_are_those_of_the_detections() -> None:
    result = LaneTracker(single_image=True).update(edged_road(), 0.0, VIEW)
    assert kinds(result) == ["marking", "marking", "road_edge"]
    assert [type_of(result, i) for i in (0, 1)] == ["dashed", "solid"]


@pytest.mark.parametrize(
    ("chosen", "reported", "right"),
    [(("marking",), [1, 2], 2), (("road_edge",), [3], 3), (("marking", "road_edge"), [1, 2, 3], 2)],
)
def test_only_the_kinds_asked_for_are_reported(
    chosen: tuple[BoundaryKind, ...], reported: list[int], right: int
) -> None:
    result = drive(LaneTracker(kinds=chosen), 20, lambda _: edged_road())[-1]
    assert ids(result) == reported
    assert result.ego.right == right
    assert result.ego.left == (1 if "marking" in chosen else None)
    alone = LaneTracker(single_image=True, kinds=chosen).update(edged_road(), 0.0, VIEW)
    assert len(alone.lanes) == len(reported)


def test_a_lane_change_over_an_unreported_boundary_is_not_reported() -> None:
    def scene(i: int) -> list[Detection]:
        return [detection(b - 0.02 * i, appearance=EDGE) for b in (-1.15, 1.15, 3.45)]

    assert len(events(drive(LaneTracker(), 90, scene))) == 1
    assert events(drive(LaneTracker(kinds=("marking",)), 90, scene)) == []


def test_a_restored_tracker_reports_the_kinds_it_is_asked_for() -> None:
    tracker = LaneTracker(kinds=("marking",))
    drive(tracker, 20, lambda _: edged_road())
    other = LaneTracker.restored(tracker.state, kinds=("road_edge",))
    assert ids(drive(other, range(20, 22), lambda _: edged_road())[-1]) == [3]


def test_what_is_reported_does_not_change_tracking() -> None:
    wide = [*edged_road(), detection(-1.15 - 0.9 * METER, paint=0.0, appearance=EDGE)]
    trackers = [LaneTracker(kinds=chosen) for chosen in (("marking", "road_edge"), ("marking",), ("road_edge",))]
    for tracker in trackers:
        drive(tracker, 40, lambda _: wide)
    assert trackers[0].state == trackers[1].state == trackers[2].state
    assert trackers[0].state.lane_width == pytest.approx(LANE, abs=0.05)
