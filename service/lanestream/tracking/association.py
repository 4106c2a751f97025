"""Association: matches detections to tracks, in order from left to right."""

from __future__ import annotations

from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray

# The cost of a track and a detection that are not matched with each other. A pair that costs more is never matched;
# with usual uncertainties this is an innovation of six sigmas. A lost identity is worse than a wrong update, which
# takes little from an outlier.
_UNMATCHED: Final = -6.0
# The kind of a detection may be wrong, however sure the detector is of it. So it decides between two detections, but
# a track whose only detection is of the other kind still takes it.
_LEAST_SAME: Final = 0.1


def associate(places: FloatArray, costs: FloatArray, apart: FloatArray, farthest: float) -> list[tuple[int, int]]:
    """Returns (track, detection) index pairs.

    `costs` (N, M) are the negative log likelihoods of the innovations (`kalman.costs`). `places` (N,) are the lateral
    places of the tracks, and `apart` (N, M) how far each detection is to the right of each track; pairs that are more
    than `farthest` apart are impossible.

    Boundaries do not cross near the vehicle, so tracks and detections are matched in order from left to right, at the
    lowest total cost. This is an alignment of two sequences, found by dynamic programming (S. Needleman and C. Wunsch,
    1970).
    """
    if not costs.size:
        return []
    gains = np.where(np.abs(apart) <= farthest, _UNMATCHED - costs, -np.inf)
    left_to_right = np.argsort(places, kind="stable").tolist()
    seen_left_to_right = np.argsort(places[0] + apart[0], kind="stable").tolist()
    aligned = _best_alignment(gains[np.ix_(left_to_right, seen_left_to_right)].tolist())
    return [(left_to_right[i], seen_left_to_right[j]) for i, j in aligned]


def kind_costs(tracks: FloatArray, detections: FloatArray) -> FloatArray:
    """Returns the costs (N, M) of pairs that may be of different kinds, to be added to those of `associate`.

    `tracks` (N,) and `detections` (M,) are probabilities of road edges. The costs are negative log likelihoods, too.
    """
    same = tracks[:, None] * detections + (1.0 - tracks[:, None]) * (1.0 - detections)
    return np.asarray(-np.log(np.maximum(same, _LEAST_SAME)))


def _best_alignment(gains: list[list[float]]) -> list[tuple[int, int]]:
    """Returns the ascending pairs (row, column) with the largest sum of gains; each gain is positive."""
    rows, columns = len(gains), len(gains[0])
    # best[i][j] is the largest sum of the first i rows and j columns.
    best = [[0.0] * (columns + 1) for _ in range(rows + 1)]
    for i in range(1, rows + 1):
        for j in range(1, columns + 1):
            best[i][j] = max(best[i - 1][j], best[i][j - 1], best[i - 1][j - 1] + gains[i - 1][j - 1])
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
