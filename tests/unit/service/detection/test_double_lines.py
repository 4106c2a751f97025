"""Double lines: a fit on either stripe ends between the two, and a single line is left alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lanestream.detection.curve_fit import Refinement
from lanestream.road.curve import Curve
from lanestream.road.results import Candidate
from lanestream.road.view import Image, RoadView

ROAD, PAINT = 90, 210
WIDTH = 0.08  # a stripe of 11 cm before a camera 1.4 m high, in rows below the horizon
BEND = 900.0
LEFT, RIGHT = -1.25, -1.25 + 0.16


def stripe(image: Image, view: RoadView, place: float, dashes: float = 1.0) -> None:
    """Paint along the boundary at `place`, on the share `dashes` of each stretch of road."""
    for y in range(int(view.horizon) + 8, view.height):
        u = y - view.horizon
        if (view.depth / u) % 1.0 > dashes:
            continue
        middle = 0.5 * view.width + place * u + BEND / u
        half = 0.5 * WIDTH * u
        cv2.line(image, (round(middle - half), y), (round(middle + half), y), (PAINT, PAINT, PAINT), 1)


def fitted(image: Image, view: RoadView, place: float) -> Curve:
    """What a candidate at `place` becomes."""
    curve = Curve(view.horizon, (0.5 * view.width, place, BEND))
    candidate = Candidate(curve, view.row_at(0.06), view.bottom, 1.0)
    fits, _ = Refinement().refine(image, [candidate], view)
    return fits[0].curve


def road(width: int = 640, height: int = 480) -> tuple[Image, RoadView]:
    """A bare road with its unrest."""
    unrest = np.random.default_rng(5).normal(ROAD, 3.0, (height, width, 1))
    image = np.repeat(unrest.clip(0, 255).astype(np.uint8), 3, axis=2)
    return image, RoadView(width, height, 0.45 * height)


def off(curve: Curve, view: RoadView, place: float) -> float:
    """How far a fit is from `place`, in rows below the horizon, over the nearer half of the road."""
    u = np.linspace(0.3, 0.9, 20) * view.depth
    return float(np.abs((curve.x(view.horizon + u) - 0.5 * view.width - BEND / u) / u - place).mean())


@pytest.mark.parametrize("start", [LEFT, RIGHT, LEFT - 0.02, 0.5 * (LEFT + RIGHT)])
@pytest.mark.parametrize("size", [(640, 480), (1280, 720)])
def test_a_fit_on_either_stripe_ends_between_them(start: float, size: tuple[int, int]) -> None:
    image, view = road(*size)
    stripe(image, view, LEFT)
    stripe(image, view, RIGHT)
    assert off(fitted(image, view, start), view, 0.5 * (LEFT + RIGHT)) < 0.02


@pytest.mark.parametrize("start", [LEFT, RIGHT])
def test_one_stripe_may_be_broken(start: float) -> None:
    image, view = road()
    stripe(image, view, LEFT)
    stripe(image, view, RIGHT, dashes=0.5)
    assert off(fitted(image, view, start), view, 0.5 * (LEFT + RIGHT)) < 0.03


@pytest.mark.parametrize("start", [LEFT, LEFT + 0.03])
def test_a_single_line_is_left_alone(start: float) -> None:
    image, view = road()
    stripe(image, view, LEFT)
    assert off(fitted(image, view, start), view, LEFT) < 0.02


@pytest.mark.parametrize("apart", [0.35, 0.8])
def test_lines_farther_apart_are_two_boundaries(apart: float) -> None:
    image, view = road()
    stripe(image, view, LEFT)
    stripe(image, view, LEFT + apart)
    assert off(fitted(image, view, LEFT), view, LEFT) < 0.02
    assert off(fitted(image, view, LEFT + apart), view, LEFT + apart) < 0.02
