"""The clock of a stream, from good and from wrong timestamps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.road.results import TimestampWarning
from lanestream.tracking.frame_clock import _LONG_STEPS, _USUAL_STEP, FrameClock


def run(timestamps: Sequence[float]) -> tuple[list[FrameClock], list[TimestampWarning]]:
    """Returns the clock at each of the frames, and all warnings."""
    clock = FrameClock()
    clocks: list[FrameClock] = []
    warnings: list[TimestampWarning] = []
    for timestamp in timestamps:
        clock, new = clock.advanced(timestamp)
        clocks.append(clock)
        warnings += new
    return clocks, warnings


def steps(clocks: Sequence[FrameClock]) -> list[float]:
    return [later.now - earlier.now for earlier, later in pairwise(clocks)]


@pytest.mark.parametrize("start", [0.0, -7.5, 1.7e9])
@pytest.mark.parametrize("dt", [0.005, 0.04, 0.2, 1.0])
def test_it_runs_with_good_timestamps(start: float, dt: float) -> None:
    clocks, warnings = run([start + dt * i for i in range(60)])
    assert clocks[0].now == 0.0, "at the first frame"
    assert clocks[-1].now == pytest.approx(59 * dt, abs=1e-5)
    assert clocks[-1].step == pytest.approx(dt, rel=1e-3)
    assert warnings == []


def test_uneven_steps_are_taken_as_they_are() -> None:
    timestamps = [0.0, 0.04, 0.24, 0.25, 0.65, 0.7]
    clocks, warnings = run(timestamps)
    assert [clock.now for clock in clocks] == pytest.approx(timestamps)
    assert warnings == []


def test_a_gap_passes_in_full_but_is_not_the_usual_step() -> None:
    clocks, warnings = run([0.0, 0.04, 0.08, 30.08, 30.12])
    assert clocks[-1].now == pytest.approx(30.12)
    assert [clock.step for clock in clocks] == pytest.approx([0.04] * 5)
    assert warnings == []


def test_milliseconds_are_recognized_after_some_steps() -> None:
    clocks, warnings = run([1e6 + 40.0 * i for i in range(20)])
    assert warnings == ["timestamps_in_milliseconds"]
    assert steps(clocks)[: _LONG_STEPS - 1] == [40.0] * (_LONG_STEPS - 1)
    assert steps(clocks)[_LONG_STEPS - 1 :] == pytest.approx([0.04] * (20 - _LONG_STEPS))
    assert clocks[-1].step == pytest.approx(0.04)


def test_milliseconds_stay_milliseconds_after_a_gap_or_a_repeated_frame() -> None:
    clocks, warnings = run([*(40.0 * i for i in range(10)), 360.0, 400.0, 5000.0, 5040.0])
    assert steps(clocks)[-4:] == pytest.approx([0.04, 0.04, 4.6, 0.04])
    assert warnings == ["timestamps_in_milliseconds", "timestamps_not_advancing"]


@pytest.mark.parametrize("dt", [0.001, 4.9, 1001.0])
def test_other_steps_are_not_milliseconds(dt: float) -> None:
    clocks, warnings = run([dt * i for i in range(10)])
    assert clocks[-1].now == pytest.approx(9 * dt)
    assert warnings == []


def test_single_pauses_of_seconds_are_not_milliseconds() -> None:
    timestamps = [0.0]
    for i in range(30):
        timestamps.append(timestamps[-1] + (10.0 if i % 3 else 0.04))
    assert run(timestamps)[1] == []


def test_the_usual_step_passes_between_frames_with_equal_timestamps() -> None:
    clocks, warnings = run([3.0] * 10)
    assert steps(clocks) == pytest.approx([_USUAL_STEP] * 9)
    assert warnings == ["timestamps_not_advancing"], "once"


def test_the_usual_step_is_that_of_the_stream() -> None:
    clocks, _ = run([0.1 * i for i in range(40)] + [3.9, 3.9])
    assert steps(clocks)[-2:] == pytest.approx([0.1, 0.1], rel=1e-3)


def test_time_never_goes_back() -> None:
    clocks, warnings = run([5.0, 5.04, 5.02, 1.0, 1.04])
    assert steps(clocks) == pytest.approx([0.04, 0.04, 0.04, 0.04])
    assert clocks[-1].timestamp == 1.04, "later frames count from the last one"
    assert warnings == ["timestamps_not_advancing"]


@given(st.lists(st.floats(-1e12, 1e12), min_size=2, max_size=12))
def test_time_always_advances_and_each_warning_is_given_once(timestamps: list[float]) -> None:
    clocks, warnings = run(timestamps)
    assert all(step >= 0.0 for step in steps(clocks))
    assert len(set(warnings)) == len(warnings)
    assert set(clocks[-1].warned) == set(warnings)


def test_a_time_between_frames_has_a_timestamp() -> None:
    clocks, _ = run([100.0, 100.04, 100.08])
    assert clocks[-1].timestamp_at(clocks[-1].now) == 100.08
    assert clocks[-1].timestamp_at(0.05) == pytest.approx(100.05)
    in_milliseconds, _ = run([40.0 * i for i in range(12)])
    last = in_milliseconds[-1]
    assert last.timestamp_at(last.now - 0.01) == pytest.approx(430.0), "in the unit of the stream"
