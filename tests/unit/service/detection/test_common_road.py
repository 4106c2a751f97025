"""Boundaries of one road: they agree on vanishing point and bend, and one that is of no road is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from lanestream.detection.commonroad import Agreement, Boundaries, CommonRoad

from lanestream.road.curve import Curve, FloatArray, curve_columns

HORIZON, DEPTH = 200.0, 400.0
ROWS = HORIZON + DEPTH * np.array([1.0, 0.45, 0.15])
VANISHING, BEND = 320.0, 800.0


def boundaries(curves: list[Curve], horizon: float = HORIZON) -> Boundaries:
    return Boundaries(curve_columns(curves, ROWS), ROWS, horizon, horizon, np.ones(len(curves)), DEPTH)


def on_road(*slopes: float) -> list[Curve]:
    return [Curve(HORIZON, (VANISHING, slope, BEND)) for slope in slopes]


def agreed(told: Boundaries, sigma: FloatArray, rounds: int = 4) -> Agreement:
    """What boundaries agree on whose columns are known to `sigma` (N, 3), where they are told."""
    normal = np.eye(3) / sigma[:, :, None] ** 2
    road, found = CommonRoad(), CommonRoad().begun(told)
    for _ in range(rounds):
        found = road.agree(normal, np.zeros_like(told.columns), told, found)
    return found


def test_boundaries_of_one_road_stay() -> None:
    told = boundaries(on_road(-1.2, 1.1, 3.0))
    found = agreed(told, np.full((3, 3), 2.0))
    assert np.abs(found.shifts).max() < 0.1
    assert abs(found.road[0] - VANISHING) < 0.5
    assert abs(found.road[2] - BEND / DEPTH) < 0.1


def test_far_end_that_nobody_saw_is_where_the_others_meet() -> None:
    told = boundaries(on_road(-1.2, 1.1, 3.0))
    told.columns[1, 2] += 12.0
    sigma = np.full((3, 3), 1.0)
    sigma[1, 2] = 40.0
    found = agreed(told, sigma)
    assert abs(found.shifts[1, 2] + 12.0) < 3.0
    assert np.abs(found.shifts[[0, 2]]).max() < 1.0
    # What the others tell is worth something: the far end is known better than by itself.
    assert found.covariances[1, 2, 2] < 0.1 * 40.0**2


def test_boundary_of_no_road_neither_moves_the_others_nor_follows_them() -> None:
    told = boundaries([*on_road(-1.2, 1.1, 3.0), Curve(HORIZON, (VANISHING + 150.0, -2.5, -9000.0))])
    found = agreed(told, np.full((4, 3), 2.0))
    assert np.abs(found.shifts).max() < 2.0
    assert abs(found.road[0] - VANISHING) < 4.0


def test_alone_a_boundary_is_its_own_road() -> None:
    found = agreed(boundaries(on_road(1.1)), np.full((1, 3), 2.0))
    assert np.abs(found.shifts).max() < 1e-6


def test_in_a_sharp_bend_the_inner_boundary_may_turn_more_sharply() -> None:
    bends = (0.9 * 12_000.0, 12_000.0, 1.1 * 12_000.0)
    told = boundaries([Curve(HORIZON, (VANISHING, b, k)) for b, k in zip((-2.0, 0.0, 2.0), bends, strict=True)])
    found = agreed(told, np.full((3, 3), 4.0))
    assert np.abs(found.shifts).max() < 1.5
    assert abs(found.road[2] - 12_000.0 / DEPTH) < 1.5


def test_common_horizon_explains_lines_that_meet_below_it() -> None:
    # Straight lines that meet 8 rows below the assumed horizon: v = V - 8 b.
    told = boundaries([Curve(HORIZON, (VANISHING - 8.0 * b, b, 0.0)) for b in (-2.0, -0.8, 1.0, 2.5)])
    found = agreed(told, np.full((4, 3), 2.0))
    assert np.abs(found.shifts).max() < 1.0
    assert abs(found.road[1] - 8.0) < 2.0


def nodded(told: Boundaries, road: CommonRoad) -> Boundaries:
    """The boundaries below the horizon that they agree on, whose columns are known to half a pixel."""
    normal = np.broadcast_to(np.eye(3) / 0.25, (len(told.columns), 3, 3))
    found = road.begun(told)
    for _ in range(6):
        found = road.agree(normal, np.zeros_like(told.columns), told, found)
        told, found = road.nodded(told, found)
    return told


@pytest.mark.parametrize("off", [-12.0, 12.0])
def test_bent_boundaries_tell_where_the_horizon_is(off: float) -> None:
    told = nodded(boundaries(on_road(-2.4, -1.2, 1.1, 3.0), HORIZON + off), CommonRoad(usual=(0.1, 0.1, 0.1)))
    assert abs(told.horizon - HORIZON) < 3.0
    assert np.abs(told.coefficients[:, 2] - BEND).max() < 0.3 * BEND


def test_horizon_is_not_taken_to_be_farther_away_than_cameras_nod() -> None:
    told = boundaries(on_road(-2.4, -1.2, 1.1, 3.0), HORIZON + 50.0)
    assert nodded(told, CommonRoad(usual=(0.1, 0.5, 0.1))).horizon == pytest.approx(HORIZON + 50.0 - 0.04 * DEPTH)
    assert nodded(told, CommonRoad(nod=0.0)).horizon == HORIZON + 50.0
