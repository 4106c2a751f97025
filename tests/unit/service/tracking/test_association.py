"""Association against all possible alignments, on small cases."""

from __future__ import annotations

from collections import deque
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.tracking.association import GATE, associate, recover
from lanestream.tracking.kalman import MEASURED, STATE, innovation_distances
from lanestream.tracking.tracks import Track

Array = NDArray[np.float64]
Pairs = list[tuple[int, int]]

POSITIONS = st.lists(st.floats(-60.0, 60.0), max_size=4)


def track_at(columns: Array, *, track_id: int | None = 1, variance: float = 9.0, detected: bool = False) -> Track:
    covariance = np.diag([variance] * MEASURED + [100.0] * (STATE - MEASURED))
    return Track(
        np.concatenate([columns, np.zeros(STATE - MEASURED)]),
        covariance,
        born=0.0,
        last_hit=0.0,
        probability=0.9,
        top=180.0,
        bottom=359.0,
        hits=deque([True], maxlen=5),
        side=1,
        track_id=track_id,
        detected=detected,
    )


def noise(number: int, variance: float = 4.0) -> Array:
    return np.tile(variance * np.eye(MEASURED), (number, 1, 1))


def best_by_brute_force(tracks: list[Track], columns: Array, variances: Array) -> tuple[int, float]:
    """Returns the number of pairs and the cost of the best of all alignments: the most pairs, then the cheapest."""
    distance, log_determinant = innovation_distances(
        np.stack([track.columns for track in tracks]),
        np.stack([track.covariance[:MEASURED, :MEASURED] for track in tracks]),
        columns,
        variances,
    )
    rows = sorted(range(len(tracks)), key=lambda i: float(tracks[i].columns[0]))
    seen = sorted(range(len(columns)), key=lambda j: float(columns[j, 0]))
    best = (0, 0.0)
    for number in range(1, min(len(rows), len(seen)) + 1):
        for some in combinations(rows, number):
            for others in combinations(seen, number):
                pairs = list(zip(some, others, strict=True))
                if any(distance[pair] > GATE for pair in pairs):
                    continue
                cost = float(sum(distance[pair] + log_determinant[pair] for pair in pairs))
                if number > best[0] or cost < best[1]:
                    best = (number, cost)
    return best


@given(positions=POSITIONS, seen=POSITIONS, seed=st.integers(0, 1000))
def test_the_alignment_is_the_best_of_all(positions: list[float], seen: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    tracks = [
        track_at(position + rng.normal(0.0, 3.0, MEASURED), variance=float(rng.uniform(1.0, 40.0)))
        for position in positions
    ]
    columns = np.array(seen).reshape(-1, 1) + rng.normal(0.0, 3.0, (len(seen), MEASURED))
    variances = noise(len(seen)) * rng.uniform(0.5, 10.0, (len(seen), 1, 1))
    pairs = associate(tracks, columns, variances)
    if not positions or not seen:
        assert pairs == []
        return
    distance, log_determinant = innovation_distances(
        np.stack([track.columns for track in tracks]),
        np.stack([track.covariance[:MEASURED, :MEASURED] for track in tracks]),
        columns,
        variances,
    )
    number, cost = best_by_brute_force(tracks, columns, variances)
    assert len(pairs) == number
    assert sum(distance[pair] + log_determinant[pair] for pair in pairs) == pytest.approx(cost)
    assert all(distance[pair] <= GATE for pair in pairs)
    near_columns = [(tracks[i].columns[0], columns[j, 0]) for i, j in pairs]
    assert sorted(near_columns) == sorted(near_columns, key=lambda pair: pair[1]), "in order from left to right"


def test_a_track_takes_the_nearest_of_two_detections_in_its_gate() -> None:
    tracks = [track_at(np.full(MEASURED, 100.0)), track_at(np.full(MEASURED, 0.0))]
    columns = np.array([[103.0] * 3, [101.0] * 3, [-2.0] * 3, [500.0] * 3])
    assert sorted(associate(tracks, columns, noise(4))) == [(0, 1), (1, 2)]


def test_more_pairs_in_order_are_better_than_one_that_is_nearer() -> None:
    tracks = [track_at(np.full(MEASURED, 0.0)), track_at(np.full(MEASURED, 6.0))]
    columns = np.array([[6.0] * 3, [12.0] * 3])
    assert associate(tracks, columns, noise(2)) == [(0, 0), (1, 1)]


REACH = np.array([30.0, 20.0, 10.0])


def recovered(tracks: list[Track], columns: Array, pairs: Pairs) -> Pairs:
    return recover(tracks, columns, pairs, REACH)


def test_a_confirmed_track_that_was_missed_takes_the_nearest_detection_within_reach() -> None:
    tracks = [track_at(np.full(MEASURED, 0.0))]
    columns = np.array([[25.0, 10.0, 90.0], [10.0, 15.0, 90.0], [31.0, 0.0, 0.0]])
    assert recovered(tracks, columns, []) == [(0, 1)], "only the two near rows count"
    assert recovered(tracks, columns[2:], []) == []


@pytest.mark.parametrize("detected", [True, False])
def test_only_in_the_second_frame_without_its_detection_a_track_is_recovered(detected: bool) -> None:
    tracks = [track_at(np.zeros(MEASURED), detected=detected)]
    assert recovered(tracks, np.full((1, MEASURED), 10.0), []) == ([] if detected else [(0, 0)])


def test_a_detection_of_a_tentative_track_can_be_recovered_but_not_that_of_a_confirmed_one() -> None:
    columns = np.full((1, MEASURED), 10.0)
    lost, tentative = track_at(np.zeros(MEASURED)), track_at(columns[0], track_id=None)
    assert recovered([lost, tentative], columns, [(1, 0)]) == [(0, 0)]
    assert recovered([lost, track_at(columns[0], track_id=2)], columns, [(1, 0)]) == []
    assert recovered([tentative], columns, []) == []


def test_recovered_tracks_do_not_swap_sides() -> None:
    left, right = track_at(np.zeros(MEASURED), track_id=1), track_at(np.full(MEASURED, 10.0), track_id=2)
    assert recovered([left, right], np.array([[12.0] * 3, [-8.0] * 3]), []) == [(1, 0), (0, 1)], "the nearest first"
    columns = np.array([[-5.0] * 3, [3.0] * 3])
    assert recovered([left, right], columns, []) == [(0, 1)]
    assert recovered([left, right], columns, [(1, 0)]) == []
