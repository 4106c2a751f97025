"""The ego lane: sides and their hysteresis, positions, and the lane width."""

from __future__ import annotations

from itertools import pairwise

import pytest

from lanestream.road.view import LANE_WIDTHS
from lanestream.tracking.ego_lane import has_changed_sides, lane_positions, learned_width
from lanestream.tracking.tracks import Track

LANE = 2.4


def track(place: float) -> Track:
    return Track(0.0, 0.0, 0.9, 180.0, 359.0, 1 if place >= 0.0 else -1, place)


def changes(places: list[float], sideways: float) -> tuple[list[int], Track]:
    """Returns the frames, one a second, in which a boundary changes sides, and its track."""
    followed = track(places[0])
    found = [
        second
        for second, place in enumerate(places[1:], 1)
        if has_changed_sides(followed, place, sideways, LANE, second - 1.0, float(second))
    ]
    return found, followed


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_boundary_changes_sides_once_it_is_clearly_on_the_other(side: float) -> None:
    beyond = [0.2, 0.1, -0.05, -0.5, -1.0]
    found, followed = changes([side * place for place in beyond], sideways=side * 0.5)
    assert found == [2], "at once where the vehicle moves to it"
    assert followed.crossed == pytest.approx(1.0 + 0.1 / 0.15)
    assert followed.side == -side
    assert changes([side * place for place in beyond], sideways=0.0)[0] == [3], "later where it doesn't"
    assert changes([side * place for place in beyond], sideways=-side * 0.5)[0] == [3], "or moves away"


def test_the_time_of_a_crossing_is_the_last_one_before_the_change() -> None:
    found, followed = changes([0.1, -0.1, 0.1, 0.0, -0.1, -0.5], sideways=0.0)
    assert found == [5]
    assert followed.crossed == pytest.approx(3.0), "in which the boundary was exactly in the middle"


def test_noise_about_the_middle_changes_nothing() -> None:
    found, followed = changes([0.0, 0.1, -0.1, 0.05, -0.15, 0.2, -0.2], sideways=0.0)
    assert (found, followed.side) == ([], 1)


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ([-1.2, 1.2], [-1, 1]),
        ([-3.6, -1.2, 1.2, 3.6], [-2, -1, 1, 2]),
        ([-0.1, 2.3], [-1, 1]),
        ([-3.6, 1.2], [-2, 1]),
        ([-1.2, 1.2, 6.0], [-1, 1, 3]),
        ([3.6, -1.2, 1.2], [2, -1, 1]),
        ([], []),
    ],
)
def test_positions_are_counted_outwards_and_missing_boundaries_leave_gaps(
    places: list[float], expected: list[int]
) -> None:
    assert lane_positions([track(place) for place in places], places, LANE) == expected


def test_the_side_of_a_track_decides_not_its_place() -> None:
    tracks = [track(-2.3), track(0.1)]
    assert lane_positions(tracks, [-2.4, -0.02], LANE) == [-1, 1], "until it has changed sides"


def test_the_lane_width_follows_measured_ones_within_limits() -> None:
    widths = [LANE]
    for _ in range(200):
        widths.append(learned_width(widths[-1], 3.0))
    assert all(earlier < later <= 3.0 for earlier, later in pairwise(widths))
    assert widths[-1] == pytest.approx(3.0, abs=1e-3)
    for impossible in (LANE_WIDTHS[0] - 0.01, LANE_WIDTHS[1] + 0.01, -2.0):
        assert learned_width(LANE, impossible) == LANE
