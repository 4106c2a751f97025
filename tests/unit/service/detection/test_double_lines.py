"""Double lines: a fit on either stripe ends between the two, and a single line is left alone."""

from __future__ import annotations

import numpy as np
import pytest
import roads
from numpy.typing import NDArray

from lanestream.detection.curve_fit import fit_curves
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import Image, RoadView, visible_spans

WIDTH = 0.08  # a stripe of 11 cm before a camera 1.4 m high, in row offsets
CURVATURE = 900.0
LEFT, RIGHT = -1.25, -1.25 + 0.16
SIZES = [(640, 480), (640, 360)]


def curve_at(view: RoadView, position: float) -> Curve:
    return Curve(view.horizon, (view.middle, position, CURVATURE))


def draw_stripe(view: RoadView, position: float, gray: Image | None = None, dashes: float = 1.0) -> Image:
    """Returns a road with a stripe at `position`; the share `dashes` of each stretch of road has paint."""

    def is_painted(share: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray((1.0 / share) % 1.0 <= dashes)

    return roads.draw_road(view, [curve_at(view, position)], width=WIDTH, is_painted=is_painted, gray=gray, noise=3.0)


def view_of(size: tuple[int, int]) -> RoadView:
    return RoadView(*size, 0.45 * size[1])


def fitted_position(gray: Image, view: RoadView, start: float, truth: float) -> float:
    """Returns how far the fit that began at `start` is from the position `truth`, over the nearer half of the road."""
    curves = Curves.of([curve_at(view, start)])
    fit = fit_curves(roads.channels(gray), curves, visible_spans(curves, view), view).curves[0]
    u = np.linspace(0.3, 0.9, 20) * view.depth
    return float(np.abs((fit.x(view.horizon + u) - view.middle - CURVATURE / u) / u - truth).mean())


@pytest.mark.parametrize("start", [LEFT, RIGHT, LEFT - 0.02, 0.5 * (LEFT + RIGHT)])
@pytest.mark.parametrize("size", SIZES)
def test_a_fit_on_either_stripe_ends_between_them(start: float, size: tuple[int, int]) -> None:
    view = view_of(size)
    gray = draw_stripe(view, RIGHT, draw_stripe(view, LEFT))
    assert fitted_position(gray, view, start, 0.5 * (LEFT + RIGHT)) < 0.02


@pytest.mark.parametrize("start", [LEFT, RIGHT])
def test_one_stripe_may_be_dashed(start: float) -> None:
    view = view_of((640, 480))
    gray = draw_stripe(view, RIGHT, draw_stripe(view, LEFT), dashes=0.5)
    assert fitted_position(gray, view, start, 0.5 * (LEFT + RIGHT)) < 0.03


@pytest.mark.parametrize("start", [LEFT, LEFT + 0.03])
def test_a_single_line_is_left_alone(start: float) -> None:
    view = view_of((640, 480))
    assert fitted_position(draw_stripe(view, LEFT), view, start, LEFT) < 0.02


@pytest.mark.parametrize("distance", [0.35, 0.8])
def test_lines_farther_apart_are_two_boundaries(distance: float) -> None:
    view = view_of((640, 480))
    gray = draw_stripe(view, LEFT + distance, draw_stripe(view, LEFT))
    for position in (LEFT, LEFT + distance):
        assert fitted_position(gray, view, position, position) < 0.02
