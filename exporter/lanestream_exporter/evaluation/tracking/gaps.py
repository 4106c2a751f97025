"""Hidden boundaries: identity and error by the length of a gap."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lanestream_exporter.evaluation.tracking.comparison import ClipRun, rate, rounded

# The lengths of gaps, in frames, that figures are given for, each with its error limit in lane widths.
LENGTHS: Final = {1: 0.05, 3: 0.05, 5: 0.05, 10: 0.05, 20: 0.1, 30: 0.1, 45: 0.1}
# A boundary counts as followed before a gap if it is in one of this many frames before it.
_BEFORE: Final = 3
# After a gap the boundary has this many frames to be found again.
_AFTER: Final = 25


@dataclass(frozen=True)
class Gap:
    """A gap of a boundary that was followed before it: its length, the errors in lane widths, and the identity.

    `errors` has one value per hidden frame, None where the boundary was not followed by its old track. `same_id` is
    whether the track that next follows the boundary after the gap is the old one.
    """

    length: int
    errors: tuple[float | None, ...]
    same_id: bool


def gap_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures by the length of the gap; see docs/evaluation.md."""
    gaps = [gap for run in runs for gap in find_gaps(run)]
    return {str(length): _figures([gap for gap in gaps if gap.length == length]) for length in LENGTHS}


def _figures(gaps: Sequence[Gap]) -> dict[str, Any]:
    ends = [gap.errors[-1] for gap in gaps]
    held = [end for end in ends if end is not None]
    same = sum(gap.same_id for gap in gaps)
    limit = LENGTHS[gaps[0].length] if gaps else None
    small = 0 if limit is None else sum(end < limit for end in held)
    return {
        "gaps": len(gaps),
        "same_id": same,
        "same_id_share": rate(same, len(gaps)),
        "held_to_end": len(held),
        "small_errors": small,
        "small_error_share": rate(small, len(gaps)),
        "error_limit": limit,
        "median_end_error": rounded(float(np.median(held))) if held else None,
        "p90_end_error": rounded(float(np.percentile(held, 90))) if held else None,
        "most_end_error": rounded(max(held)) if held else None,
    }


def find_gaps(run: ClipRun) -> Iterator[Gap]:
    """Yields the gaps in a clip, of those boundaries that were followed before them."""
    ids = dict.fromkeys(lane.lane_id for frame in run.frames for lane in frame.truth.lanes)
    for lane_id in ids:
        hidden = [_gap_length(run, index, lane_id) for index in range(len(run.frames))]
        start = 0
        while start < len(hidden):
            if not hidden[start]:
                start += 1
                continue
            end = start
            while end < len(hidden) and hidden[end]:
                end += 1
            gap = _gap(run, lane_id, start, end)
            if gap is not None:
                yield gap
            start = end


def _gap(run: ClipRun, lane_id: int, start: int, end: int) -> Gap | None:
    before = [_follower(run, index, lane_id) for index in range(max(0, start - _BEFORE), start)]
    known = [found for found in before if found is not None]
    if not known or end == len(run.frames):
        return None
    track_id = known[-1][0]
    errors = []
    for index in range(start, end):
        found = _follower(run, index, lane_id)
        errors.append(found[1] if found is not None and found[0] == track_id else None)
    after = (_follower(run, index, lane_id) for index in range(end, min(end + _AFTER, len(run.frames))))
    next_found = next((found for found in after if found is not None), None)
    return Gap(end - start, tuple(errors), next_found is not None and next_found[0] == track_id)


def _gap_length(run: ClipRun, index: int, lane_id: int) -> int:
    return next((lane.gap_length for lane in run.frames[index].truth.lanes if lane.lane_id == lane_id), 0)


def _follower(run: ClipRun, index: int, lane_id: int) -> tuple[int, float] | None:
    """Returns the track that follows a boundary in a frame, and its mean distance in lane widths."""
    frame = run.frames[index]
    for truth_index, found in frame.pairs.items():
        if frame.truth.lanes[truth_index].lane_id == lane_id:
            return frame.answer.lanes[found].track_id, float(frame.distances[truth_index, found])
    return None
