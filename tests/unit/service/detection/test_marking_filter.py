"""Ridges, the vanishing point at which they gather, and lines through it, on drawn roads of known perspective."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.features import find_edges
from lanestream.detection.hough import hough_lines
from lanestream.detection.marking_filter import bar_contrast, find_ridges
from lanestream.detection.vanishing_point import KNOWN_HORIZON, WIDE, SearchRange, find_lines, refine, vote_of_lines
from lanestream.road.curve import VanishingPoint

WIDTH, HEIGHT = 640, 360
BOTTOM = HEIGHT - 1.0
POSITIONS = (-1.2, 1.1)


def point(x: float, y: float, curvature: float = 0.0) -> VanishingPoint:
    """Returns a vanishing point; `curvature` is in depths."""
    return VanishingPoint(x, y, curvature * (BOTTOM - y) ** 2, 1.0)


def drawn_road(vanishing: VanishingPoint, painted: float = 1.0) -> NDArray[np.uint8]:
    """Returns markings at `POSITIONS`, 0.1 row offsets wide; of every 40 rows the share `painted` has paint."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    below = np.maximum(y - vanishing.y, 1.0)
    across = (x - vanishing.x - vanishing.k / below) / below
    marked = np.any([np.abs(across - position) <= 0.05 for position in POSITIONS], axis=0)
    has_paint = marked & (y > vanishing.y + 2.0) & (y % 40.0 < 40.0 * painted)
    return np.where(has_paint, 210, 80).astype(np.uint8)


@pytest.mark.parametrize("curvature", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("painted", [1.0, 0.3])
def test_ridges_gather_along_markings(curvature: float, painted: float) -> None:
    vanishing = point(300.0, 150.0, curvature)
    ridges = find_ridges(drawn_road(vanishing, painted), vanishing)
    assert (np.diff(ridges.weight) <= 0.0).all()
    lines = find_lines(ridges, vanishing, WIDTH)
    assert (np.diff(lines.strength) <= 0.0).all()
    np.testing.assert_allclose(np.sort(lines.positions[:2]), POSITIONS, atol=0.021)


def test_a_road_without_markings_has_no_ridges() -> None:
    vanishing = point(300.0, 150.0)
    ridges = find_ridges(np.full((HEIGHT, WIDTH), 90, np.uint8), vanishing)
    assert len(ridges.x) == 0
    assert len(find_lines(ridges, vanishing, WIDTH).positions) == 0
    assert refine(vanishing, ridges, WIDTH, BOTTOM, SearchRange(0.1, 0.1, 0.1, 100, ((3, 1.0),))) == vanishing


def test_the_vanishing_point_moves_to_where_ridges_gather() -> None:
    truth, guess = point(310.0, 152.0, 0.02), point(300.0, 150.0)
    search = SearchRange(0.03, 0.01, 0.03, 1000, ((7, 1.0), (5, 0.3), (5, 0.1)))
    found = refine(guess, find_ridges(drawn_road(truth), guess), WIDTH, BOTTOM, search)
    rows, positions = np.array([200.0, 260.0, 340.0]), np.array(POSITIONS)
    error = found.columns(positions, rows) - truth.columns(positions, rows)
    before = guess.columns(positions, rows) - truth.columns(positions, rows)
    # A shift of all rows is another position, so only what differs between the rows is an error.
    assert np.abs(error - error.mean(axis=0)).max() < 0.5 * np.abs(before - before.mean(axis=0)).max()


@pytest.mark.parametrize("known", [True, False])
def test_hough_lines_meet_at_the_vanishing_point(known: bool) -> None:
    truth = point(330.0, 160.0)
    lines = hough_lines(find_edges(drawn_road(truth), 150), WIDTH, BOTTOM)
    found = vote_of_lines(lines, WIDTH, HEIGHT, 160.0 if known else None)
    assert (found.x, found.y) == pytest.approx((330.0, 160.0), abs=4.0)
    assert found.weight > 0.5


@pytest.mark.parametrize("row", [-72.0, -30.0, 20.0, 60.0])
@pytest.mark.parametrize("known", [True, False])
def test_a_vanishing_point_may_be_above_the_image(row: float, known: bool) -> None:
    truth = point(330.0, row)
    road = drawn_road(truth)
    lines = hough_lines(find_edges(road, 150), WIDTH, BOTTOM)
    voted = vote_of_lines(lines, WIDTH, HEIGHT, row if known else None)
    assert (voted.x, voted.y) == pytest.approx((330.0, row), abs=6.0)
    found = refine(voted, find_ridges(road, voted), WIDTH, BOTTOM, KNOWN_HORIZON if known else WIDE)
    assert (found.x, found.y) == pytest.approx((330.0, row), abs=12.0)


def test_without_lines_the_vanishing_point_is_the_usual_one() -> None:
    nothing = hough_lines(find_edges(np.full((HEIGHT, WIDTH), 90, np.uint8), 0), WIDTH, BOTTOM)
    usual = vote_of_lines(nothing, WIDTH, HEIGHT)
    assert (usual.x, usual.weight) == (319.5, 0.0)
    assert 0.4 * HEIGHT < usual.y < 0.5 * HEIGHT
    assert vote_of_lines(nothing, WIDTH, HEIGHT, 120.0).y == 120.0


def test_places_and_columns_are_inverse() -> None:
    vanishing = point(310.0, 152.0, 0.02)
    rows, positions = np.array([170.0, 260.0, 359.0]), np.array([-1.5, 0.0, 2.0])
    columns = vanishing.columns(positions, rows)
    for i, position in enumerate(positions.tolist()):
        np.testing.assert_allclose(vanishing.positions(columns[:, i], rows), position, atol=1e-9)
    np.testing.assert_allclose(vanishing.curves(positions).x(rows), columns.T, atol=1e-9)


def test_a_bar_has_the_contrast_to_its_brighter_side() -> None:
    row = np.full((1, 60), 50, np.uint8)
    row[0, 20:25], row[0, 25:] = 150, 90
    contrast = bar_contrast(row, [5])[0]
    assert contrast.argmax() == 22
    assert contrast[22] == pytest.approx(60.0)
    assert contrast[50] == 0.0
    np.testing.assert_array_equal(bar_contrast(row, [5, 9])[0], np.maximum(contrast, bar_contrast(row, [9])[0]))
