"""The direction of a camera, estimated from simulated drives."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from lanestream.road.camera import Camera, camera_from_vehicle
from lanestream.road.results import Calibration, CalibrationChanged, Estimate, RoadEstimate
from lanestream.tracking.calibration import CalibrationState, Calibrator

FPS: Final = 25.0
HEIGHT_M: Final = 1.4
CAMERA: Final = Camera(HEIGHT_M, 62.0, pitch="auto", yaw="auto")
LENS: Final = CAMERA.lens((640, 360), (640, 360))
SPEED: Final = 25.0

Sideways = Callable[[float], float]


def weave(seconds: float) -> float:
    """Returns the speed to the right in m/s of a driver who keeps the lane, with 0.2 m to each side."""
    return 0.2 * math.cos(seconds)


class Drive:
    """A vehicle on a road that is straight, unless it has a curvature, as a tracker reports it to a calibrator."""

    def __init__(self, calibrator: Calibrator, seed: int = 7) -> None:
        self.calibrator = calibrator
        self.events: list[CalibrationChanged] = []
        self._rng = np.random.default_rng(seed)
        self._frame = 0
        self._noise = np.zeros(2)

    def go(
        self,
        seconds: float,
        *,
        pitch: float = 2.0,
        yaw: float = -1.5,
        sideways: Sideways = weave,
        curvature: float = 0.0,
        speed: float = SPEED,
        known: bool = False,
        sigma: float = 1.0,
    ) -> Calibration:
        """Drives on; a `known` speed is reported. Returns the result after that."""
        for _ in range(round(seconds * FPS)):
            now = self._frame / FPS
            # A vehicle that moves to the right of the road sees the road turned to the left.
            heading = math.atan2(sideways(now), speed)
            rotation = camera_from_vehicle(math.radians(pitch), math.radians(yaw), math.radians(CAMERA.roll))
            x, y, z = rotation @ (math.cos(heading), math.sin(heading), 0.0)
            # Errors of a tracker are correlated: here for half a second.
            self._noise += 0.08 * (self._rng.normal(0.0, (12.0, 6.0)) - self._noise)
            column, row = LENS.pixels(np.array([x / z, y / z])) + self._noise
            road = RoadEstimate(
                Estimate(float(column), sigma),
                Estimate(curvature * LENS.fx**2 * HEIGHT_M / 2.0, 1.0),
                Estimate(sideways(now) / HEIGHT_M, 0.05),
            )
            event = self.calibrator.update(road, float(row), LENS, now, speed if known else None)
            self.events += [] if event is None else [event]
            self._frame += 1
        return self.calibrator.result


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("known", [False, True])
def test_twenty_seconds_of_keeping_a_lane_are_enough(seed: int, known: bool) -> None:
    drive = Drive(Calibrator(CAMERA), seed)
    assert not drive.go(15.0, known=known).settled
    result = drive.go(5.0, known=known)
    assert result.settled
    assert result.pitch.value == pytest.approx(2.0, abs=0.3)
    assert result.yaw.value == pytest.approx(-1.5, abs=0.3)
    assert 0.0 < result.yaw.sigma < 0.3
    assert drive.calibrator.yaw == result.yaw
    assert drive.events == []


def test_before_it_settles_meters_use_no_yaw() -> None:
    drive = Drive(Calibrator(CAMERA))
    drive.go(10.0)
    assert drive.calibrator.yaw == Estimate(0.0, 0.0)
    assert drive.calibrator.result.yaw.value == pytest.approx(-1.5, abs=0.6), "it is reported, but not used"


def test_what_is_configured_is_not_estimated() -> None:
    drive = Drive(Calibrator(replace(CAMERA, yaw=1.0)))
    result = drive.go(20.0)
    assert result.yaw == drive.calibrator.yaw == Estimate(1.0, 0.0)
    assert result.pitch.value == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize(
    "unusable",
    [
        {"speed": 6.0, "known": True},
        {"curvature": 1.0 / 200.0},
        {"curvature": -1.0 / 500.0, "speed": 30.0, "known": True},
        {"sideways": lambda _: 1.0},
        {"sigma": 30.0},
    ],
    ids=["slow", "curve", "fast in a wide curve", "lane change", "uncertain"],
)
def test_frames_that_say_nothing_do_not_count(unusable: dict[str, object]) -> None:
    drive = Drive(Calibrator(CAMERA))
    drive.go(30.0, **unusable)  # type: ignore[arg-type]
    assert drive.calibrator.state == CalibrationState()


def test_a_slow_drift_is_compensated_if_the_speed_is_known() -> None:
    drive = Drive(Calibrator(CAMERA))
    assert drive.go(20.0, sideways=lambda _: 0.3, speed=10.0, known=True).yaw.value == pytest.approx(-1.5, abs=0.3)


def test_a_mount_that_moved_is_an_event_and_estimated_afresh() -> None:
    drive = Drive(Calibrator(CAMERA))
    drive.go(60.0)
    result = drive.go(9.0, yaw=3.0, pitch=1.0)
    assert not result.settled
    (event,) = drive.events
    assert 60.0 < event.timestamp < 70.0
    assert (event.pitch, event.yaw) == pytest.approx((1.0, 3.0), abs=0.5)
    assert drive.calibrator.yaw.value == pytest.approx(3.0, abs=0.5), "the new direction is better than the old one"
    assert drive.go(12.0, yaw=3.0, pitch=1.0).settled
    assert len(drive.events) == 1


def test_one_bad_block_changes_nothing() -> None:
    drive = Drive(Calibrator(CAMERA))
    drive.go(40.0)
    drive.go(4.0, yaw=6.0)
    result = drive.go(40.0)
    assert drive.events == []
    assert result.yaw.value == pytest.approx(-1.5, abs=0.3)


def test_its_state_is_small_and_complete() -> None:
    drive = Drive(Calibrator(CAMERA))
    drive.go(300.0)
    state = drive.calibrator.state
    assert state.used == 50 * 100, "the 50 newest blocks are kept"
    assert len(state.blocks) < 300
    state.validate()
    restored = Calibrator(CAMERA, state)
    assert restored.result == drive.calibrator.result
    assert restored.yaw == drive.calibrator.yaw


@pytest.mark.parametrize(
    ("state", "problem"),
    [
        (CalibrationState("!"), "not valid base 64"),
        (CalibrationState(b64encode(bytes(6)).decode()), "6 bytes"),
        (CalibrationState(b64encode(bytes(204)).decode()), "204 bytes"),
        (CalibrationState(frames=100), "calibration frames is 100"),
        (CalibrationState(frames=-1), "calibration frames is -1"),
        (CalibrationState(frames=2, pitch_sum=200.0), "calibration pitch_sum is 200.0"),
        (CalibrationState(frames=2, yaw_sum=math.nan), "calibration yaw_sum is nan"),
    ],
)
def test_a_hostile_state_is_refused(state: CalibrationState, problem: str) -> None:
    with pytest.raises(ValueError, match=problem) as caught:
        state.validate()
    assert "\n" not in str(caught.value)


def test_hostile_blocks_that_are_valid_are_survived() -> None:
    extreme = b64encode(np.array([[32767, -32768]] * 50, "<i2").tobytes()).decode()
    state = CalibrationState(extreme, 99, 99 * 90.0, -99 * 90.0, known=True)
    state.validate()
    drive = Drive(Calibrator(CAMERA, state))
    drive.go(20.0)
    assert math.isfinite(drive.calibrator.result.yaw.value)
