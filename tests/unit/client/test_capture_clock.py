"""Capture times of live cameras, from their own clock or from arrivals."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from lanestream_client.capture_clock import CaptureClock
from lanestream_client.frames import Clock


def times(
    clock: CaptureClock, frames: Iterable[tuple[float | None, float]], *, waits: bool = True
) -> list[tuple[float, Clock]]:
    """Returns the capture times of frames, given as the camera's time and the arrival."""
    found = []
    previous = None
    for source, arrived in frames:
        requested = arrived if previous is None or not waits else previous
        found.append(clock.time(source, requested=requested, arrived=arrived))
        previous = arrived
    return found


def rounded(found: list[tuple[float, Clock]]) -> list[float]:
    return [round(time, 3) for time, _ in found]


def test_the_cameras_clock_is_used_although_frames_arrive_unevenly() -> None:
    arrivals = [100.0, 100.09, 100.1, 100.11, 100.16]
    found = times(CaptureClock(0.04, has_times=True), [(50.0 + 0.04 * n, at) for n, at in enumerate(arrivals)])
    assert rounded(found) == [0.0, 0.04, 0.08, 0.12, 0.16]
    assert {clock for _, clock in found} == {"source"}


def test_frames_without_a_clock_get_their_arrival() -> None:
    for has_times, source in ((False, 1.0), (True, None)):
        clock = CaptureClock(0.04, has_times=has_times)
        found = times(clock, [(source and source + 0.04 * n, 7.0 + n / 15) for n in range(4)])
        assert rounded(found) == [0.0, 0.067, 0.133, 0.2]
        assert {clock for _, clock in found} == {"arrival"}


def test_a_first_frame_without_a_time_is_one_period_before_the_second() -> None:
    found = times(CaptureClock(0.04, has_times=True), [(None, 3.0), (0.0, 3.0), (0.04, 3.0)])
    assert rounded(found) == [0.0, 0.04, 0.08]


def test_single_frames_without_a_time_continue_the_cameras_clock() -> None:
    frames = [(None if n in {4, 5} else 0.04 * n, 3.0) for n in range(8)]
    found = times(CaptureClock(0.04, has_times=True), frames)
    assert rounded(found) == [0.0, 0.04, 0.08, 0.12, 0.16, 0.2, 0.24, 0.28]
    assert {clock for _, clock in found} == {"source"}


@pytest.mark.parametrize("jump", [-0.05, -500.0, 3600.0])
def test_a_clock_that_is_set_anew_costs_one_frame_its_time(jump: float) -> None:
    frames = [(0.04 * n + (jump if n > 2 else 0.0), 9.0 + 0.04 * n) for n in range(6)]
    found = times(CaptureClock(0.04, has_times=True), frames)
    assert rounded(found) == [0.0, 0.04, 0.08, 0.12, 0.16, 0.2]
    assert [clock for _, clock in found] == ["source"] * 3 + ["arrival"] + ["source"] * 2


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.6, 25 / 15, 90.0])
def test_a_clock_at_a_wrong_pace_is_given_up(rate: float) -> None:
    found = times(CaptureClock(0.04, has_times=True), [(rate * n / 15, n / 15) for n in range(300)])
    assert {clock for _, clock in found[-100:]} == {"arrival"}
    assert found[-1][0] - found[-100][0] == pytest.approx(99 / 15, abs=0.01)


def test_bursts_and_a_slow_reader_do_not_discredit_a_clock() -> None:
    def bursts() -> Iterable[tuple[float, float]]:
        for n in range(1500):
            yield 0.04 * n, 6.0 * (n // 150) + 0.001 * (n % 150)

    found = times(CaptureClock(0.04, has_times=True), bursts())
    assert {clock for _, clock in found} == {"source"}
    slow = times(CaptureClock(0.04, has_times=True), [(0.04 * n, 0.2 * n) for n in range(200)], waits=False)
    assert {clock for _, clock in slow} == {"source"}


def test_a_new_connection_continues_after_the_outage() -> None:
    clock = CaptureClock(0.04, has_times=True)
    times(clock, [(80.0 + 0.04 * n, 1.0 + 0.04 * n) for n in range(3)])
    clock.reconnected(has_times=True)
    assert rounded(times(clock, [(0.04 * n, 31.0 + 0.04 * n) for n in range(3)])) == [30.0, 30.04, 30.08]
