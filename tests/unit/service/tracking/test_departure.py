"""Lane departure warnings: exact drifts, noisy drifts, lane changes, and what suppresses a warning."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from lanestream.road.results import Departure, DepartureEvent, EgoMeters, Estimate
from lanestream.tracking.departure import (
    DepartureMonitor,
    DepartureSettings,
    DepartureState,
    SideState,
    VehicleMotion,
)

FPS = 25.0
LANE_WIDTH = 3.6
HALF_VEHICLE = DepartureSettings().vehicle_width / 2.0
# The offset from the lane's center, positive to the right, at which the wheels reach a line.
AT_LINE = LANE_WIDTH / 2.0 - HALF_VEHICLE
MOVING = VehicleMotion(speed=25.0, indicator="off")
Step = tuple[float, Departure, tuple[DepartureEvent, ...]]


def meters(offset: float, speed: float, distance_sigma: float = 0.01, speed_sigma: float = 0.01) -> EgoMeters:
    return EgoMeters(
        lateral_speed=Estimate(speed, speed_sigma),
        left=Estimate(LANE_WIDTH / 2.0 + offset, distance_sigma),
        right=Estimate(LANE_WIDTH / 2.0 - offset, distance_sigma),
    )


def drive(
    monitor: DepartureMonitor, offsets: np.ndarray, motion: VehicleMotion = MOVING, noise: int | None = None
) -> Iterator[Step]:
    """Drives along `offsets` from the center, frame by frame; `noise` is the seed of realistic errors, None for none.

    Errors of the offset (5 cm) and of the lateral speed (0.1 m/s) are correlated from frame to frame, as a tracker's.
    """
    rng = np.random.default_rng(noise)
    scale = np.array([0.0, 0.0]) if noise is None else np.array([0.05, 0.1])
    error = scale * rng.standard_normal(2)
    speeds = np.gradient(offsets) * FPS
    for frame, (offset, speed) in enumerate(zip(offsets, speeds, strict=True)):
        error = 0.8 * error + 0.6 * scale * rng.standard_normal(2)
        seen = meters(offset + error[0], speed + error[1], *(0.01, 0.01) if noise is None else (0.05, 0.1))
        departure, events = monitor.update(seen, 1, 2, frame / FPS, motion)
        yield frame / FPS, departure, events


def drift(speed: float, to: float = AT_LINE + 0.5) -> np.ndarray:
    """Returns the offsets of a vehicle that keeps to the center for two seconds and then drifts."""
    return np.concatenate([np.zeros(50), np.arange(0.0, to, speed / FPS)])


def events_of(steps: Iterator[Step]) -> list[DepartureEvent]:
    return [event for _, _, events in steps for event in events]


def test_a_drift_is_warned_of_before_the_line_and_its_crossing_has_the_exact_time() -> None:
    steps = list(drive(DepartureMonitor(), drift(0.5)))
    warning, crossed = events_of(iter(steps))
    crossing = 2.0 + AT_LINE / 0.5
    assert (warning.state, warning.side, warning.track_id) == ("warning", "right", 2)
    assert crossing - 0.3 / 0.5 < warning.timestamp < crossing - 0.2 / 0.5
    assert crossed == DepartureEvent("crossed", "right", 2, pytest.approx(crossing, abs=1e-6))
    states = [departure.state for _, departure, _ in steps]
    assert states == sorted(states, key=["none", "warning", "crossed"].index)
    times = {departure.time_to_crossing for _, departure, _ in steps}
    assert {None, 0.0} < times
    at = next(departure for time, departure, _ in steps if time >= crossing - 0.4)
    assert at == Departure("warning", "right", pytest.approx(0.4, abs=0.05))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("speed", [0.1, 0.2, 0.4, 0.8])
@pytest.mark.parametrize("seed", range(5))
def test_a_noisy_drift_is_warned_of_before_the_wheel_is_far_beyond_the_line(side: str, speed: float, seed: int) -> None:
    offsets = drift(speed)
    monitor, sign = DepartureMonitor(), -1.0 if side == "left" else 1.0
    first = next((time, events) for time, _, events in drive(monitor, sign * offsets, noise=seed) if events)
    assert first[1][0].side == side
    beyond = float(np.interp(first[0], np.arange(len(offsets)) / FPS, offsets)) - AT_LINE
    assert -0.3 < beyond < 0.25


@pytest.mark.parametrize("seed", range(24))
def test_a_vehicle_that_stays_inside_is_not_warned(seed: int) -> None:
    """It weaves between the lines for a minute, and its wheels come within 0.3 m of them."""
    time = np.arange(0.0, 60.0, 1.0 / FPS)
    period = 5.0 + seed / 4.0
    offsets = (AT_LINE - 0.3) * np.sin(2.0 * np.pi * time / period)
    assert not events_of(drive(DepartureMonitor(), offsets, noise=seed))


def test_a_vehicle_that_keeps_close_to_a_line_is_not_warned() -> None:
    assert not events_of(drive(DepartureMonitor(), np.full(5000, AT_LINE - 0.3), noise=1))


def test_a_departure_ends_inside_the_lane_and_warnings_repeat() -> None:
    out = drift(0.4, to=AT_LINE + 0.2)
    offsets = np.concatenate([out, out[:49:-1], out[50:]])
    steps = list(drive(DepartureMonitor(), offsets))
    assert [event.state for event in events_of(iter(steps))] == ["warning", "crossed"] * 2
    assert any(departure.state == "none" for time, departure, _ in steps if time > len(out) / FPS)


def test_a_wheel_on_the_line_does_not_flicker() -> None:
    offsets = np.concatenate([drift(0.3, to=AT_LINE), np.full(2500, AT_LINE)])
    assert len(events_of(drive(DepartureMonitor(), offsets, noise=3))) <= 2


def test_a_lane_change_ends_the_departure_without_a_warning_for_the_other_side() -> None:
    monitor = DepartureMonitor()
    events, states = [], []
    for frame in range(200):
        time = frame / FPS
        # To the left at 0.8 m/s from the third second on, until the vehicle is in the middle of the next lane.
        offset = -min(max(0.0, 0.8 * (time - 2.0)), LANE_WIDTH)
        changed = offset < -LANE_WIDTH / 2.0
        speed = -0.8 if 0.0 > offset > -LANE_WIDTH else 0.0
        seen = meters(offset + LANE_WIDTH if changed else offset, speed)
        departure, new = monitor.update(seen, 3 if changed else 1, 1 if changed else 2, time, MOVING)
        events += new
        states.append((changed, departure.state))
    assert [(event.state, event.side) for event in events] == [("warning", "left"), ("crossed", "left")]
    assert {state for changed, state in states if changed} == {"none"}


def test_a_new_boundary_warns_only_after_the_wheels_were_inside() -> None:
    monitor = DepartureMonitor()
    beyond = meters(AT_LINE + 0.3, 0.2)
    assert monitor.update(beyond, 1, 2, 0.0, MOVING) == (Departure("none", None, None), ())
    assert monitor.update(meters(0.0, 0.0), 1, 2, 1.0, MOVING)[1] == ()
    assert [event.state for event in monitor.update(beyond, 1, 2, 2.0, MOVING)[1]] == ["crossed"]


@pytest.mark.parametrize(
    ("motion", "warned"),
    [
        (VehicleMotion(), True),
        (VehicleMotion(15.0, "off"), True),
        (VehicleMotion(14.9), False),
        (VehicleMotion(None, "right"), False),
        (VehicleMotion(25.0, "left"), True),
    ],
)
def test_the_indicator_and_a_low_speed_suppress_warnings(motion: VehicleMotion, warned: bool) -> None:
    assert bool(events_of(drive(DepartureMonitor(), drift(0.5), motion))) == warned


def test_an_indicator_switched_off_beyond_the_line_does_not_warn() -> None:
    monitor = DepartureMonitor()
    offsets = drift(0.5)
    assert not events_of(drive(monitor, offsets, VehicleMotion(25.0, "right")))
    assert monitor.update(meters(offsets[-1], 0.5), 1, 2, 100.0, MOVING) == (Departure("none", None, None), ())


def test_the_settings_apply() -> None:
    early, late = (
        events_of(drive(DepartureMonitor(DepartureSettings(warning_s=seconds)), drift(0.2)))[0]
        for seconds in (1.0, 0.5)
    )
    assert late.timestamp - early.timestamp == pytest.approx(0.5, abs=0.1)
    wide = events_of(drive(DepartureMonitor(DepartureSettings(vehicle_width=2.4)), drift(0.5)))[1]
    assert wide.timestamp == pytest.approx(2.0 + (AT_LINE - 0.3) / 0.5)


def test_unknown_values_do_not_warn() -> None:
    monitor = DepartureMonitor()
    monitor.update(meters(0.0, 0.0), 1, 2, 0.0, MOVING)
    assert monitor.update(EgoMeters(), 1, 2, 0.1, MOVING) == (Departure(), ())
    assert monitor.update(meters(AT_LINE + 0.3, 0.5), None, None, 0.2, MOVING) == (Departure(), ())
    without_speed = replace(meters(AT_LINE + 0.3, 0.5), lateral_speed=None)
    monitor.update(meters(0.0, 0.0), 1, 2, 0.3, MOVING)
    departure, (event,) = monitor.update(without_speed, 1, 2, 0.4, MOVING)
    assert (departure.state, event.state, event.timestamp) == ("crossed", "crossed", pytest.approx(0.375))


def test_a_restored_monitor_continues() -> None:
    offsets = drift(0.5)
    whole = list(drive(DepartureMonitor(), offsets))
    monitor, again = DepartureMonitor(), []
    speeds = np.gradient(offsets) * FPS
    for frame, (offset, speed) in enumerate(zip(offsets, speeds, strict=True)):
        monitor.state.validate()
        monitor = DepartureMonitor(state=monitor.state)
        again.append((frame / FPS, *monitor.update(meters(offset, speed), 1, 2, frame / FPS, MOVING)))
    assert again == whole


@pytest.mark.parametrize(
    "state",
    [
        DepartureState(state="warning"),
        DepartureState(side="left"),
        DepartureState(timestamp=float("nan")),
        DepartureState(left=SideState(track_id=-1)),
        DepartureState(left=SideState(margin=float("inf"))),
        DepartureState(left=SideState(doubt=float("nan"))),
        DepartureState(right=SideState(outlook=float("nan"))),
        DepartureState(right=SideState(crossed_at=float("nan"))),
    ],
)
def test_impossible_states_are_refused(state: DepartureState) -> None:
    with pytest.raises(ValueError, match="departure") as caught:
        state.validate()
    assert "\n" not in str(caught.value)
