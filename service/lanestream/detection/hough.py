"""The extended Hough transform: lines from edge pixels that vote only near their gradient's direction.

The angle axis covers the full circle, so the two edges of a marking, whose gradients are opposite, are peaks 180
degrees apart and can be distinguished. Sources: F. O'Gorman and M. B. Clowes, "Finding picture edges through
collinearity of feature points", 1976 (votes limited by the gradient); T. Petkovic and S. Loncaric, arXiv 1510.04863
(the full circle).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.features import Edges
from lanestream.road.curve import Curves, FloatArray, VanishingPoint
from lanestream.road.view import RoadView

_CIRCLE: Final = 360
# A pixel votes up to this many degrees to either side of its gradient's direction, in cells of this many pixels.
_WINDOW: Final = 8
_CELL: Final = 1.5
# Lines flatter than this many columns per row cannot be lane boundaries.
_MOST_SLOPE: Final = 7.0
_FLATTEST: Final = math.degrees(math.atan(_MOST_SLOPE))
_LEAST_VOTES: Final = 6.0
_MOST_LINES: Final = 80
# The angle axis is padded by this many columns at either end, so that peaks there have all their neighbors.
_PAD: Final = 3


@dataclass(frozen=True)
class HoughLines:
    """Lines of a working image, strongest first, one array entry per line.

    A line is x(y) = `x_bottom` + `slope` (y - bottom row). `rising` is True if the image gets brighter from left to
    right across it (the left edge of a bright marking). `votes` is the accumulator's weight.
    """

    x_bottom: NDArray[np.float64]
    slope: NDArray[np.float64]
    rising: NDArray[np.bool_]
    votes: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.votes)


def hough_lines(edges: Edges, width: int, bottom: float) -> HoughLines:
    """Returns the lines in `edges` of an image `width` pixels wide, with their columns at the row `bottom`."""
    origin_x = (width - 1) / 2.0
    # The other pixels cannot belong to a line that is steep enough; their votes would only cost time.
    steep = np.flatnonzero(_from_upright(edges.angle) <= _FLATTEST)
    if not len(steep):
        nothing = np.empty(0)
        return HoughLines(nothing, nothing, nothing > 0.0, nothing)
    x = (edges.x[steep] - np.float32(origin_x)) / np.float32(_CELL)
    y = (edges.y[steep] - np.float32(bottom)) / np.float32(_CELL)
    reach = int(np.ceil(np.hypot(origin_x / _CELL, float(np.abs(y).max())))) + 2
    rho, theta, votes = _peaks(_accumulate(x, y, edges.angle[steep], edges.weight[steep], reach))
    radians = np.radians(theta)
    x_bottom = origin_x + _CELL * (rho - reach) / np.cos(radians)
    return HoughLines(x_bottom, -np.tan(radians), np.cos(radians) > 0.0, votes)


# Two edges bound one marking if their distance is between these, in row offsets: markings of 0.10 to 0.30 m seen from
# 1.2 to 2.2 m, with room for double lines. The distance changes by less than the third between the compared rows.
_NARROWEST, _WIDEST, _WIDTH_CHANGE = 0.03, 0.4, 0.12
# Lines are compared at these shares of the depth, and lose strength if they miss the vanishing point by more than this
# many image widths at the far row.
_NEAR, _FAR = 1.0, 0.45
_MISS: Final = 0.02
# A single edge counts less than a pair: it may be one side of a wide band, or the edge of a road.
_SINGLE_EDGE: Final = 0.6


def hough_curves(lines: HoughLines, point: VanishingPoint, view: RoadView) -> tuple[Curves, FloatArray]:
    """Returns the boundaries along Hough lines, with the curvature of the road, and their strengths (N,).

    They are pairs of a rising and a falling edge that bound a bright marking, and single edges.
    """
    near = lines.x_bottom
    far = near - (_NEAR - _FAR) * view.depth * lines.slope
    rising, falling = np.flatnonzero(lines.rising), np.flatnonzero(~lines.rising)
    width = (near[None, falling] - near[rising, None]) / (_NEAR * view.depth)
    far_width = (far[None, falling] - far[rising, None]) / (_FAR * view.depth)
    i, j = np.nonzero((width >= _NARROWEST) & (width <= _WIDEST) & (np.abs(width - far_width) <= _WIDTH_CHANGE))
    left, right = rising[i], falling[j]
    # Paint is narrow: pairs wider than a single marking count less, down to a half for a double line.
    narrow = np.clip(1.3 - 2.0 * width[i, j], 0.5, 1.0)
    strength = np.concatenate(
        [2.0 * np.sqrt(lines.votes[left] * lines.votes[right]) * narrow, _SINGLE_EDGE * lines.votes]
    )
    columns = np.empty((len(strength), 2))
    columns[: len(left), 0], columns[len(left) :, 0] = 0.5 * (near[left] + near[right]), near
    columns[: len(left), 1], columns[len(left) :, 1] = 0.5 * (far[left] + far[right]), far
    # Through both columns with the road's curvature term.
    below = np.array([_NEAR, _FAR]) * view.depth
    straight = columns - point.k / below
    slope = (straight[:, 0] - straight[:, 1]) / (below[0] - below[1])
    v = straight[:, 0] - slope * below[0]
    curves = Curves(view.horizon, np.stack([v, slope, np.full(len(v), point.k)], axis=1))
    # Boundaries of one road share its vanishing point.
    miss = np.abs(v - point.x) * (1.0 - _FAR) / np.hypot(1.0, slope)
    return curves, strength * (0.2 + 0.8 / (1.0 + (miss / (_MISS * view.width)) ** 2))


def _accumulate(
    x: NDArray[np.float32], y: NDArray[np.float32], angle: NDArray[np.float32], weight: NDArray[np.float32], reach: int
) -> NDArray[np.float32]:
    """Returns the votes by rho, from -`reach` to `reach`, and theta, padded by `_PAD` columns of the other end.

    `x` and `y`, and so rho, are in cells. A pixel at rho across and t along the line of its own direction is at
    rho cos d + t sin d across a line that is rotated by d.
    """
    rotations = np.radians(np.arange(-_WINDOW, _WINDOW + 1)).astype(np.float32)
    direction: NDArray[np.int32] = np.rint(angle).astype(np.int32) % _CIRCLE
    radians = np.radians(np.arange(_CIRCLE)).astype(np.float32)
    cosine, sine = np.cos(radians)[direction], np.sin(radians)[direction]
    # Half a cell more, because the conversion to integers rounds down.
    rho = (x * cosine + y * sine)[:, None] * np.cos(rotations) + np.float32(reach + 0.5)
    rho += (y * cosine - x * sine)[:, None] * np.sin(rotations)
    margin = _WINDOW + _PAD
    columns = _CIRCLE + 2 * margin
    cell = rho.astype(np.int32)
    cell *= columns
    cell += direction[:, None]
    cell += np.arange(_PAD, _PAD + len(rotations), dtype=np.int32)
    votes = np.repeat(weight, len(rotations))
    size = (2 * reach + 1) * columns
    counts = np.bincount(cell.ravel(), votes, minlength=size).astype(np.float32).reshape(-1, columns)
    # Modulo the circle: a vote beyond 359 degrees counts at 0 degrees.
    counts[:, _CIRCLE : _CIRCLE + margin] += counts[:, :margin]
    counts[:, margin : 2 * margin] += counts[:, _CIRCLE + margin :]
    counts[:, :margin] = counts[:, _CIRCLE : _CIRCLE + margin]
    counts[:, _CIRCLE + margin :] = counts[:, margin : 2 * margin]
    return counts[:, _WINDOW : columns - _WINDOW]


def _peaks(
    accumulator: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Returns (rho index, theta in degrees, votes) of the strongest local maxima, to a fraction of a cell."""
    smooth = np.asarray(cv2.GaussianBlur(accumulator, (3, 3), 0.7), dtype=np.float32)
    # Few cells have enough votes. Only these are compared with their neighbors, up to two cells away.
    high = np.flatnonzero(smooth >= _LEAST_VOTES)
    rows, columns = np.divmod(high, smooth.shape[1])
    theta = columns - _PAD
    is_line = (theta >= 0) & (theta < _CIRCLE) & (_from_upright(theta) <= _FLATTEST)
    high = high[is_line & (rows >= 2) & (rows < len(smooth) - 2)]
    steps = np.arange(-2, 3)
    around = (steps[:, None] * smooth.shape[1] + steps).ravel()
    flat = smooth.ravel()
    high = high[flat[high] >= flat[high[:, None] + around].max(axis=1)]
    order = np.argsort(-flat[high], kind="stable")[:_MOST_LINES]
    rows, columns = np.divmod(high[order], smooth.shape[1])
    rho = rows + _vertex(smooth, rows, columns, (1, 0))
    angle = columns - _PAD + _vertex(smooth, rows, columns, (0, 1))
    return rho, angle, smooth[rows, columns].astype(np.float64)


def _from_upright(degrees: NDArray[Any]) -> NDArray[Any]:
    """Returns the angle between a line's normal and the horizontal, in degrees from 0 to 90."""
    away: NDArray[Any] = np.abs((degrees + 90.0) % 180.0 - 90.0)
    return away


def _vertex(
    surface: NDArray[np.float32], rows: NDArray[np.intp], columns: NDArray[np.intp], step: tuple[int, int]
) -> NDArray[np.float64]:
    """Returns the vertex of a parabola through each peak and its two neighbors along `step`, within half a cell."""
    dr, dc = step
    before = surface[rows - dr, columns - dc].astype(np.float64)
    here = surface[rows, columns].astype(np.float64)
    after = surface[rows + dr, columns + dc].astype(np.float64)
    curvature = before - 2.0 * here + after
    shift = np.where(curvature < -1e-6, 0.5 * (before - after) / np.minimum(curvature, -1e-6), 0.0)
    vertex: NDArray[np.float64] = np.clip(shift, -0.5, 0.5)
    return vertex
