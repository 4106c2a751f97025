"""Merging: of tracks that follow one boundary, the oldest keeps its identity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream.tracking.tracks import FRAMES, HITS, Track

# Tracks closer than the first, in lane widths, follow one boundary. A track takes over the place of one that is closer
# than the second after the usual number of hits, of one farther away after as many hits in a row as are remembered.
SAME: Final = 0.35
_NEAR: Final = 0.2
# Tracks of different kinds may be a marking and the edge of the road beside it, from this distance on, in lane widths:
# 0.25 m. They are of different kinds with at least this probability.
_BESIDE: Final = 0.07
_DIFFERENT: Final = 0.8


@dataclass(frozen=True)
class Survivor:
    """A track that is kept, with the place of the track `slot`, which is another one if it took that over.

    A `contested` track is tentative, and near a confirmed one: it may be where that boundary is now.
    """

    track: int
    slot: int
    contested: bool = False


def merge(tracks: Sequence[Track], positions: FloatArray, lane_width: float) -> list[Survivor]:
    """Returns the tracks that are kept, in order; those that took over a place continue with its support, too.

    `positions` (N, R) and `lane_width` are in row offsets, at R rows.
    """
    order = sorted(range(len(tracks)), key=lambda i: (not tracks[i].confirmed, tracks[i].born, tracks[i].track_id or 0))
    survivors: dict[int, Survivor] = {}
    for i in order:
        gaps = {j: float(np.abs(positions[i] - positions[j]).max()) / lane_width for j in survivors}
        near = sorted((j for j in gaps if gaps[j] < SAME), key=gaps.__getitem__)
        beside = [j for j in near if gaps[j] >= _BESIDE and _are_different(tracks[i], tracks[j])]
        older = next((j for j in near if j not in beside), None)
        if older is None:
            # The new track of another kind is that of another boundary once a frame has shown both.
            shown = tracks[i].confirmed or all(_share_a_frame(tracks[i], tracks[j]) for j in beside)
            survivors[i] = Survivor(i, i, contested=not shown)
        elif not tracks[older].hits[-1]:
            if sum(tracks[i].hits) >= (HITS if gaps[older] < _NEAR else FRAMES):
                tracks[older].take_over(tracks[i])
                survivors[older] = Survivor(older, i)
            elif not tracks[i].confirmed:
                survivors[i] = Survivor(i, i, contested=True)
    return [survivors[i] for i in sorted(survivors)]


def _are_different(one: Track, other: Track) -> bool:
    """Returns whether one of two tracks is a marking and the other one an edge of the road."""
    p, q = one.appearance.road_edge, other.appearance.road_edge
    return p * (1.0 - q) + q * (1.0 - p) >= _DIFFERENT


def _share_a_frame(one: Track, other: Track) -> bool:
    """Returns whether a recent frame shows both of two tracks."""
    return any(a and b for a, b in zip(reversed(one.hits), reversed(other.hits), strict=False))
