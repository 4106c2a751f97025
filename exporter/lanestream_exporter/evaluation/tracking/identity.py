"""Identities: switches of physical boundaries, and the IDF1 and fragmentations of the field.

A switch is counted when the boundary of one true id is next followed under another track id. IDF1 (Ristani et al.,
"Performance measures and a data set for multi-target, multi-camera tracking", 2016) and fragmentations (Bernardin and
Stiefelhagen, "Evaluating multiple object tracking performance: the CLEAR MOT metrics", 2008) are those of motrics,
with the distance in lane widths instead of the overlap of boxes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import motrics
import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.tracking.comparison import GATE, ClipRun, rate

# Similarity 1 is no distance, and this is the distance at the gate.
_THRESHOLD: Final = 0.5


def identity_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the identity figures of clips; see docs/evaluation.md."""
    switches = [is_ego for run in runs for is_ego in id_switches(run)]
    idtp = idfp = idfn = fragmentations = boundaries = 0
    for run in runs:
        gt = [[lane.lane_id for lane in frame.truth.lanes] for frame in run.frames]
        found = [[lane.track_id for lane in frame.answer.lanes] for frame in run.frames]
        similarity = [_similarity(frame.distances) for frame in run.frames]
        identity = motrics.compute_identity_from_similarity(gt, found, similarity, _THRESHOLD)
        clear = motrics.compute_clear_from_similarity(gt, found, similarity, _THRESHOLD)
        idtp, idfp, idfn = idtp + identity.idtp, idfp + identity.idfp, idfn + identity.idfn
        fragmentations += clear.frag_present_only
        boundaries += len({lane_id for ids in gt for lane_id in ids})
    return {
        "boundaries": boundaries,
        "ego_switches": sum(switches),
        "outer_switches": len(switches) - sum(switches),
        "idf1": rate(2.0 * idtp, 2.0 * idtp + idfp + idfn),
        "id_true_positives": idtp,
        "id_false_positives": idfp,
        "id_false_negatives": idfn,
        "fragmentations": fragmentations,
    }


def id_switches(run: ClipRun) -> Iterator[bool]:
    """Yields whether the boundary is one of the ego lane, for each switch in a clip."""
    last: dict[int, int] = {}
    for frame in run.frames:
        for truth_index, index in frame.pairs.items():
            lane, track_id = frame.truth.lanes[truth_index], frame.answer.lanes[index].track_id
            if last.setdefault(lane.lane_id, track_id) != track_id:
                yield abs(lane.position) == 1
            last[lane.lane_id] = track_id


def _similarity(distances: FloatArray) -> list[list[float]]:
    """Returns similarities (L, M) from distances in lane widths; pairs that can't be compared have 0."""
    apart = np.nan_to_num(distances, nan=2.0 * GATE) / GATE
    similarity: list[list[float]] = np.maximum(1.0 - _THRESHOLD * apart, 0.0).tolist()
    return similarity
