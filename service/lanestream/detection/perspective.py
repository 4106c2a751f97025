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

from lanestream.detection.marking_filter import Ridges
from lanestream.road.curve import FloatArray


@dataclass(frozen=True)
class Perspective:
    """The vanishing point (`x`, `y`) in pixels, and `bend`, which is k over the squared depth of the road.

    `weight` (0 to 1) tells how much of the frame's evidence speaks for it.
    """

    x: float
    y: float
    bend: float
    weight: float

    def columns(self, slopes: FloatArray, rows: FloatArray, bottom: float) -> FloatArray:
        """Columns (rows, slopes) of the boundaries with the bottom `slopes` at `rows`, both one-dimensional."""
        below = np.maximum(rows - self.y, 1.0)[:, None]
        columns: FloatArray = self.x + below * slopes[None, :] + self.k(bottom) / below
        return columns

    def slopes(self, columns: FloatArray, rows: FloatArray, bottom: float) -> FloatArray:
        """The bottom slopes (N,) of the boundaries through points, which are told by their columns and rows (N,)."""
        below = np.maximum(rows - self.y, 1.0)
        slopes: FloatArray = (columns - self.x - self.k(bottom) / below) / below
        return slopes

    def k(self, bottom: float) -> float:
        """The bend in pixels squared, for an image whose lowest row is `bottom`."""
        return self.bend * (bottom - self.y) ** 2


@dataclass(frozen=True)
class PerspectiveSearch:
    """Coarse to fine around a first guess.

    `spread_x` and `spread_y` are how far the vanishing point may lie from the guess, in image widths, and `spread_bend`
    the strongest bend; of a horizon that is known, the row is only `nod` away, as a camera nods on its wheels. Ridges
    gather in cells of `cell` image widths on the bottom row; `prior` is the share of the best score that a hypothesis
    at the end of its spread must make up for. Each of `rounds` tries so many values of all three, within so much of
    the spread about the best ones so far, on the `ridges` strongest ridges.
    """

    spread_x: float = 0.12
    spread_y: float = 0.1
    spread_bend: float = 0.06
    nod: float = 0.02
    cell: float = 0.012
    reach: float = 3.0
    prior: float = 0.15
    ridges: int = 1000
    rounds: tuple[tuple[int, float], ...] = ((7, 1.0), (5, 0.3), (5, 0.1))

    def refine(self, guess: Perspective, ridges: Ridges, width: int, bottom: float, known: bool) -> Perspective:
        """`guess` moved to where `ridges` gather most; `known` tells that its row is."""
        if len(ridges.x) < 8:
            return guess
        ridges = ridges.strongest(self.ridges)
        spread = np.array([self.spread_x * width, (self.nod if known else self.spread_y) * width, self.spread_bend])
        start = np.array([guess.x, guess.y, guess.bend])
        best = start
        for steps, share in self.rounds:
            axes = best[:, None] + np.linspace(-share, share, steps) * spread[:, None]
            score = self._gathering(axes, ridges, width, bottom)
            x, y, bend = ((axes - start[:, None]) / spread[:, None]) ** 2
            away = x[:, None, None] + y[:, None] + bend
            place = np.unravel_index(int(np.argmax(score - self.prior * score.max() * away)), score.shape)
            best = axes[np.arange(3), place]
        return replace(guess, x=float(best[0]), y=float(best[1]), bend=float(best[2]))

    def _gathering(self, axes: NDArray[np.float64], ridges: Ridges, width: int, bottom: float) -> NDArray[np.float32]:
        """How much each hypothesis gathers: the histogram's variance about its smooth self, (N, N, N).

        `axes` (3, N) are the hypotheses' x, y and bends. The histogram is that of where the ridges' boundaries cross
        the bottom row. Scattered points give the same variance however far a hypothesis draws them together, so that a
        high horizon has no advantage.
        """
        # Single precision: a hundredth of a pixel on the bottom row, at half the time.
        x, y, bend = axes.astype(np.float32)
        depth = np.float32(bottom) - y[:, None]
        nearness = depth / np.maximum(ridges.y.astype(np.float32) - y[:, None], np.float32(4.0))
        # A ridge crosses at x + (x_r - x - bend depth n) n: a part with x, another with the bend.
        with_x = x[:, None, None] * (np.float32(1.0) - nearness) + ridges.x.astype(np.float32) * nearness
        with_bend = bend[:, None] * (depth * nearness**2)[:, None]
        per_cell = np.float32(1.0 / (self.cell * width))
        cells = int(2 * self.reach / self.cell)
        first = with_x * per_cell + np.float32((self.reach - 0.5) / self.cell + 1.0)
        crossing = first[:, :, None] - with_bend * per_cell
        # A cell at either end takes what lies beyond.
        np.clip(crossing, 0.0, np.float32(cells + 1), out=crossing)
        cell = crossing.astype(np.int32).reshape(axes.shape[1] ** 3, -1)
        cell += np.arange(len(cell), dtype=np.int32)[:, None] * (cells + 2)
        weight = np.broadcast_to(ridges.weight, cell.shape)
        counts = np.bincount(cell.ravel(), weight.ravel(), minlength=len(cell) * (cells + 2))
        counts = counts.reshape(len(cell), cells + 2)[:, 1:-1].astype(np.float32)
        sharp = cv2.blur(counts, (2, 1)) - cv2.blur(counts, (31, 1))
        gathering: NDArray[np.float32] = np.einsum("ij,ij->i", sharp, sharp)
        return gathering.reshape((axes.shape[1],) * 3)
