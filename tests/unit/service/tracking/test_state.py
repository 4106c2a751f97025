"""The tracker's state: exact, small, and checked when it comes from elsewhere."""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np
import pytest
from drives import DT, LANE, VIEW, detection, drive, ids, road
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import TypeAdapter

from lanestream.road.appearance import Appearance
from lanestream.road.results import Detection, FrameResult, LaneChange, SceneCut
from lanestream.road.view import RoadView
from lanestream.tracking.road_filter import COLUMN, OWN, PITCH, ROAD
from lanestream.tracking.state import _NUMBER, _TRACK, TrackerState
from lanestream.tracking.tracker import LaneTracker
from lanestream.tracking.tracks import ACTIVITIES

RECORD = TypeAdapter(TrackerState)


def through_json(state: TrackerState) -> TrackerState:
    """Returns a state as another process reads it from its saved form."""
    return RECORD.validate_json(RECORD.dump_json(state))


def exact(result: FrameResult) -> object:
    """Returns all numbers of a result bit for bit."""
    lanes = [(replace(lane, covariance=np.zeros(0)), lane.covariance.tobytes()) for lane in result.lanes]
    return repr(lanes), repr(replace(result, lanes=()))


# --- Exact restoring --------------------------------------------------------------------------------------------------


def wild_scene(i: int) -> tuple[list[Detection], float, RoadView, bool]:
    """Returns the detections, timestamp and view of a frame, and whether it begins another scene.

    The vehicle changes lanes, boundaries are missing now and then, false ones appear, the horizon moves, and timestamps
    are uneven.
    """
    rng = np.random.default_rng(i)
    view = VIEW.with_horizon(160.0 + 4.0 * float(np.sin(i / 20.0)) + (18.0 if i > 110 else 0.0))
    offset = 0.9 * float(np.sin(i / 30.0))
    places = [(number - 0.5 + offset) * LANE + rng.normal(0.0, 0.01) for number in (-2, -1, 0, 1, 2, 3)]
    if i % 7 == 0:
        places.append(float(rng.uniform(-4.0, 4.0)))
    seen = [
        detection(
            b,
            300.0 * np.sin(i / 40.0),
            v=VIEW.middle + rng.normal(0.0, 1.0),
            view=view,
            probability=float(rng.uniform(0.5, 1.0)),
            paint=float(rng.uniform(0.0, 1.0)),
            appearance=wild_appearance(rng),
        )
        for b in places
        if abs(b) < 4.5 and rng.uniform() < 0.85
    ]
    return seen, DT * i + float(rng.choice([0.0, 0.01, -0.05])), view, i in (40, 95)


def wild_appearance(rng: np.random.Generator) -> Appearance:
    """Returns any appearance, now and then that of a model that does not classify markings."""
    types, colors = (tuple(rng.dirichlet(np.full(number, 0.3)).tolist()) for number in (4, 2))
    road_edge = float(rng.beta(0.3, 0.9))
    return Appearance(road_edge, types, colors) if rng.uniform() < 0.8 else Appearance(road_edge)


def step(tracker: LaneTracker, i: int) -> FrameResult:
    seen, timestamp, view, is_cut = wild_scene(i)
    return tracker.update(seen, timestamp, view, middle=0.05, is_cut=is_cut)


def test_a_tracker_that_is_restored_for_each_frame_gives_the_same_results_bit_for_bit() -> None:
    """As worker processes do: each frame gets a new tracker with the state after the last one."""
    original, state = LaneTracker(), LaneTracker().state
    found: list[object] = []
    deaths = births = 0
    before: set[int] = set()
    for i in range(180):
        restored = LaneTracker.restored(through_json(state))
        assert restored.state == state
        results = [step(tracker, i) for tracker in (original, restored)]
        assert exact(results[0]) == exact(results[1])
        state = restored.state
        assert original.state == state
        state.validate()
        found += results[0].events
        now = set(ids(results[0]))
        births, deaths, before = births + len(now - before), deaths + len(before - now), now
    assert births > 8
    assert deaths > 6
    assert {type(event) for event in found} == {LaneChange, SceneCut}


@pytest.mark.parametrize("taken", [0, 1, 2, 7, 39, 40, 41, 100])
def test_a_restored_tracker_continues_exactly(taken: int) -> None:
    original = LaneTracker()
    for i in range(taken):
        step(original, i)
    restored = LaneTracker.restored(through_json(original.state))
    for i in range(taken, taken + 25):
        assert exact(step(original, i)) == exact(step(restored, i))
    assert restored.state == original.state


def test_a_state_does_not_change_with_the_tracker_that_is_restored_from_it() -> None:
    original = LaneTracker()
    drive(original, 5, lambda _: road(0.0))
    before = original.state
    drive(LaneTracker.restored(before), range(5, 10), lambda _: road(0.2))
    assert original.state == before


def test_ids_that_may_have_been_assigned_are_not_assigned_again() -> None:
    tracker = LaneTracker.restored(LaneTracker().state, ids_lost=10)
    assert ids(drive(tracker, 3, lambda _: [detection(1.15)])[-1]) == [11]


def test_the_state_of_eight_boundaries_is_small() -> None:
    tracker = LaneTracker()
    rng = np.random.default_rng(0)

    def scene(_: int) -> list[Detection]:
        places = (-4.6, -3.3, -2.0, -0.7, 0.7, 2.0, 3.3, 4.6)
        return [detection(b + rng.normal(0.0, 0.01), appearance=wild_appearance(rng)) for b in places]

    for i in range(30):
        # A stream that began long ago, with wrong timestamps.
        result = tracker.update(scene(i), 1.7e9 + 0.041234567 * (i - i // 10), VIEW.with_horizon(160.0 + rng.normal()))
    assert len(result.lanes) == 8
    assert len(json.dumps(asdict(tracker.state))) <= 4096
    assert len(RECORD.dump_json(tracker.state)) <= 4096


# --- States from elsewhere --------------------------------------------------------------------------------------------


def valid_state() -> TrackerState:
    """Returns the state of a tracker with two confirmed boundaries and a tentative one."""
    tracker = LaneTracker()
    rng = np.random.default_rng(1)
    drive(tracker, 20, lambda i: road(0.0, (0, 1) if i < 19 else (0, 1, 2), rng))
    return tracker.state


STATE = valid_state()
SIZE = ROAD + 3 * OWN


def with_tracks(**fields: object) -> TrackerState:
    """Returns a state whose tracks have other values: of all of them, or a tuple of each."""
    tracks = np.frombuffer(b64decode(STATE.tracks), _TRACK).copy()
    with np.errstate(over="ignore"):
        for name, value in fields.items():
            tracks[name] = value
    return replace(STATE, tracks=b64encode(tracks.tobytes()).decode())


def with_filter(change: Callable[[NDArray[np.float32], NDArray[np.float32]], None]) -> TrackerState:
    """Returns a state whose filter `change` changed: the mean (n,), and the lower triangle of the covariance."""
    numbers = np.frombuffer(b64decode(STATE.filter), _NUMBER).copy()
    change(numbers[:SIZE], numbers[SIZE:])
    return replace(STATE, filter=b64encode(numbers.tobytes()).decode())


def diagonal(index: int) -> int:
    """Returns where the variance of a state is in the lower triangle of a covariance."""
    return index * (index + 1) // 2 + index


def set_mean(index: int, value: float) -> TrackerState:
    return with_filter(lambda mean, _: mean.__setitem__(index, value))


def set_covariance(index: int | slice, value: float) -> TrackerState:
    return with_filter(lambda _, covariance: covariance.__setitem__(index, value))


NAN, INFINITY = float("nan"), float("inf")


def test_valid_states_are_accepted() -> None:
    STATE.validate()
    TrackerState().validate()
    assert len(STATE.unpacked()[0]) == 3
    with_tracks().validate()
    assert with_tracks() == set_covariance(slice(0, 0), 0.0) == STATE


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (replace(STATE, frames=-1), "frames is -1; expected 0 to"),
        (replace(STATE, frames=10**40), "frames is 1000"),
        (replace(STATE, activity=0.0), "activity is 0.0"),
        (replace(STATE, activity=2.0 * ACTIVITIES[1]), "activity is 8.0"),
        (replace(STATE, lane_width=0.0), "lane_width is 0.0"),
        (replace(STATE, lane_width=NAN), "lane_width is nan"),
        (replace(STATE, next_id=0), "next_id is 0"),
        (replace(STATE, next_id=1), "track_id is 1"),
        (replace(STATE, next_id=10**40), "next_id is 1000"),
        (replace(STATE, horizon=1e9), "horizon is 1000000000.0"),
        (replace(STATE, horizon=NAN), "horizon is nan"),
        (replace(STATE, mean_horizon=-INFINITY), "mean_horizon is -inf"),
        (replace(STATE, mean_horizon=300.0), "mean_horizon is 300.0"),
        (replace(STATE, depth=0.0), "depth is 0.0"),
        (replace(STATE, depth=5.0), "depth is 5.0"),
        (replace(STATE, depth=NAN), "depth is nan"),
        (replace(STATE, clock=replace(STATE.clock, now=-1.0)), "clock is -1.0"),
        (replace(STATE, clock=replace(STATE.clock, now=0.0)), "last_hit is 0.7"),
        (replace(STATE, clock=replace(STATE.clock, timestamp=NAN)), "timestamp is nan"),
        (replace(STATE, clock=replace(STATE.clock, timestamp=1e300)), "timestamp is 1e"),
        (replace(STATE, clock=replace(STATE.clock, step=0.0)), "step is 0.0"),
        (replace(STATE, clock=replace(STATE.clock, long_steps=-1)), "long_steps is -1"),
        (replace(STATE, clock=replace(STATE.clock, factor=0.0)), "factor is 0.0"),
        (replace(STATE, clock=replace(STATE.clock, factor=NAN)), "factor is nan"),
        (with_tracks(track_id=(1, 1, 0)), "two tracks have the same id"),
        (with_tracks(track_id=(1, 3, 0)), "track_id is 3"),
        (with_tracks(track_id=(1, 2**64 - 1, 0)), "track_id is 18446744073709551615"),
        (with_tracks(born=5.0), "born is 5.0"),
        (with_tracks(born=-1.0), "born is -1.0"),
        (with_tracks(born=NAN), "born is nan"),
        (with_tracks(last_hit=1e9), "last_hit is 1000000000.0"),
        (with_tracks(last_hit=NAN), "last_hit is nan"),
        (with_tracks(crossed=-1.0), "crossed is -1.0"),
        (with_tracks(crossed=INFINITY), "crossed is inf"),
        (with_tracks(probability=2.0), "probability is 2.0"),
        (with_tracks(probability=NAN), "probability is nan"),
        (with_tracks(top=1e5), "top is 100000.0"),
        (with_tracks(bottom=NAN), "bottom is nan"),
        (with_tracks(bottom=1e7), "bottom is 10000000.0"),
        (with_tracks(place=NAN), "place is nan"),
        (with_tracks(place=1e9), "place is 1000000000.0"),
        (with_tracks(scale=0.0), "scale is 0.0"),
        (with_tracks(scale=NAN), "scale is nan"),
        (with_tracks(paint=1.5), "paint is 1.5"),
        (with_tracks(paint=NAN), "paint is nan"),
        (with_tracks(side=0), "side"),
        (with_tracks(state=3), "the state of a track is 3; expected 0 to 2"),
        (with_tracks(frames=0), "number of hits is 0"),
        (with_tracks(road_edge=1.5), "road_edge is 1.5"),
        (with_tracks(road_edge=NAN), "road_edge is nan"),
        (with_tracks(types=(2.0, -1.0, 0.0, 0.0)), "types is 2.0"),
        (with_tracks(types=(1.0, 1.0, 0.0, 0.0)), "sum of types is 2.0"),
        (with_tracks(types=NAN), "types is nan"),
        (with_tracks(types=INFINITY), "types is inf"),
        (with_tracks(colors=(0.5, 0.25)), "sum of colors is 0.75"),
        (with_tracks(colors=(NAN, 1.0)), "colors is nan"),
        (replace(STATE, tracks="!"), "not valid base 64"),
        (replace(STATE, tracks=STATE.tracks + "Ä"), "not valid base 64"),
        (replace(STATE, tracks="AAAA"), f"has 3 bytes; expected a multiple of {_TRACK.itemsize}"),
        (replace(STATE, tracks=""), "which are not those of 0 tracks"),
        (replace(STATE, tracks=b64encode(bytes(_TRACK.itemsize)).decode()), "which are not those of 1 tracks"),
        (replace(STATE, filter=""), "the road filter is missing"),
        (replace(STATE, filter="!"), "not valid base 64"),
        (replace(STATE, filter="AAAA"), "has 3 bytes; expected a multiple of 4"),
        (replace(STATE, filter="AAAAAAAA"), "has 6 bytes; expected a multiple of 4"),
        (replace(STATE, filter=b64encode(bytes(16)).decode()), "has 4 numbers, which are not those of 3 tracks"),
        (set_mean(COLUMN, NAN), "not finite, or too large"),
        (set_mean(PITCH, 0.5), "pitch is 0.5"),
        (set_mean(PITCH, -0.5), "pitch is -0.5"),
        (set_mean(ROAD, INFINITY), "not finite, or too large"),
        (set_mean(ROAD, 1e20), "not finite, or too large"),
        (set_covariance(0, NAN), "not finite, or too large"),
        (set_covariance(1, -INFINITY), "not finite, or too large"),
        (set_covariance(diagonal(ROAD), -1.0), "negative variance"),
        (set_covariance(diagonal(SIZE - 1), -1e-6), "negative variance"),
        (set_covariance(1, 100.0), "not positive semidefinite"),
        (set_covariance(diagonal(SIZE - 1) - 1, -3.0), "not positive semidefinite"),
    ],
)
def test_an_invalid_state_is_refused_with_a_reason_on_one_line(state: TrackerState, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        state.validate()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 200


def test_tracks_of_the_version_before_kinds_are_refused() -> None:
    """So their session begins anew. They had 64 bytes, and five of them have as many bytes as four now."""
    for number in range(1, 13):
        tracks = b64encode(bytes(64 * number)).decode()
        size = ROAD + OWN * number
        numbers = b64encode(np.zeros(size + size * (size + 1) // 2, _NUMBER).tobytes()).decode()
        with pytest.raises(ValueError, match=r"packed array|which are not those of"):
            replace(STATE, tracks=tracks, filter=numbers).validate()


def test_too_many_tracks_are_refused() -> None:
    number = 33
    tracks = np.repeat(np.frombuffer(b64decode(with_tracks(track_id=0).tracks), _TRACK)[:1], number)
    size = ROAD + OWN * number
    numbers = np.zeros(size + size * (size + 1) // 2, _NUMBER)
    state = replace(STATE, tracks=b64encode(tracks.tobytes()).decode(), filter=b64encode(numbers.tobytes()).decode())
    with pytest.raises(ValueError, match="number of tracks is 33; expected 0 to 32"):
        state.validate()


def test_an_incomplete_filter_is_refused_when_it_is_restored() -> None:
    with pytest.raises(ValueError, match="which are not those of 3 tracks"):
        LaneTracker.restored(replace(STATE, filter=STATE.filter[:64]))


def test_a_filter_that_diverges_begins_anew() -> None:
    """Its pitch is thought to be unknown, and these detections seem to be below another horizon."""
    tracker = LaneTracker.restored(set_covariance(diagonal(PITCH), 1.0))
    low = VIEW.with_horizon(240.0)
    results = [tracker.update([detection(b, view=low) for b in (-1.15, 1.15)], 20 * DT, VIEW)]
    assert tracker.state.unpacked()[0] == []
    tracker.state.validate()
    results += drive(tracker, range(21, 24), lambda _: road(0.0, (0, 1)))
    assert [ids(result) for result in results] == [[], [], [], [3, 4]]
    assert results[-1].horizon == pytest.approx(VIEW.horizon, abs=1.0)


NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 1e-30, 1e30, 5e5, -5e5, NAN]) | st.floats(-1e6, 1e6)
OF_A_TRACK = st.sampled_from(
    ["born", "crossed", "probability", "top", "bottom", "place", "scale", "paint", "road_edge", "types", "colors"]
)
OF_A_TRACKER = st.sampled_from(["horizon", "depth", "mean_horizon", "lane_width", "activity"])


@st.composite
def nearly_valid(draw: st.DrawFn) -> TrackerState:
    """Draws states in which some numbers are others, of any size."""

    def change(mean: NDArray[np.float32], covariance: NDArray[np.float32]) -> None:
        for part in draw(st.lists(st.sampled_from([mean, covariance]), max_size=3)):
            part[draw(st.integers(0, len(part) - 1))] = draw(NUMBERS)

    state = with_filter(change)
    if draw(st.booleans()):
        state = RECORD.validate_python({**vars(state), draw(OF_A_TRACKER): draw(NUMBERS)})
    if draw(st.booleans()):
        state = replace(state, tracks=with_tracks(**{draw(OF_A_TRACK): draw(NUMBERS)}).tracks)
    return state


def reason_to_refuse(state: TrackerState) -> str | None:
    try:
        state.validate()
    except ValueError as error:
        return str(error)
    return None


@settings(max_examples=300)
@given(nearly_valid())
def test_a_state_is_refused_or_can_be_continued(state: TrackerState) -> None:
    reason = reason_to_refuse(state)
    if reason is not None:
        assert "\n" not in reason
        return
    tracker = LaneTracker.restored(state)
    now = state.clock.timestamp or 0.0
    for i in range(1, 5):
        result = tracker.update(road(0.0), now + i * DT, VIEW)
        assert all(np.isfinite(lane.curve.coefficients).all() for lane in result.lanes)
