"""Association against all possible alignments, on small cases."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.tracking.association import _UNMATCHED, associate, kind_costs

Array = NDArray[np.float64]
Pairs = list[tuple[int, int]]

FARTHEST = 0.7
POSITIONS = st.lists(st.floats(-4.0, 4.0), max_size=4)


def matched(places: list[float], seen: list[float], *, cost_of_distance: float = 10.0) -> Pairs:
    """Matches tracks at `places` to detections at the places `seen`, whose costs grow with their squared distance."""
    apart = np.array(seen)[None, :] - np.array(places)[:, None]
    return associate(np.array(places), _UNMATCHED - 5.0 + cost_of_distance * apart**2, apart, FARTHEST)


def best_by_brute_force(places: Array, costs: Array, apart: Array) -> float:
    """Returns the cost of the cheapest of all alignments, compared with the one that matches nothing."""
    seen = places[0] + apart[0]
    rows, columns = np.argsort(places, kind="stable").tolist(), np.argsort(seen, kind="stable").tolist()
    best = 0.0
    for number in range(1, min(len(rows), len(columns)) + 1):
        for some in combinations(rows, number):
            for others in combinations(columns, number):
                pairs = list(zip(some, others, strict=True))
                if all(abs(apart[pair]) <= FARTHEST for pair in pairs):
                    best = min(best, sum(float(costs[pair]) - _UNMATCHED for pair in pairs))
    return best


@given(positions=POSITIONS, seen=POSITIONS, seed=st.integers(0, 1000))
def test_the_alignment_is_the_cheapest_of_all(positions: list[float], seen: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = np.array(positions)
    apart = np.array(seen)[None, :] - places[:, None]
    costs = _UNMATCHED + rng.normal(-3.0, 4.0, apart.shape)
    pairs = associate(places, costs, apart, FARTHEST)
    if not positions or not seen:
        assert pairs == []
        return
    assert sum(float(costs[pair]) - _UNMATCHED for pair in pairs) == pytest.approx(
        best_by_brute_force(places, costs, apart)
    )
    assert all(abs(apart[pair]) <= FARTHEST and costs[pair] < _UNMATCHED for pair in pairs)
    in_order = sorted(pairs, key=lambda pair: (places[pair[0]], pair[0]))
    columns = [places[0] + apart[0, j] for _, j in in_order]
    assert columns == sorted(columns), "in order from left to right"
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)


def test_a_track_takes_the_nearest_of_two_detections() -> None:
    assert sorted(matched([1.2, -1.2], [1.5, 1.25, -1.1, 4.0])) == [(0, 1), (1, 2)]


def test_two_pairs_in_order_are_better_than_one_that_is_nearer() -> None:
    assert matched([0.0, 0.3], [0.3, 0.6]) == [(0, 0), (1, 1)]


def test_pairs_never_cross() -> None:
    places, apart = np.array([0.0, 0.2]), np.array([[0.2, 0.0], [0.0, -0.2]])
    costs = _UNMATCHED - np.array([[9.0, 1.0], [1.0, 9.0]])
    assert associate(places, costs, apart, FARTHEST) in ([(0, 0)], [(1, 1)])


def test_a_detection_too_far_away_or_too_unlikely_is_not_matched() -> None:
    assert matched([0.0], [FARTHEST - 0.01], cost_of_distance=1.0) == [(0, 0)]
    assert matched([0.0], [FARTHEST + 0.01], cost_of_distance=1.0) == []
    assert matched([0.0], [0.5], cost_of_distance=30.0) == []


def test_of_two_detections_the_one_of_the_same_kind_belongs_to_a_track() -> None:
    places, apart = np.array([0.0]), np.array([[0.1, -0.12]])
    costs = _UNMATCHED - 5.0 + 10.0 * apart**2
    assert associate(places, costs, apart, FARTHEST) == [(0, 0)]
    for track, detections in ((0.05, (0.95, 0.02)), (0.95, (0.05, 0.9))):
        kinds = kind_costs(np.array([track]), np.array(detections))
        assert associate(places, costs + kinds, apart, FARTHEST) == [(0, 1)]


def test_an_only_detection_belongs_to_a_track_of_the_other_kind() -> None:
    apart = np.array([[0.1]])
    kinds = kind_costs(np.array([0.0]), np.array([1.0]))
    assert np.isfinite(kinds).all()
    assert associate(np.array([0.0]), _UNMATCHED - 5.0 + kinds, apart, FARTHEST) == [(0, 0)]
    assert (kind_costs(np.zeros(3), np.zeros(2)) == np.zeros((3, 2))).all(), "models without road edges"
