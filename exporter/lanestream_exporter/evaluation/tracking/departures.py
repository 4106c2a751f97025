"""Departure warnings against the true distance of the wheels from the lines.

UN R130 asks for a warning at the latest when the outer edge of the wheel is 0.3 m beyond the line, for a sideways speed
of 0.1 to 0.8 m/s; ISO 17361 allows none while the vehicle stays inside its zone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lanestream_exporter.evaluation.tracking.comparison import ClipRun, FrameComparison, rate, rounded

# The width of the vehicle between the outer edges of its wheels, which is the default of the service.
VEHICLE_WIDTH: Final = 1.8
# A warning is too late when the wheel is this far beyond the line, and false if it stays as far inside.
_MARGIN: Final = 0.3
# A warning belongs to a crossing that begins at most this many seconds later.
_AHEAD_S: Final = 4.0
_SIDES: Final = {"left": 1.0, "right": -1.0}


def departure_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures of departure warnings; see docs/evaluation.md. Without the field all crossings are missed."""
    crossings = [crossing for run in runs for side in _SIDES for crossing in _crossings(run, side)]
    leads = [crossing.lead_s for crossing in crossings if crossing.lead_s is not None]
    warnings = [is_false for run in runs for side in _SIDES for is_false in _warnings(run, side)]
    minutes = sum(run.seconds for run in runs) / 60.0
    return {
        "crossings": len(crossings),
        "warned": len(leads),
        "missed": len(crossings) - len(leads),
        "warned_share": rate(len(leads), len(crossings)),
        "median_lead_s": rounded(float(np.median(leads))) if leads else None,
        "least_lead_s": rounded(min(leads)) if leads else None,
        "warnings": len(warnings),
        "false_warnings": sum(warnings),
        "false_warnings_per_minute": rate(sum(warnings), minutes),
    }


@dataclass(frozen=True)
class _Crossing:
    """A wheel that crosses a line; `lead_s` is how long before it the warning came, None if it came too late."""

    lead_s: float | None


def beyond(frame: FrameComparison, side: str) -> float | None:
    """Returns how far the wheel is beyond the line of a side in meters, negative inside the lane; None if unknown."""
    ego = frame.truth.ego
    if ego.offset is None or ego.lane_width is None:
        return None
    return 0.5 * VEHICLE_WIDTH - (0.5 * ego.lane_width + _SIDES[side] * ego.offset)


def _crossings(run: ClipRun, side: str) -> Iterator[_Crossing]:
    inside = False
    for index, frame in enumerate(run.frames):
        distance = beyond(frame, side)
        # A wheel that is far beyond a line at once is that of a vehicle whose middle has crossed into another lane.
        if distance is not None and 0.0 < distance <= _MARGIN and inside:
            yield _crossing(run, side, index)
        inside = distance is not None and distance <= 0.0


def _crossing(run: ClipRun, side: str, index: int) -> _Crossing:
    """Returns the crossing that begins with the frame `index`."""
    crossed = run.frames[index].truth.timestamp
    last = index
    while last + 1 < len(run.frames):
        distance = beyond(run.frames[last + 1], side)
        if distance is None or not 0.0 < distance <= _MARGIN:
            break
        last += 1
    warned = [
        frame.truth.timestamp for frame in run.frames[: last + 1]
        if _warns(frame, side) and frame.truth.timestamp >= crossed - _AHEAD_S
    ]  # fmt: skip
    return _Crossing(crossed - warned[0] if warned else None)


def _warnings(run: ClipRun, side: str) -> Iterator[bool]:
    """Yields for each warning whether the wheel stays well inside during the time that the warning is about."""
    warned = False
    for index, frame in enumerate(run.frames):
        warns = _warns(frame, side)
        if warns and not warned:
            until = frame.truth.timestamp + _AHEAD_S
            ahead = [
                distance
                for each in run.frames[index:]
                if each.truth.timestamp <= until and (distance := beyond(each, side)) is not None
            ]
            yield max(ahead, default=0.0) < -_MARGIN
        warned = warns


def _warns(frame: FrameComparison, side: str) -> bool:
    departure = frame.answer.departure
    return departure is not None and departure[0] != "none" and departure[1] == side
