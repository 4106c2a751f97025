"""The motion of our vehicle: sway, moves to the side, drifts, and the pitch of its suspension."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

LANE_CHANGE_TIME = 4.0  # usual duration of a lane change, seconds

_STEP: Final = 0.01  # of the derivatives, seconds
_BUMP_TIME: Final = 0.3  # seconds
_DRIFT_RAMP: Final = 0.6  # longest time in which a drift reaches its speed, seconds


@dataclass(frozen=True)
class SidewaysMove:
    """A smooth move to the side, for example to another lane."""

    start: float  # seconds
    shift: float  # meters to the left
    duration: float = LANE_CHANGE_TIME  # seconds

    def shift_at(self, time: float) -> float:
        """Returns the shift to the left at `time` seconds, meters; it starts and ends at zero lateral speed."""
        share = min(1.0, max(0.0, (time - self.start) / self.duration))
        return self.shift * share**3 * (10.0 + share * (6.0 * share - 15.0))


@dataclass(frozen=True)
class Drift:
    """A slow move to the side at a constant lateral speed, as of a driver who doesn't pay attention."""

    start: float  # seconds
    shift: float  # meters to the left
    speed: float  # meters per second, positive

    @property
    def duration(self) -> float:
        """Returns the time in seconds from the start to the end of the drift."""
        return abs(self.shift) / self.speed + self._ramp

    @property
    def _ramp(self) -> float:
        return min(_DRIFT_RAMP, 0.8 * abs(self.shift) / self.speed)

    def shift_at(self, time: float) -> float:
        """Returns the shift to the left at `time` seconds, meters."""
        elapsed, ramp = min(self.duration, max(0.0, time - self.start)), self._ramp
        begun = min(elapsed, ramp)
        ending = max(0.0, elapsed - (self.duration - ramp))
        distance = begun**2 / (2.0 * ramp) + max(0.0, elapsed - ramp) - ending**2 / (2.0 * ramp)
        return math.copysign(self.speed * distance, self.shift)


@dataclass(frozen=True)
class PitchBump:
    """A bump in the road: the camera pitches and returns within 0.3 s."""

    start: float  # seconds
    pitch: float  # radians, positive if the horizon moves down in the image

    def pitch_at(self, time: float) -> float:
        """Returns the pitch at `time` seconds, radians."""
        share = (time - self.start) / _BUMP_TIME
        return self.pitch * math.sin(math.pi * share) ** 2 if 0.0 < share < 1.0 else 0.0


@dataclass(frozen=True)
class VehicleMotion:
    """The motion of our vehicle along the road."""

    speed: float  # meters per second
    sway: float  # amplitude of the lateral sway, meters
    sway_period: float  # seconds
    bounce: float  # amplitude of the pitch, radians
    moves: tuple[SidewaysMove | Drift, ...] = ()
    bumps: tuple[PitchBump, ...] = ()

    def lateral(self, time: float) -> float:
        """Returns the distance to the left of the starting position at `time` seconds, meters."""
        sway = self.sway * math.sin(math.tau * time / self.sway_period)
        return sway + sum(move.shift_at(time) for move in self.moves)

    def lateral_speed(self, time: float) -> float:
        """Returns the speed across the road at `time` seconds, meters per second to the left."""
        return (self.lateral(time + _STEP) - self.lateral(time - _STEP)) / (2.0 * _STEP)

    def heading(self, time: float) -> float:
        """Returns the direction of travel relative to the road, radians to the left."""
        return math.atan2(self.lateral(time + _STEP) - self.lateral(time - _STEP), 2.0 * _STEP * self.speed)

    def pitch(self, time: float) -> float:
        """Returns the pitch in radians: two oscillations of a car's suspension, and the bumps."""
        bounce = self.bounce * (0.65 * math.sin(math.tau * 1.3 * time) + 0.35 * math.sin(math.tau * 2.9 * time + 1.0))
        return bounce + sum(bump.pitch_at(time) for bump in self.bumps)
