"""The extended Hough transform on drawn edges, where every line is known."""

from __future__ import annotations

import numpy as np
import pytest

from lanestream.detection.features import find_edges
from lanestream.detection.hough import ExtendedHough


def drawn_stripe(slope: float, x_bottom: float, width: float = 12.0, bright: bool = True) -> np.ndarray:
    """A stripe x = x_bottom + slope (y - 199) on a 320 x 200 image, anti-aliased."""
    y, x = np.mgrid[0:200, 0:320].astype(float)
    distance = np.abs(x - (x_bottom + slope * (y - 199.0))) / np.hypot(1.0, slope)
    cover = np.clip(width / 2.0 + 0.5 - distance, 0.0, 1.0)
    level = 60.0 + 120.0 * cover if bright else 180.0 - 120.0 * cover
    return level.astype(np.uint8)


@pytest.mark.parametrize("slope", [-2.0, -0.8, -0.02, 0.0, 0.02, 0.5, 1.7])
def test_both_edges_of_a_stripe_are_found_and_told_apart(slope: float) -> None:
    x_bottom = 160.0 + 60.0 * slope
    lines = ExtendedHough().lines(find_edges(drawn_stripe(slope, x_bottom), 0), 320, 199.0)
    half = 6.0 * np.hypot(1.0, slope)
    for rising, expected in ((True, x_bottom - half), (False, x_bottom + half)):
        mine = lines.rising == rising
        best = np.flatnonzero(mine)[0]
        assert lines.slope[best] == pytest.approx(slope, abs=0.03 * (1.0 + slope**2))
        # Half way up, where the vote is centred, an edge is found to a pixel or two.
        middle = lines.x_bottom[best] - 100.0 * lines.slope[best]
        assert middle == pytest.approx(expected - 100.0 * slope, abs=2.5)


def test_votes_near_the_seam_of_the_circle_are_not_lost() -> None:
    """A near-vertical stripe has its two normals at 0 and 180 degrees, where the angle axis wraps around."""
    upright = ExtendedHough().lines(find_edges(drawn_stripe(0.0, 160.0), 0), 320, 199.0)
    leaning = ExtendedHough().lines(find_edges(drawn_stripe(0.35, 180.0), 0), 320, 199.0)
    for rising in (True, False):
        seam = upright.votes[upright.rising == rising].max()
        elsewhere = leaning.votes[leaning.rising == rising].max()
        assert seam > 0.8 * elsewhere


def test_a_dark_stripe_has_its_edges_the_other_way_round() -> None:
    lines = ExtendedHough().lines(find_edges(drawn_stripe(0.0, 160.0, bright=False), 0), 320, 199.0)
    left = lines.x_bottom[np.flatnonzero(~lines.rising)[0]]
    right = lines.x_bottom[np.flatnonzero(lines.rising)[0]]
    assert left < 160.0 < right


def test_flat_lines_do_not_vote() -> None:
    flat = np.full((200, 320), 60, np.uint8)
    flat[100:110] = 180
    assert len(ExtendedHough().lines(find_edges(flat, 0), 320, 199.0)) == 0


def test_an_empty_image_has_no_lines() -> None:
    edges = find_edges(np.full((200, 320), 90, np.uint8), 0)
    assert len(ExtendedHough().lines(edges, 320, 199.0)) == 0
