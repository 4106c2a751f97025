"""The extended Hough transform: lines from edge pixels that vote only near their gradient's direction.

The angle axis covers the full circle, so the two edges of a marking, whose gradients are opposite, are peaks 180
degrees apart and can be told from each other. Sources: F. O'Gorman and M. B. Clowes, "Finding picture edges through
collinearity of feature points", 1976 (votes limited by the gradient); T. Petkovic and S. Loncaric, arXiv 1510.04863
(the full circle).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.edges import Edges

_CIRCLE = 360


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

    `window` is how far from its gradient's direction a pixel votes, in degrees to either side; `max_slope` leaves out
    lines flatter than that many columns a row; `limit` is the most lines that are handed on.
    """

    window: float = 12.0
    max_slope: float = 7.0
    min_votes: float = 6.0
    limit: int = 80

    def lines(self, edges: Edges, width: int, bottom: float) -> HoughLines:
        """Lines in `edges` of an image `width` pixels wide, told at the row `bottom`."""
        origin_x, origin_y = (width - 1) / 2.0, bottom
        accumulator, reach = self._accumulate(edges, origin_x, origin_y)
        rho, theta, votes = self._peaks(accumulator)
        angle = np.radians(theta)
        slope = -np.tan(angle)
        x_bottom = origin_x + (rho - reach) / np.cos(angle)
        return HoughLines(x_bottom, slope, np.cos(angle) > 0.0, votes)

    def _accumulate(self, edges: Edges, origin_x: float, origin_y: float) -> tuple[NDArray[np.float32], int]:
        x, y, angle, weight = self._steep(edges, origin_x, origin_y)
        reach = int(np.ceil(np.hypot(origin_x, origin_y))) + 2
        spread = np.arange(-int(self.window), int(self.window) + 1)
        # Modulo the circle: a vote beyond 359 degrees is one at 0 degrees, not a lost or a shifted one.
        theta = (np.rint(angle).astype(np.int64)[:, None] + spread) % _CIRCLE
        turns = np.radians(np.arange(_CIRCLE)).astype(np.float32)
        cosine, sine = np.cos(turns), np.sin(turns)
        rho = np.rint(x[:, None] * cosine[theta] + y[:, None] * sine[theta]).astype(np.int64) + reach
        votes = np.broadcast_to(weight[:, None], theta.shape)
        size = 2 * reach + 1
        counts = np.bincount((rho * _CIRCLE + theta).ravel(), votes.ravel(), minlength=size * _CIRCLE)
        return counts.reshape(size, _CIRCLE).astype(np.float32), reach

    def _steep(
        self, edges: Edges, origin_x: float, origin_y: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Pixels that can belong to a line steep enough, about the origin; the others would only cost votes."""
        flattest = np.degrees(np.arctan(self.max_slope))
        from_horizontal = np.abs((edges.angle + 90.0) % 180.0 - 90.0)
        keep = from_horizontal <= flattest
        return edges.x[keep] - origin_x, edges.y[keep] - origin_y, edges.angle[keep], edges.weight[keep]

    def _peaks(
        self, accumulator: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """(rho index, theta in degrees, votes) of the strongest local maxima, to a fraction of a cell."""
        pad = 3
        wrapped = np.hstack([accumulator[:, -pad:], accumulator, accumulator[:, :pad]])
        smooth = np.asarray(cv2.GaussianBlur(wrapped, (3, 3), 0.7), dtype=np.float32)
        highest = cv2.dilate(smooth, np.ones((5, 5), np.uint8))
        is_peak = (smooth == highest) & (smooth >= self.min_votes)
        is_peak[:, :pad] = is_peak[:, -pad:] = False
        is_peak[:1] = is_peak[-1:] = False
        theta = np.arange(-pad, _CIRCLE + pad)
        flattest = np.degrees(np.arctan(self.max_slope))
        is_peak[:, np.abs((theta + 90.0) % 180.0 - 90.0) > flattest] = False
        rows, columns = np.nonzero(is_peak)
        order = np.argsort(smooth[rows, columns], kind="stable")[::-1][: self.limit]
        rows, columns = rows[order], columns[order]
        rho = rows + _vertex(smooth, rows, columns, (1, 0))
        angle = theta[columns] + _vertex(smooth, rows, columns, (0, 1))
        return rho, angle, smooth[rows, columns].astype(np.float64)


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
