"""Which detection belongs to which track: gated, globally cheapest, in order from left to right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from lanestream.lanes import FloatArray
from lanestream.tracking.filter import mahalanobis
from lanestream.tracking.track import Track

# Chi-square with three degrees of freedom, 99.7 %.
GATE = 14.2


def associate(tracks: Sequence[Track], measured: Sequence[tuple[FloatArray, FloatArray]]) -> list[tuple[int, int]]:
    """(track, detection) index pairs for detections told as columns (3,) and their covariance (3, 3).

    The cost is the innovation's negative log likelihood, d^2 + ln det S; pairs outside the gate are impossible.
    Boundaries don't cross at the bottom row, so of two pairs that would swap sides the dearer one is given up.
    """
    if not tracks or not measured:
        return []
    costs = np.full((len(tracks), len(measured)), np.inf)
    for i, track in enumerate(tracks):
        for j, (columns, noise) in enumerate(measured):
            distance, log_determinant = mahalanobis(track.kalman, columns, noise)
            if distance <= GATE:
                costs[i, j] = distance + log_determinant
    finite = np.isfinite(costs)
    if not finite.any():
        return []
    # A constant above every possible cost keeps the assignment feasible; such pairs are taken out again.
    dear = costs[finite].max() + 1e6
    rows, columns_ = linear_sum_assignment(np.where(finite, costs, dear))
    pairs = [(int(i), int(j)) for i, j in zip(rows, columns_, strict=True) if finite[i, j]]
    pairs.sort(key=lambda pair: costs[pair])
    kept: list[tuple[int, int]] = []
    for pair in pairs:
        if not any(_swaps(pair, other, tracks, measured) for other in kept):
            kept.append(pair)
    return kept


def _swaps(
    one: tuple[int, int],
    other: tuple[int, int],
    tracks: Sequence[Track],
    measured: Sequence[tuple[FloatArray, FloatArray]],
) -> bool:
    before = tracks[one[0]].columns[0] - tracks[other[0]].columns[0]
    after = measured[one[1]][0][0] - measured[other[1]][0][0]
    return bool(before * after < 0.0)
