"""Which detection belongs to which track: gated, globally cheapest, in order from left to right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from lanestream.road.curve import FloatArray
from lanestream.tracking.kalman import mahalanobis
from lanestream.tracking.tracks import Track

# Chi-square with three degrees of freedom, 99.7 %.
GATE = 14.2


def associate(tracks: Sequence[Track], measured: Sequence[tuple[FloatArray, FloatArray]]) -> list[tuple[int, int]]:
    """(track, detection) index pairs for detections told as columns (3,) and their covariance (3, 3).

    The cost is the innovation's negative log likelihood, d^2 + ln det S; pairs outside the gate are impossible.
    Boundaries don't cross at the bottom row, so of two pairs that would swap sides the dearer one is given up.
    """
    if not tracks or not measured:
        return []
    distance, log_determinant = mahalanobis(
        np.stack([track.columns for track in tracks]),
        np.stack([track.kalman.P[:3, :3] for track in tracks]),
        np.stack([columns for columns, _ in measured]),
        np.stack([noise for _, noise in measured]),
    )
    costs = np.where(distance <= GATE, distance + log_determinant, np.inf)
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


def recover(
    tracks: Sequence[Track],
    measured: Sequence[tuple[FloatArray, FloatArray]],
    pairs: Sequence[tuple[int, int]],
    reach: FloatArray,
) -> list[tuple[int, int]]:
    """(track, detection) pairs of confirmed tracks left out of `pairs`, nearer at the two near rows than `reach` (3,).

    A road that turns faster than the filter believes takes its detections out of the track's gate. Where they are still
    nearest to that track in the second frame, they are the same boundary, and the filter was wrong; a single one out of
    the gate is an error. Nearest pairs first. Detections of tentative tracks count as free: it is they that were begun
    when the detection left the gate.
    """
    firm = [(i, j) for i, j in pairs if tracks[i].confirmed]
    near = []
    for i, track in enumerate(tracks):
        if not track.confirmed or track.detected or any(i == other for other, _ in firm):
            continue
        for j, (columns, _) in enumerate(measured):
            share = float((np.abs(columns - track.columns) / reach)[:2].max())
            if share < 1.0:
                near.append((share, i, j))
    kept = list(firm)
    for _, i, j in sorted(near):
        free = all(i != other[0] and j != other[1] for other in kept)
        if free and not any(_swaps((i, j), other, tracks, measured) for other in kept):
            kept.append((i, j))
    return kept[len(firm) :]


def _swaps(
    one: tuple[int, int],
    other: tuple[int, int],
    tracks: Sequence[Track],
    measured: Sequence[tuple[FloatArray, FloatArray]],
) -> bool:
    before = tracks[one[0]].columns[0] - tracks[other[0]].columns[0]
    after = measured[one[1]][0][0] - measured[other[1]][0][0]
    return bool(before * after < 0.0)
