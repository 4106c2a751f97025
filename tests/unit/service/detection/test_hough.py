"""The extended Hough transform on drawn edges, where every line is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.features import Channels, find_edges
from lanestream.detection.hough import hough_lines


def drawn_stripe(slope: float, x_bottom: float, width: float = 12.0, bright: bool = True) -> NDArray[np.uint8]:
    """Returns a stripe x = x_bottom + slope (y - 199) on a 320 x 200 image, anti-aliased."""
    y, x = np.mgrid[0:200, 0:320].astype(float)
    distance = np.abs(x - (x_bottom + slope * (y - 199.0))) / np.hypot(1.0, slope)
    cover = np.clip(width / 2.0 + 0.5 - distance, 0.0, 1.0)
    level = 60.0 + 120.0 * cover if bright else 180.0 - 120.0 * cover
    return level.astype(np.uint8)


@pytest.mark.parametrize("slope", [-2.0, -0.8, -0.02, 0.0, 0.02, 0.5, 1.7])
def test_both_edges_of_a_stripe_are_found_and_distinguished(slope: float) -> None:
    x_bottom = 160.0 + 60.0 * slope
    lines = hough_lines(find_edges(drawn_stripe(slope, x_bottom), 0), 320, 199.0)
    half = 6.0 * np.hypot(1.0, slope)
    for rising, expected in ((True, x_bottom - half), (False, x_bottom + half)):
        best = np.flatnonzero(lines.rising == rising)[0]
        assert lines.slope[best] == pytest.approx(slope, abs=0.03 * (1.0 + slope**2))
        # In the middle of the rows, where the vote is centered, an edge is exact to a pixel or two.
        middle = lines.x_bottom[best] - 100.0 * lines.slope[best]
        assert middle == pytest.approx(expected - 100.0 * slope, abs=2.5)


def test_votes_at_the_ends_of_the_angle_axis_are_not_lost() -> None:
    """A near-vertical stripe has its two normals at 0 and 180 degrees, where the angle axis wraps around."""
    upright = hough_lines(find_edges(drawn_stripe(0.0, 160.0), 0), 320, 199.0)
    oblique = hough_lines(find_edges(drawn_stripe(0.35, 180.0), 0), 320, 199.0)
    for rising in (True, False):
        at_the_ends = upright.votes[upright.rising == rising].max()
        elsewhere = oblique.votes[oblique.rising == rising].max()
        assert at_the_ends > 0.8 * elsewhere


def test_a_dark_stripe_has_its_edges_the_other_way_round() -> None:
    lines = hough_lines(find_edges(drawn_stripe(0.0, 160.0, bright=False), 0), 320, 199.0)
    left = lines.x_bottom[np.flatnonzero(~lines.rising)[0]]
    right = lines.x_bottom[np.flatnonzero(lines.rising)[0]]
    assert left < 160.0 < right


def test_lines_are_sorted_by_their_votes() -> None:
    image = np.maximum(drawn_stripe(-0.8, 60.0), drawn_stripe(0.9, 250.0, width=3.0))
    votes = hough_lines(find_edges(image, 0), 320, 199.0).votes
    assert len(votes) >= 3
    assert (np.diff(votes) <= 0.0).all()


def test_flat_lines_do_not_vote() -> None:
    flat = np.full((200, 320), 60, np.uint8)
    flat[100:110] = 180
    assert len(hough_lines(find_edges(flat, 0), 320, 199.0)) == 0


def test_an_empty_image_has_no_lines() -> None:
    edges = find_edges(np.full((200, 320), 90, np.uint8), 0)
    assert len(edges.x) == 0
    assert len(hough_lines(edges, 320, 199.0)) == 0


def test_edges_above_the_top_row_are_not_searched_for() -> None:
    edges = find_edges(drawn_stripe(0.0, 160.0), 120)
    assert len(edges.y) > 0
    assert edges.y.min() >= 120.0
    assert set(np.round(edges.angle) % 360.0) <= {0.0, 180.0}


def test_white_and_yellow_paint_is_bright_in_the_paint_channel_and_grass_is_dark_in_the_blue_one() -> None:
    concrete, white, yellow = (150, 150, 150), (230, 230, 230), (80, 210, 230)
    grass = (60, 170, 130)
    channels = Channels.of(np.array([[concrete, white, yellow, grass]], np.uint8))
    paint, blue = channels.paint[0].tolist(), channels.blue[0].tolist()
    assert paint == [150, 230, 220, 150]
    assert blue == [150, 230, 80, 60]
