"""The extended Hough transform: lines from edge pixels that vote only near their gradient's direction.

The angle axis covers the full circle, so the two edges of a marking, whose gradients are opposite, are peaks 180
degrees apart and can be told from each other. Sources: F. O'Gorman and M. B. Clowes, "Finding picture edges through
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

_CIRCLE: Final = 360

# Columns by which the angle axis goes on at either end, so that peaks there have all their neighbours.
_PAD: Final = 3


@dataclass(frozen=True)
class HoughLines:
    """Lines of a working image, strongest first, one entry a line.

    A line is told as x(y) = `x_bottom` + `slope` (y - bottom row). `rising` is True where the image gets brighter from
    left to right across it (the left edge of a bright marking). `votes` is the accumulator's weight.
    """

    x_bottom: NDArray[np.float64]
    slope: NDArray[np.float64]
    rising: NDArray[np.bool_]
    votes: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.votes)


@dataclass(frozen=True)
class ExtendedHough:
    """The transform's settings.

    `window` is how far from its gradient's direction a pixel votes, in degrees to either side; cells are `cell` pixels
    wide; `max_slope` leaves out lines flatter than that many columns a row; `limit` is the most lines that are handed
    on.
    """

    window: int = 8
    cell: float = 1.5
    max_slope: float = 7.0
    min_votes: float = 6.0
    limit: int = 80

    def lines(self, edges: Edges, width: int, bottom: float) -> HoughLines:
        """Lines in `edges` of an image `width` pixels wide, told at the row `bottom`."""
        origin_x, origin_y = (width - 1) / 2.0, bottom
        x, y, angle, weight = self._steep(edges, origin_x, origin_y)
        if not len(x):
            nothing = np.empty(0)
            return HoughLines(nothing, nothing, nothing > 0.0, nothing)
        reach = int(np.ceil(np.hypot(origin_x / self.cell, float(np.abs(y).max())))) + 2
        rho, theta, votes = self._peaks(self._accumulate(x, y, angle, weight, reach))
        radians = np.radians(theta)
        slope = -np.tan(radians)
        x_bottom = origin_x + self.cell * (rho - reach) / np.cos(radians)
        return HoughLines(x_bottom, slope, np.cos(radians) > 0.0, votes)

    def _accumulate(
        self,
        x: NDArray[np.float32],
        y: NDArray[np.float32],
        angle: NDArray[np.float32],
        weight: NDArray[np.float32],
        reach: int,
    ) -> NDArray[np.float32]:
        """Votes by rho, from -`reach` to `reach`, and theta, with `_PAD` columns of the other end at either end.

        `x` and `y`, and so rho, are in cells.

        A pixel that lies at rho and t, across and along the line of its own direction, lies at rho cos d + t sin d
        across one that is turned by d.
        """
        window = self.window
        turns = np.radians(np.arange(-window, window + 1)).astype(np.float32)
        direction: NDArray[np.int32] = np.rint(angle).astype(np.int32) % _CIRCLE
        radians = np.radians(np.arange(_CIRCLE)).astype(np.float32)
        cosine, sine = np.cos(radians)[direction], np.sin(radians)[direction]
        # Half a cell more, because what follows rounds down.
        rho = (x * cosine + y * sine)[:, None] * np.cos(turns) + np.float32(reach + 0.5)
        rho += (y * cosine - x * sine)[:, None] * np.sin(turns)
        margin = window + _PAD
        columns = _CIRCLE + 2 * margin
        cell = rho.astype(np.int32)
        cell *= columns
        cell += direction[:, None]
        cell += np.arange(_PAD, _PAD + len(turns), dtype=np.int32)
        votes = np.repeat(weight, len(turns))
        size = (2 * reach + 1) * columns
        counts = np.bincount(cell.ravel(), votes, minlength=size).astype(np.float32).reshape(-1, columns)
        # Modulo the circle: a vote beyond 359 degrees is one at 0 degrees, not a lost or a shifted one.
        counts[:, _CIRCLE : _CIRCLE + margin] += counts[:, :margin]
        counts[:, margin : 2 * margin] += counts[:, _CIRCLE + margin :]
        counts[:, :margin] = counts[:, _CIRCLE : _CIRCLE + margin]
        counts[:, _CIRCLE + margin :] = counts[:, margin : 2 * margin]
        return counts[:, window : columns - window]

    def _steep(
        self, edges: Edges, origin_x: float, origin_y: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Pixels that can belong to a line steep enough, in cells from the origin; the others would only cost votes."""
        keep = np.flatnonzero(_from_upright(edges.angle) <= self._flattest)
        x, y = edges.x[keep] - np.float32(origin_x), edges.y[keep] - np.float32(origin_y)
        return x / np.float32(self.cell), y / np.float32(self.cell), edges.angle[keep], edges.weight[keep]

    @property
    def _flattest(self) -> float:
        return math.degrees(math.atan(self.max_slope))

    def _peaks(
        self, accumulator: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(rho index, theta in degrees, votes) of the strongest local maxima, to a fraction of a cell."""
        smooth = np.asarray(cv2.GaussianBlur(accumulator, (3, 3), 0.7), dtype=np.float32)
        # Few cells have enough votes, so only those are compared with their neighbours, two cells to either side.
        high = np.flatnonzero(smooth >= self.min_votes)
        rows, columns = np.divmod(high, smooth.shape[1])
        theta = columns - _PAD
        is_line = (theta >= 0) & (theta < _CIRCLE) & (_from_upright(theta) <= self._flattest)
        high = high[is_line & (rows >= 2) & (rows < len(smooth) - 2)]
        steps = np.arange(-2, 3)
        around = (steps[:, None] * smooth.shape[1] + steps).ravel()
        flat = smooth.ravel()
        high = high[flat[high] >= flat[high[:, None] + around].max(axis=1)]
        order = np.argsort(-flat[high], kind="stable")[: self.limit]
        rows, columns = np.divmod(high[order], smooth.shape[1])
        rho = rows + _vertex(smooth, rows, columns, (1, 0))
        angle = columns - _PAD + _vertex(smooth, rows, columns, (0, 1))
        return rho, angle, smooth[rows, columns].astype(np.float64)


def _from_upright(degrees: NDArray[Any]) -> NDArray[Any]:
    """How far a line's normal is from the horizontal, and the line from upright, in degrees from 0 to 90."""
    away: NDArray[Any] = np.abs((degrees + 90.0) % 180.0 - 90.0)
    return away


def _vertex(
    surface: NDArray[np.float32], rows: NDArray[np.intp], columns: NDArray[np.intp], step: tuple[int, int]
) -> NDArray[np.float64]:
    """Where a parabola through each peak and its two neighbours along `step` has its vertex, within half a cell."""
    dr, dc = step
    before = surface[rows - dr, columns - dc].astype(np.float64)
    here = surface[rows, columns].astype(np.float64)
    after = surface[rows + dr, columns + dc].astype(np.float64)
    curvature = before - 2.0 * here + after
    shift = np.where(curvature < -1e-6, 0.5 * (before - after) / np.minimum(curvature, -1e-6), 0.0)
    vertex: NDArray[np.float64] = np.clip(shift, -0.5, 0.5)
    return vertex
