"""Drawn roads: paint along known curves, anti-aliased, so that positions are exact to a fraction of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curve, Curves
from lanestream.road.view import Image, RoadView

ROAD, PAINT = 90, 210


def straight(view: RoadView, position: float) -> Curve:
    """Returns a straight boundary at the lateral position `position`, in row offsets from the middle."""
    return Curve(view.horizon, (view.middle, position, 0.0))


def draw_road(
    view: RoadView,
    curves: Sequence[Curve] | Curves,
    *,
    width: float = 0.1,
    paint: int = PAINT,
    is_painted: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None,
    gray: Image | None = None,
    noise: float = 2.0,
) -> Image:
    """Returns gray levels (H, W) of a road with paint along `curves`, `width` row offsets wide.

    `is_painted` says at which shares of the depth, an array, there is paint. `gray` is a road to draw on.
    """
    if gray is None:
        texture = np.random.default_rng(5).normal(ROAD, noise, (view.height, view.width))
        gray = texture.clip(0, 255).astype(np.uint8)
    levels = gray.astype(float)
    rows = np.arange(int(np.ceil(max(view.horizon, 0.0))) + 4, view.height, dtype=float)
    columns = np.arange(view.width, dtype=float)
    for curve in curves:
        offset = np.maximum(rows - view.horizon, 1.0)
        distance = np.abs(columns - curve.x(rows)[:, None])
        cover = np.clip(0.5 * width * offset[:, None] + 0.5 - distance, 0.0, 1.0)
        if is_painted is not None:
            cover *= is_painted(offset / view.depth)[:, None]
        part = levels[int(rows[0]) :]
        part += cover * (paint - part)
    return np.asarray(levels.round(), np.uint8)


def in_color(gray: Image) -> Image:
    """Returns the BGR image (H, W, 3) of gray levels."""
    return np.repeat(gray[:, :, None], 3, axis=2)
