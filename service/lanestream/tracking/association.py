"""Association: matches detections to tracks within a gate, in order from left to right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream.tracking.kalman import MEASURED, innovation_distances
from lanestream.tracking.tracks import Track

# The 99.7 % quantile of chi-square with three degrees of freedom.
GATE: Final = 14.2


def associate(tracks: Sequence[Track], columns: FloatArray, noise: FloatArray) -> list[tuple[int, int]]:
    """Returns (track, detection) index pairs; detections have `columns` (M, 3) and covariances `noise` (M, 3, 3).

    The cost of a pair is the innovation's negative log likelihood d^2 + ln det S; pairs outside the gate are
    impossible. Boundaries do not cross at the bottom row, so tracks and detections are matched in order from left to
    right: as many pairs as possible, at the lowest total cost. This is an alignment of two sequences, found by dynamic
    programming (S. Needleman and C. Wunsch, 1970).
    """
    if not tracks or not len(columns):
        return []
    distance, log_determinant = innovation_distances(
        np.stack([track.columns for track in tracks]),
        np.stack([track.covariance[:MEASURED, :MEASURED] for track in tracks]),
        columns,
        noise,
    )
    costs = np.where(distance <= GATE, distance + log_determinant, np.inf)
    left_to_right = np.argsort([track.columns[0] for track in tracks], kind="stable").tolist()
    seen_left_to_right = np.argsort(columns[:, 0], kind="stable").tolist()
    aligned = _cheapest_alignment(costs[np.ix_(left_to_right, seen_left_to_right)].tolist())
    return [(left_to_right[i], seen_left_to_right[j]) for i, j in aligned]


def _cheapest_alignment(costs: list[list[float]]) -> list[tuple[int, int]]:
    """Returns as many ascending pairs (row, column) of finite cost as possible, with the lowest sum of costs."""
    rows, columns = len(costs), len(costs[0])
    # best[i][j] is (-number of pairs, sum of costs) of the first i rows and j columns.
    best = [[(0, 0.0)] * (columns + 1) for _ in range(rows + 1)]
    for i in range(1, rows + 1):
        for j in range(1, columns + 1):
            number, total = best[i - 1][j - 1]
            cost = costs[i - 1][j - 1]
            paired = (number - 1, total + cost) if np.isfinite(cost) else (1, 0.0)
            best[i][j] = min(best[i - 1][j], best[i][j - 1], paired)
    pairs = []
    i, j = rows, columns
    while i and j:
        if best[i][j] == best[i - 1][j]:
            i -= 1
        elif best[i][j] == best[i][j - 1]:
            j -= 1
        else:
            i, j = i - 1, j - 1
            pairs.append((i, j))
    return pairs[::-1]


def recover(
    tracks: Sequence[Track], columns: FloatArray, pairs: Sequence[tuple[int, int]], reach: FloatArray
) -> list[tuple[int, int]]:
    """Returns further (track, detection) pairs: unmatched confirmed tracks with detections within `reach` (3,).

    If a road turns faster than the filter expects, its detections leave the gate. If they are still nearest to the same
    track in the second frame, they belong to it and the filter was wrong; a single one outside the gate is an error.
    Distances count at the two near rows; the nearest pairs come first. Detections of tentative tracks are available:
    those tracks began when the detection left the gate.
    """
    confirmed = [(i, j) for i, j in pairs if tracks[i].confirmed]
    near = []
    for i, track in enumerate(tracks):
        if not track.confirmed or track.detected or any(i == other for other, _ in confirmed):
            continue
        shares = (np.abs(columns - track.columns) / reach)[:, :2].max(axis=1).tolist()
        near += [(share, i, j) for j, share in enumerate(shares) if share < 1.0]
    kept = list(confirmed)
    for _, i, j in sorted(near):
        free = all(i != other[0] and j != other[1] for other in kept)
        if free and not any(_swaps((i, j), other, tracks, columns) for other in kept):
            kept.append((i, j))
    return kept[len(confirmed) :]


def _swaps(one: tuple[int, int], other: tuple[int, int], tracks: Sequence[Track], columns: FloatArray) -> bool:
    """Returns whether two pairs would swap sides."""
    before = tracks[one[0]].columns[0] - tracks[other[0]].columns[0]
    after = columns[one[1], 0] - columns[other[1], 0]
    return bool(before * after < 0.0)
