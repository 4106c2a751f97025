"""Tracks that follow nothing, what is left of the old scene after a cut, and jumps of tracks.

Rendered truth is complete: a track without a true marking near it follows nothing, even if it is on an edge of the
road. Tracks that are reported as edges are not counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from lanestream_exporter.evaluation.tracking.comparison import (
    BOTTOM,
    FAR,
    GATE,
    ClipRun,
    FrameComparison,
    consecutive,
    rate,
    rounded,
)

# A jump is a change from one frame to the next of more than this share of the lane that is not in the truth.
_JUMP: Final = 0.1
# Frames after a cut in which boundaries that follow nothing count as left over from the old scene, in seconds.
_AFTER_CUT_S: Final = 1.0


def ghost_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures of tracks that follow nothing; see docs/evaluation.md."""
    tracks = ghosts = ghost_frames = 0
    for run in runs:
        seen, lost = _track_frames(run)
        tracks += len(seen)
        ghosts += sum(2 * lost[track_id] > seen[track_id] for track_id in seen)
        ghost_frames += sum(lost.values())
    minutes = sum(run.seconds for run in runs) / 60.0
    return {
        "tracks": tracks,
        "ghosts": ghosts,
        "minutes": rounded(minutes),
        "ghosts_per_minute": rate(ghosts, minutes),
        "ghost_frames": ghost_frames,
    }


def cut_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures of cuts to another scene; see docs/evaluation.md."""
    cuts = [(run, index) for run in runs for index in _cuts(run)]
    old = [old_id_frames(run, index) for run, index in cuts]
    ghosts = [ghost_frames_after(run, index) for run, index in cuts]
    waits = [frames_to_ego(run, index) for run, index in cuts]
    known = [wait for wait in waits if wait is not None]
    reported = {(run.name, run.kind, index) for run in runs for index, f in enumerate(run.frames) if f.answer.cut}
    true = {(run.name, run.kind, index + late) for run, index in cuts for late in (0, 1, 2)}
    return {
        "cuts": len(cuts),
        "old_id_boundaries": sum(old),
        "ghost_boundaries": sum(ghosts),
        "found_ego": len(known),
        "median_frames_to_ego": float(np.median(known)) if known else None,
        "most_frames_to_ego": max(known) if known else None,
        "events": len(reported),
        "false_events": len(reported - true),
    }


def jump_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures of jumps at the bottom row and at 0.3 of the rows; see docs/evaluation.md."""
    moves = np.array([move for run in runs for move in _moves(run)]).reshape(-1, 2)
    figures = {}
    for column, name in enumerate(("bottom", "far")):
        values = moves[~np.isnan(moves[:, column]), column]
        jumps = int((np.abs(values) > _JUMP).sum())
        figures[name] = {"steps": len(values), "jumps": jumps, "jump_share": rate(jumps, len(values))}
    return figures


def is_ghost(frame: FrameComparison, index: int) -> bool:
    """Whether the answer `index` of a frame is a marking without a true one within the gate."""
    is_marking = frame.answer.lanes[index].kind == "marking"
    return is_marking and not bool((frame.distances[:, index] <= GATE).any())


def old_id_frames(run: ClipRun, cut: int) -> int:
    """Returns how many boundaries are reported after a cut under an id from before it."""
    before = {lane.track_id for frame in run.frames[:cut] for lane in frame.answer.lanes}
    return sum(lane.track_id in before for frame in _scene_from(run, cut) for lane in frame.answer.lanes)


def ghost_frames_after(run: ClipRun, cut: int) -> int:
    """Returns how many boundaries that follow nothing are reported in the first second after a cut."""
    start = run.frames[cut].truth.timestamp
    return sum(
        is_ghost(frame, index)
        for frame in _scene_from(run, cut)
        if frame.truth.timestamp - start < _AFTER_CUT_S
        for index in range(len(frame.answer.lanes))
    )


def frames_to_ego(run: ClipRun, cut: int) -> int | None:
    """Returns the frames from a cut until all true ego boundaries are followed under new ids; None if never."""
    before = {lane.track_id for frame in run.frames[:cut] for lane in frame.answer.lanes}
    for waited, frame in enumerate(_scene_from(run, cut)):
        ego = [index for index, lane in enumerate(frame.truth.lanes) if abs(lane.position) == 1]
        found = [frame.answer.lanes[frame.pairs[index]].track_id for index in ego if index in frame.pairs]
        if ego and len(found) == len(ego) and not before.intersection(found):
            return waited
    return None


def _scene_from(run: ClipRun, cut: int) -> Iterator[FrameComparison]:
    scene = run.frames[cut].truth.scene
    return (frame for frame in run.frames[cut:] if frame.truth.scene == scene)


def _cuts(run: ClipRun) -> list[int]:
    scenes = [frame.truth.scene for frame in run.frames]
    return [index for index in range(1, len(scenes)) if scenes[index] != scenes[index - 1]]


def _track_frames(run: ClipRun) -> tuple[Counter[int], Counter[int]]:
    """Returns by track id in how many frames it is reported, and in how many of them it follows nothing."""
    seen: Counter[int] = Counter()
    lost: Counter[int] = Counter()
    for frame in run.frames:
        for index, lane in enumerate(frame.answer.lanes):
            seen[lane.track_id] += 1
            lost[lane.track_id] += is_ghost(frame, index)
    return seen, lost


def _moves(run: ClipRun) -> Iterator[tuple[float, float]]:
    """Yields the motion of each track from frame to frame that is not in the truth, in lane widths at both rows."""
    for before, after in consecutive(run):
        at = {lane.track_id: index for index, lane in enumerate(before.answer.lanes)}
        true_at = {lane.lane_id: index for index, lane in enumerate(before.truth.lanes)}
        for truth_index, index in after.pairs.items():
            old = at.get(after.answer.lanes[index].track_id)
            old_truth = true_at.get(after.truth.lanes[truth_index].lane_id)
            if old is None or old_truth is None:
                continue
            rows = [BOTTOM, FAR]
            moved = after.x[index, rows] - before.x[old, rows]
            true_moved = after.true_x[truth_index, rows] - before.true_x[old_truth, rows]
            bottom, far = (moved - true_moved) / after.lane_px[rows]
            yield float(bottom), float(far)
