"""Lane changes: when the boundary that is crossed gets its new role, and the events that report the crossing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lanestream_exporter.evaluation.tracking.answers import AnsweredLaneChange
from lanestream_exporter.evaluation.tracking.comparison import ClipRun, FrameComparison, rate, rounded
from lanestream_exporter.evaluation.tracking.truth import TrueLaneChange

# A role is on time within this many seconds of the crossing, and an event within the second number.
_ROLE_S: Final = 0.12
_EVENT_S: Final = 0.1
# A crossing is looked for this many seconds around the true one.
_WINDOW_S: Final = 2.0


def role_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures of ego roles at the crossings of clips; see docs/evaluation.md."""
    delays = [delay for run in runs for change in true_changes(run) if (delay := role_delay(run, change)) is not None]
    crossings = sum(1 for run in runs for _ in true_changes(run))
    seconds = [delay.seconds for delay in delays]
    on_time = sum(abs(delay.seconds) <= _ROLE_S for delay in delays)
    return {
        "crossings": crossings,
        "changed": len(delays),
        "on_time": on_time,
        "on_time_share": rate(on_time, crossings),
        "median_delay_s": rounded(float(np.median(seconds))) if seconds else None,
        "median_delay_frames": float(np.median([delay.frames for delay in delays])) if delays else None,
        "most_delay_s": rounded(max(seconds)) if seconds else None,
        "least_delay_s": rounded(min(seconds)) if seconds else None,
    }


def event_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures of `lane_change` events of clips; see docs/evaluation.md."""
    errors: list[float] = []
    crossings = events = 0
    for run in runs:
        changes, reported = list(true_changes(run)), _reported(run)
        crossings, events = crossings + len(changes), events + len(reported)
        errors += _time_errors(changes, reported)
    right = sum(abs(error) <= _EVENT_S for error in errors)
    return {
        "crossings": crossings,
        "events": events,
        "right": right,
        "late": len(errors) - right,
        "missed": crossings - len(errors),
        "false": events - len(errors),
        "right_share": rate(right, crossings),
        "median_time_error_s": rounded(float(np.median(errors))) if errors else None,
        "most_time_error_s": rounded(max(errors, key=abs)) if errors else None,
    }


@dataclass(frozen=True)
class RoleDelay:
    """The time from a crossing to the new role, negative if the role came first, and the frames in between."""

    seconds: float
    frames: int


def true_changes(run: ClipRun) -> Iterator[TrueLaneChange]:
    """Yields the true lane changes of a clip."""
    return (change for frame in run.frames for change in frame.truth.lane_changes)


def role_delay(run: ClipRun, change: TrueLaneChange) -> RoleDelay | None:
    """Returns when the boundary that is crossed gets its new role; None if it does not within two seconds.

    A boundary that is crossed to the left was ego left (-1) and becomes ego right (+1). If the role comes before the
    crossing, or goes back and forth around it, the delay is that of the wrong role farthest from the crossing.
    """
    old, new = (-1, 1) if change.direction == "left" else (1, -1)
    scene = _scene_of(run, change)
    near = [
        (frame.truth.timestamp - change.timestamp, _role(frame, change.lane_id))
        for frame in run.frames
        if abs(frame.truth.timestamp - change.timestamp) <= _WINDOW_S and frame.truth.scene == scene
    ]
    after = [(seconds, role) for seconds, role in near if seconds >= 0.0]
    if new not in [role for _, role in after]:
        return None
    early = [seconds for seconds, role in near if seconds < 0.0 and role == new]
    wrong = [index for index, (_, role) in enumerate(after) if role == old]
    late = wrong[-1] + 1 if wrong else next(index for index, (_, role) in enumerate(after) if role == new)
    if late == len(after):
        return None
    if early and -early[0] > after[late][0]:
        return RoleDelay(early[0], -len(early))
    return RoleDelay(after[late][0] if late else 0.0, late)


def _scene_of(run: ClipRun, change: TrueLaneChange) -> int | None:
    return next((frame.truth.scene for frame in run.frames if change in frame.truth.lane_changes), None)


def _role(frame: FrameComparison, lane_id: int) -> int | None:
    lane = frame.followed_by(lane_id)
    return None if lane is None else lane.position


def _reported(run: ClipRun) -> list[AnsweredLaneChange]:
    return [change for frame in run.frames for change in frame.answer.lane_changes]


def _time_errors(changes: Sequence[TrueLaneChange], reported: Sequence[AnsweredLaneChange]) -> list[float]:
    """Returns the time errors of the reported changes that match a true one, nearest first, each used once."""
    candidates = sorted(
        (abs(event.timestamp - change.timestamp), i, j)
        for i, change in enumerate(changes)
        for j, event in enumerate(reported)
        if event.direction == change.direction and abs(event.timestamp - change.timestamp) <= _WINDOW_S
    )
    used_changes: set[int] = set()
    used_events: set[int] = set()
    errors = []
    for _, i, j in candidates:
        if i not in used_changes and j not in used_events:
            used_changes.add(i)
            used_events.add(j)
            errors.append(reported[j].timestamp - changes[i].timestamp)
    return errors
