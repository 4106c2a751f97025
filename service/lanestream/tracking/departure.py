"""Lane departure: warns before a wheel crosses a boundary of the ego lane, and reports when it has crossed.

The margin of a side is the distance of its wheels from its boundary, positive inside the lane. With the lateral speed
towards that boundary, margin / speed is the time to line crossing. A warning is raised once the wheels are surely less
than 0.3 m inside and surely beyond the line within `warning_s`, given the uncertainty of both. So it comes before the
line in a fast drift, at most 0.25 m beyond it in a very slow one, and not for a vehicle that weaves inside its lane.
ISO 17361 requires that warnings are repeatable and that none comes while the vehicle stays in its zone; UN Regulation
130 requires them before the wheel is 0.3 m beyond the line, for lateral speeds of 0.1 to 0.8 m/s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from lanestream.road.results import Departure, DepartureEvent, EgoMeters, Estimate, Side
from lanestream.tracking.state import MAX_COUNT, check_range

# "Sure" is this many sigmas, but at most so many meters: poor estimates delay a warning, they must not prevent it.
_SURE: Final = 2.5
_MOST_DOUBT_M: Final = 0.25
# No warning comes while the wheels may be this far inside the line: the vehicle keeps its lane.
_ZONE_M: Final = 0.3
# A departure ends once the wheels are surely this far inside the line, and not about to leave the zone.
_INSIDE_M: Final = 0.1
# Longer times to line crossing are mostly noise of the lateral speed.
_LONGEST_S: Final = 10.0
# The limits of a saved state's distances in meters.
_FARTHEST_M: Final = 1e6

_SIDES: Final[tuple[Side, Side]] = ("left", "right")

Indicator = Literal["off", "left", "right"]


@dataclass(frozen=True)
class VehicleMotion:
    """What the vehicle reports with a frame: its `speed` in m/s and its direction `indicator`; None if unknown."""

    speed: float | None = None
    indicator: Indicator | None = None


UNKNOWN_MOTION: Final = VehicleMotion()


@dataclass(frozen=True)
class DepartureSettings:
    """When to warn: `vehicle_width` in meters over the outer wheel edges, `warning_s` seconds before a line is crossed.

    No warning comes below the speed `least_speed` in m/s, if the vehicle reports its speed. UN Regulation 130 requires
    them above 60 km/h, which is 16.7 m/s.
    """

    vehicle_width: float = 1.8
    warning_s: float = 1.0
    least_speed: float = 15.0


@dataclass(frozen=True)
class SideState:
    """One side of the vehicle in the last frame. The margin is in meters, positive while the wheels are inside.

    A side that is `armed` can warn: its wheels have surely been inside since its boundary took that role, and nothing
    has suppressed it since. The margin may be `doubt` more or less; `outlook` is the most that it may be after
    `warning_s`. `crossed_at` is when the wheels crossed the line; None while they are inside.
    """

    track_id: int | None = None
    armed: bool = False
    margin: float = 0.0
    doubt: float = 0.0
    outlook: float = 0.0
    crossed_at: float | None = None

    @property
    def slack(self) -> float:
        """How far the side is from a warning in meters: it is due once this is negative."""
        return max(self.margin + self.doubt - _ZONE_M, self.outlook)

    @property
    def is_calm(self) -> bool:
        """Whether the wheels are well inside and expected to stay there."""
        return self.margin - self.doubt > _INSIDE_M and self.outlook > _ZONE_M

    def validate(self) -> None:
        """Raises ValueError if no side can have this state."""
        check_range("departure track_id", self.track_id, 1, MAX_COUNT)
        check_range("departure margin", self.margin, -_FARTHEST_M, _FARTHEST_M)
        check_range("departure doubt", self.doubt, 0.0, _MOST_DOUBT_M)
        check_range("departure outlook", self.outlook, -_FARTHEST_M, _FARTHEST_M)
        check_range("departure crossed_at", self.crossed_at, -MAX_COUNT, MAX_COUNT)


@dataclass(frozen=True)
class DepartureState:
    """The state of a monitor: the departure in progress, both sides, and the timestamp of the last frame."""

    state: Literal["none", "warning", "crossed"] = "none"
    side: Side | None = None
    left: SideState = field(default_factory=SideState)
    right: SideState = field(default_factory=SideState)
    timestamp: float = 0.0

    def of(self, side: Side) -> SideState:
        """Returns the state of a side."""
        return self.left if side == "left" else self.right

    def validate(self) -> None:
        """Checks a state from outside this process. Raises ValueError, on one line, if no monitor can have it."""
        if (self.state == "none") != (self.side is None):
            raise ValueError("a departure has a side exactly if it is a warning or a crossing")
        check_range("departure timestamp", self.timestamp, -MAX_COUNT, MAX_COUNT)
        self.left.validate()
        self.right.validate()


class DepartureMonitor:
    """Watches whether the vehicle leaves its lane. `state` is its complete state, a small value."""

    def __init__(self, settings: DepartureSettings | None = None, state: DepartureState | None = None) -> None:
        self._settings = settings or DepartureSettings()
        self.state = state or DepartureState()

    def update(
        self, meters: EgoMeters, left_id: int | None, right_id: int | None, timestamp: float, motion: VehicleMotion
    ) -> tuple[Departure, tuple[DepartureEvent, ...]]:
        """Returns whether the vehicle departs in the frame at `timestamp` seconds, and the events since the last frame.

        `left_id` and `right_id` are the track ids of the ego lane's boundaries. The times of events are interpolated;
        that of a crossing may lie some frames back, because it is reported once it is sure.
        """
        before = self.state
        left_became_right = right_id is not None and right_id == before.left.track_id
        right_became_left = left_id is not None and left_id == before.right.track_id
        if left_became_right or right_became_left:
            # The vehicle is in another lane, so the departure is over.
            before = DepartureState(timestamp=before.timestamp)
        speed = meters.lateral_speed
        to_left = None if speed is None else Estimate(-speed.value, speed.sigma)
        left = self._side("left", before, left_id, meters.left, to_left, timestamp, motion)
        right = self._side("right", before, right_id, meters.right, speed, timestamp, motion)
        self.state = replace(before, left=left, right=right, timestamp=timestamp)
        events = self._transitions(before)
        return self._departure(meters), events

    def _side(
        self,
        name: Side,
        before: DepartureState,
        track_id: int | None,
        distance: Estimate | None,
        towards: Estimate | None,
        timestamp: float,
        motion: VehicleMotion,
    ) -> SideState:
        """Returns a side's state from the `distance` of its boundary and the speed `towards` it."""
        if track_id is None or distance is None:
            return SideState()
        last = before.of(name) if before.of(name).track_id == track_id else None
        margin, doubt = distance.value - self._settings.vehicle_width / 2.0, _doubt(distance.sigma)
        ahead_s = self._settings.warning_s
        if towards is None:
            outlook = margin + doubt
        else:
            outlook = margin - ahead_s * towards.value + _doubt(math.hypot(distance.sigma, ahead_s * towards.sigma))
        crossed_at = None
        if margin <= 0.0 and last is not None:
            crossed_at = last.crossed_at
            if crossed_at is None:
                crossed_at = _zero(before.timestamp, last.margin, timestamp, margin)
        return SideState(
            track_id,
            armed=not self._is_suppressed(name, motion) and (margin > doubt or (last is not None and last.armed)),
            margin=margin,
            doubt=doubt,
            outlook=outlook,
            crossed_at=crossed_at,
        )

    def _is_suppressed(self, side: Side, motion: VehicleMotion) -> bool:
        too_slow = motion.speed is not None and motion.speed < self._settings.least_speed
        return too_slow or motion.indicator == side

    def _transitions(self, before: DepartureState) -> tuple[DepartureEvent, ...]:
        """Updates the departure in progress from the sides' states; returns the events of that."""
        now = self.state
        if now.side is not None and (not now.of(now.side).armed or now.of(now.side).is_calm):
            now = replace(now, state="none", side=None)
        events: list[DepartureEvent] = []
        # Of two sides, the one that is worse off comes first.
        for name in sorted(_SIDES, key=lambda side: now.of(side).slack):
            side, last = now.of(name), before.of(name)
            if not side.armed or side.track_id is None:
                continue
            if side.margin + side.doubt < 0.0 and (now.state, now.side) != ("crossed", name):
                at = now.timestamp if side.crossed_at is None else side.crossed_at
                now = replace(now, state="crossed", side=name)
                events.append(DepartureEvent("crossed", name, side.track_id, at))
            elif side.slack < 0.0 and now.state == "none":
                same = last.track_id == side.track_id
                at = _zero(before.timestamp, last.slack, now.timestamp, side.slack) if same else now.timestamp
                now = replace(now, state="warning", side=name)
                events.append(DepartureEvent("warning", name, side.track_id, at))
        self.state = now
        return tuple(events)

    def _departure(self, meters: EgoMeters) -> Departure:
        now, speed = self.state, meters.lateral_speed
        if now.side is not None and now.of(now.side).margin <= 0.0:
            return Departure(now.state, now.side, 0.0)
        approached: Side = "left" if speed is not None and speed.value < 0.0 else "right"
        wheels = now.of(approached)
        if speed is None or now.side not in (None, approached) or wheels.track_id is None or wheels.margin <= 0.0:
            return Departure(now.state, now.side)
        slowest = wheels.margin / _LONGEST_S
        return Departure(now.state, now.side, wheels.margin / abs(speed.value) if abs(speed.value) > slowest else None)


def _doubt(sigma: float) -> float:
    """Returns how much more than its estimate a distance may be."""
    return min(_SURE * sigma, _MOST_DOUBT_M)


def _zero(before_s: float, before: float, now_s: float, now: float) -> float:
    """Returns when a value that changed from `before` to `now` reached zero, in seconds."""
    if before <= 0.0 or now >= 0.0:
        return now_s
    return before_s + (now_s - before_s) * before / (before - now)
