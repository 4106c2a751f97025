"""Ridges and the lines along which they gather, on drawn roads whose perspective is known."""

from __future__ import annotations

import numpy as np
import pytest
from lanestream.detection.fan import Fan
from lanestream.detection.perspective import Perspective, PerspectiveSearch
from numpy.typing import NDArray

from lanestream.detection.marking_filter import RidgeSearch

WIDTH, HEIGHT = 640, 360
BOTTOM = HEIGHT - 1.0
SLOPES = (-1.2, 1.1)


def drawn_road(point: Perspective, dash: float = 1.0) -> NDArray[np.uint8]:
    """Markings with the bottom `SLOPES`, 0.1 of the depth wide; of every 40 rows the share `dash` is painted."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    below = np.maximum(y - point.y, 1.0)
    across = (x - point.x - point.k(BOTTOM) / below) / below
    marked = np.any([np.abs(across - slope) <= 0.05 for slope in SLOPES], axis=0)
    painted = marked & (y > point.y + 2.0) & (y % 40.0 < 40.0 * dash)
    return np.where(painted, 210, 80).astype(np.uint8)


@pytest.mark.parametrize("bend", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("dash", [1.0, 0.3])
def test_ridges_gather_along_markings(bend: float, dash: float) -> None:
    point = Perspective(300.0, 150.0, bend, 1.0)
    ridges = RidgeSearch().find(drawn_road(point, dash), point)
    assert (np.diff(ridges.weight) <= 0.0).all()
    strongest = Fan().lines(ridges, point, WIDTH, BOTTOM).slope[:2]
    np.testing.assert_allclose(np.sort(strongest), SLOPES, atol=0.021)


def test_a_road_without_markings_has_no_ridges() -> None:
    point = Perspective(300.0, 150.0, 0.0, 1.0)
    ridges = RidgeSearch().find(np.full((HEIGHT, WIDTH), 90, np.uint8), point)
    assert len(ridges.x) == 0
    assert len(Fan().lines(ridges, point, WIDTH, BOTTOM).slope) == 0


def test_the_perspective_moves_to_where_ridges_gather() -> None:
    truth = Perspective(310.0, 152.0, 0.02, 1.0)
    guess = Perspective(300.0, 150.0, 0.0, 1.0)
    found = PerspectiveSearch(spread_x=0.03, nod=0.01, spread_bend=0.03).refine(
        guess, RidgeSearch().find(drawn_road(truth), guess), WIDTH, BOTTOM, known=True
    )
    rows, slopes = np.array([200.0, 260.0, 340.0]), np.array(SLOPES)
    missed = found.columns(slopes, rows, BOTTOM) - truth.columns(slopes, rows, BOTTOM)
    before = guess.columns(slopes, rows, BOTTOM) - truth.columns(slopes, rows, BOTTOM)
    assert np.abs(missed - missed.mean(axis=0)).max() < 0.5 * np.abs(before - before.mean(axis=0)).max()


def test_slopes_and_columns_are_each_others_inverse() -> None:
    point = Perspective(310.0, 152.0, 0.02, 1.0)
    rows = np.array([170.0, 260.0, 359.0])
    columns = point.columns(np.array([-1.5, 0.0, 2.0]), rows, BOTTOM)
    for i, slope in enumerate((-1.5, 0.0, 2.0)):
        np.testing.assert_allclose(point.slopes(columns[:, i], rows, BOTTOM), slope, atol=1e-9)
