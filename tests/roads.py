"""Drawn roads: paint and surfaces along known curves, anti-aliased, so that positions are exact to part of a pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.features import Channels
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


def draw_surfaces(
    view: RoadView, edges: Sequence[Curve], colors: Sequence[tuple[int, int, int]], noise: float = 2.0
) -> Image:
    """Returns a BGR image (H, W, 3) of surfaces of these `colors`, from left to right, with `edges` between them."""
    rows, columns = np.arange(view.height, dtype=float), np.arange(view.width, dtype=float)
    levels = np.random.default_rng(5).normal(0.0, noise, (view.height, view.width, 1)) + np.array(colors[0], float)
    for edge, left, right in zip(edges, colors[:-1], colors[1:], strict=True):
        cover = np.clip(columns - edge.x(rows)[:, None] + 0.5, 0.0, 1.0)
        levels += cover[:, :, None] * (np.array(right, float) - np.array(left, float))
    return np.asarray(levels.clip(0, 255), np.uint8)


def paint_on(image: Image, view: RoadView, curves: Sequence[Curve], *, width: float = 0.1, paint: int = PAINT) -> Image:
    """Returns a BGR image (H, W, 3) with white paint along `curves`, `width` row offsets wide."""
    painted = [draw_road(view, curves, width=width, paint=paint, gray=image[:, :, channel]) for channel in range(3)]
    return np.stack(painted, axis=2)


def channels(gray: Image) -> Channels:
    """Returns the channels of gray levels (H, W)."""
    return Channels(gray, gray)


def in_color(gray: Image) -> Image:
    """Returns the BGR image (H, W, 3) of gray levels."""
    return np.repeat(gray[:, :, None], 3, axis=2)
