"""Errors of followed boundaries in lane widths, in all frames and around lane changes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.tracking.comparison import FIGURE_ROWS, ClipRun, FrameComparison, rate, rounded
from lanestream_exporter.evaluation.tracking.roles import true_changes
from lanestream_exporter.evaluation.tracking.truth import TrueLaneChange

# An error of more than this share of the lane is large.
_LARGE: Final = 0.1
# A lane change is the time around its crossing.
_CHANGE_S: Final = 3.0


def error_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the errors at each row of figures, and the shares of truth that is followed; see docs/evaluation.md."""
    frames = [frame for run in runs for frame in run.frames]
    return {**_rows(frames), "followed": _followed(frames), "both_ego": _both_ego(frames)}


def lane_change_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the errors within three seconds of a crossing, and how long they take to settle."""
    changes = [(run, change) for run in runs for change in true_changes(run)]
    frames = [frame for run, change in changes for frame in _around(run, change)]
    settled = [settling_time(run, change) for run, change in changes]
    return {
        **_rows(frames),
        "crossings": len(changes),
        "median_settling_s": rounded(float(np.median(settled))) if settled else None,
        "most_settling_s": rounded(max(settled)) if settled else None,
    }


def settling_time(run: ClipRun, change: TrueLaneChange) -> float:
    """Returns the seconds after a crossing until no ego boundary's bottom-row error is large any more."""
    last = 0.0
    for frame in _around(run, change):
        errors = lane_errors(frame)[_is_ego(frame), FIGURE_ROWS["bottom"]]
        if (np.abs(errors) > _LARGE).any():
            last = max(last, frame.truth.timestamp - change.timestamp)
    return last


def lane_errors(frame: FrameComparison) -> FloatArray:
    """Returns the errors (P, R) of a frame's pairs in lane widths."""
    errors: FloatArray = frame.errors() / frame.lane_px
    return errors


def _rows(frames: Sequence[FrameComparison]) -> dict[str, Any]:
    errors = np.concatenate([lane_errors(frame) for frame in frames]) if frames else np.empty((0, 5))
    return {name: _row(errors[:, index]) for name, index in FIGURE_ROWS.items()}


def _row(errors: FloatArray) -> dict[str, Any]:
    values = np.abs(errors[~np.isnan(errors)])
    large = int((values > _LARGE).sum())
    return {
        "values": len(values),
        "large": large,
        "large_share": rate(large, len(values)),
        "rms": rounded(float(np.sqrt(np.mean(values**2)))) if len(values) else None,
        "p95": rounded(float(np.percentile(values, 95))) if len(values) else None,
        "most": rounded(float(values.max())) if len(values) else None,
    }


def _followed(frames: Sequence[FrameComparison]) -> dict[str, Any]:
    """Returns the share of true ego boundaries that are followed, in any role."""
    labeled = [(frame, index) for frame in frames for index in _ego_indices(frame)]
    followed = sum(index in frame.pairs for frame, index in labeled)
    return {"ego_boundaries": len(labeled), "followed": followed, "share": rate(followed, len(labeled))}


def _both_ego(frames: Sequence[FrameComparison]) -> dict[str, Any]:
    """Returns the share of frames, of those with two true ego boundaries, in which both are followed in their role."""
    whole = [frame for frame in frames if len(list(_ego_indices(frame))) == 2]
    both = sum(all(_in_role(frame, index) for index in _ego_indices(frame)) for frame in whole)
    return {"frames": len(whole), "both": both, "share": rate(both, len(whole))}


def _ego_indices(frame: FrameComparison) -> Iterator[int]:
    return (index for index, lane in enumerate(frame.truth.lanes) if abs(lane.position) == 1)


def _in_role(frame: FrameComparison, index: int) -> bool:
    found = frame.pairs.get(index)
    return found is not None and frame.answer.lanes[found].position == frame.truth.lanes[index].position


def _is_ego(frame: FrameComparison) -> list[bool]:
    return [abs(frame.truth.lanes[index].position) == 1 for index in frame.pairs]


def _around(run: ClipRun, change: TrueLaneChange) -> Iterator[FrameComparison]:
    return (frame for frame in run.frames if abs(frame.truth.timestamp - change.timestamp) <= _CHANGE_S)
