"""The perspective that all boundaries of a road share: vanishing point, horizon and bend.

On a flat road of constant curvature every boundary is x(y) = v + b (y - h) + k / (y - h): v, h and k belong to the road
and b to the boundary (the hyperbola-pair model: K. Kluge, "Extracting road curvature and orientation from image edge
points without perceptual grouping into features", 1994). Under the right v, h and k the bright ridges of all markings
gather at few values of b, so the three are searched for by how sharply they gather.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.lanes import Image


@dataclass(frozen=True)
class Perspective:
    """The vanishing point (`x`, `y`) in pixels, and `bend`, which is k over the squared depth of the road.

    `weight` (0 to 1) tells how much of the frame's evidence speaks for it.
    """

    x: float
    y: float
    bend: float
    weight: float

    def columns(self, slopes: NDArray[np.float64], rows: NDArray[np.float64], bottom: float) -> NDArray[np.float64]:
        """Columns (rows, slopes) of the boundaries with the bottom `slopes` at `rows`, both one-dimensional."""
        below = np.maximum(rows - self.y, 1.0)[:, None]
        columns: NDArray[np.float64] = self.x + below * slopes[None, :] + self.k(bottom) / below
        return columns

    def k(self, bottom: float) -> float:
        """The bend in pixels squared, for an image whose lowest row is `bottom`."""
        return self.bend * (bottom - self.y) ** 2


@dataclass(frozen=True)
class RidgePoints:
    """Centres of narrow bright bars, a row at a time: column, row and contrast (0 to 1) of each."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    weight: NDArray[np.float64]


def find_ridges(grey: Image, horizon: float, width: float = 0.1, limit: int = 1000) -> RidgePoints:
    """The strongest local maxima of a bar filter that is `width` times the depth of each row wide, in a grey image."""
    height, columns = grey.shape
    rows = np.unique(np.linspace(horizon + 0.08 * (height - 1 - horizon), height - 1, 112).astype(int))
    half = np.maximum(np.rint(0.5 * width * (rows - horizon)), 1).astype(int)
    total = np.pad(np.cumsum(grey[rows].astype(np.float32), axis=1), ((0, 0), (1, 0)))
    x = np.arange(columns)

    def mean(shift: NDArray[np.int_]) -> NDArray[np.float32]:
        start = np.clip(x[None, :] + (shift - half)[:, None], 0, columns - 1)
        stop = np.clip(x[None, :] + (shift + half)[:, None] + 1, 1, columns)
        area = np.take_along_axis(total, stop, axis=1) - np.take_along_axis(total, start, axis=1)
        return np.asarray(area / np.maximum(stop - start, 1), dtype=np.float32)

    sides = 2 * half + 1
    ridge = mean(np.zeros_like(half)) - np.maximum(mean(-sides), mean(sides))
    contrast = np.clip(ridge / (3.0 * cv2.blur(np.abs(ridge), (161, 5)) + 3.0), 0.0, 1.0)
    peak = (ridge == cv2.dilate(ridge, np.ones((1, 7), np.uint8))) & (contrast > 0.15)
    found, at = np.nonzero(peak)
    weight = contrast[found, at]
    order = np.argsort(weight, kind="stable")[::-1][:limit]
    return RidgePoints(at[order].astype(float), rows[found[order]].astype(float), weight[order].astype(float))


@dataclass(frozen=True)
class PerspectiveSearch:
    """Coarse to fine around a first guess.

    `spread_x` and `spread_y` are how far the vanishing point may lie from the guess, in image widths, and `spread_bend`
    the strongest bend; of a horizon that is known, the row is only `nod` away, as a camera nods on its wheels. Ridges
    gather in cells of `cell` image widths on the bottom row; `prior` is the share of the best score that a hypothesis
    at the end of its spread must make up for.
    """

    spread_x: float = 0.12
    spread_y: float = 0.1
    spread_bend: float = 0.06
    nod: float = 0.02
    cell: float = 0.012
    reach: float = 3.0
    prior: float = 0.15

    def refine(self, guess: Perspective, ridges: RidgePoints, width: int, bottom: float, known: bool) -> Perspective:
        """`guess` moved to where `ridges` gather most; `known` tells that its row is."""
        if len(ridges.x) < 8:
            return guess
        spread = np.array([self.spread_x * width, (self.nod if known else self.spread_y) * width, self.spread_bend])
        start = np.array([guess.x, guess.y, guess.bend])
        best = start
        for steps, share in ((7, 1.0), (5, 0.3), (5, 0.1)):
            axes = [np.linspace(-reach, reach, steps) for reach in spread * share]
            hypotheses = best + np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
            score = self._gathering(hypotheses, ridges, width, bottom)
            away = ((hypotheses - start) / spread) ** 2
            best = hypotheses[int(np.argmax(score - self.prior * score.max() * away.sum(axis=1)))]
        return replace(guess, x=float(best[0]), y=float(best[1]), bend=float(best[2]))

    def _gathering(
        self, hypotheses: NDArray[np.float64], ridges: RidgePoints, width: int, bottom: float
    ) -> NDArray[np.float32]:
        """How much each hypothesis (N, 3) of (x, y, bend) gathers: the histogram's variance about its smooth self.

        The histogram is that of where the ridges' boundaries cross the bottom row. Scattered points give the same
        variance however far a hypothesis draws them together, so that a high horizon has no advantage.
        """
        # Single precision: a hundredth of a pixel on the bottom row, at half the time.
        x, y, bend = hypotheses.astype(np.float32).T[:, :, None]
        depth = np.float32(bottom) - y
        nearness = depth / np.maximum(ridges.y.astype(np.float32) - y, np.float32(4.0))
        crossing = x + (ridges.x.astype(np.float32) - x - bend * depth * nearness) * nearness
        cells = int(2 * self.reach / self.cell)
        # A cell at either end takes what lies beyond.
        cell = (
            crossing * np.float32(1.0 / (self.cell * width)) + np.float32((self.reach - 0.5) / self.cell + 1.0)
        ).astype(np.int32)
        np.clip(cell, 0, cells + 1, out=cell)
        cell += np.arange(len(hypotheses), dtype=np.int32)[:, None] * (cells + 2)
        weight = np.broadcast_to(ridges.weight, cell.shape)
        counts = np.bincount(cell.ravel(), weight.ravel(), minlength=len(hypotheses) * (cells + 2))
        counts = counts.reshape(len(hypotheses), cells + 2)[:, 1:-1].astype(np.float32)
        sharp = cv2.blur(counts, (2, 1)) - cv2.blur(counts, (31, 1))
        gathering: NDArray[np.float32] = (sharp**2).sum(axis=1)
        return gathering
