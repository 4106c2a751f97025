"""Kind, type and color of the markings that tracks follow, as they are reported over a track's life."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from lanestream_exporter.datasets.labels import ROAD_EDGE_TYPES
from lanestream_exporter.evaluation.tracking.answers import AnsweredLane
from lanestream_exporter.evaluation.tracking.comparison import ClipRun, rate
from lanestream_exporter.evaluation.tracking.truth import TruthLane

# A track has seen enough of its marking this many seconds after it is first reported.
_AFTER_S: Final = 2.0
_Track = tuple[str, str, int]


@dataclass(frozen=True)
class _Sample:
    """A reported boundary that follows a true marking in a frame, and its track: kind and name of the clip, id."""

    track: _Track
    truth: TruthLane
    reported: AnsweredLane


def appearance_figures(runs: Sequence[ClipRun], after_s: float = _AFTER_S) -> dict[str, Any]:
    """Returns the shares of right kinds, types and colors from `after_s` after a track is first reported on.

    A track is right if it is in more than half of its frames. See docs/evaluation.md.
    """
    samples = [sample for run in runs for sample in _samples(run, after_s)]
    typed = [(each.track, each.reported.type == each.truth.type) for each in samples if each.truth.type]
    colored = [(each.track, each.reported.color == each.truth.color) for each in samples if each.truth.color]
    return {
        "kind": _shares([(each.track, each.reported.kind == "marking") for each in samples]),
        "type": _shares(typed),
        "color": _shares(colored),
    }


def _samples(run: ClipRun, after_s: float) -> Iterator[_Sample]:
    first: dict[int, float] = {}
    for frame in run.frames:
        for lane in frame.answer.lanes:
            first.setdefault(lane.track_id, frame.truth.timestamp)
        for truth_index, index in frame.pairs.items():
            lane, truth = frame.answer.lanes[index], frame.truth.lanes[truth_index]
            is_marking = truth.type not in ROAD_EDGE_TYPES
            if is_marking and frame.truth.timestamp - first[lane.track_id] >= after_s:
                yield _Sample((run.kind, run.name, lane.track_id), truth, lane)


def _shares(judged: Sequence[tuple[_Track, bool]]) -> dict[str, Any]:
    tracks: dict[_Track, list[bool]] = {}
    for track, is_right in judged:
        tracks.setdefault(track, []).append(is_right)
    right = sum(is_right for _, is_right in judged)
    right_tracks = sum(2 * sum(flags) > len(flags) for flags in tracks.values())
    return {
        "values": len(judged),
        "right": right,
        "share": rate(right, len(judged)),
        "tracks": len(tracks),
        "right_tracks": right_tracks,
        "track_share": rate(right_tracks, len(tracks)),
    }
