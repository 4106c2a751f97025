"""The vanishing point and curvature that all boundaries of a road share, and the lines through it.

On a flat road of constant curvature every boundary is x(y) = v + b u + k / u with u = y - h: v, h and k belong to the
road, b to the boundary (the hyperbola-pair model: K. Kluge, "Extracting road curvature and orientation from image edge
points without perceptual grouping into features", 1994). With the right v, h and k the ridges of all markings gather at
a few values of b. The search maximizes how sharply the ridges gather; the peaks are the lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.hough import HoughLines
from lanestream.detection.marking_filter import COARSE, REACH, STEP, Ridges
from lanestream.road.curve import FloatArray, VanishingPoint

# --- From Hough lines, if there is no prior -------------------------------------------------------------------------

# A line supports a point with a Cauchy weight; this is its scale in image widths.
_TOLERANCE: Final = 0.012
# The horizon's row as a fraction of the height: its usual limits, mean and standard deviation.
_HIGHEST, _LOWEST, _USUAL, _SPREAD = 0.2, 0.72, 0.46, 0.16
_GRID_COLUMNS: Final = 80
# A camera that looks down has its horizon higher, up to this fraction. Half as many rows are tried there.
_ABOVE: Final = -0.4


def vote_of_lines(lines: HoughLines, width: int, height: int, horizon: float | None = None) -> VanishingPoint:
    """Returns the vanishing point of `lines` in a `width` x `height` image, on the row `horizon` if that is known.

    All lines vote over a grid of points; weighted least squares then refines the winner. The row is negative if the
    point is above the image.
    """
    if len(lines) < 2:
        return VanishingPoint((width - 1) / 2.0, _USUAL * height if horizon is None else horizon)
    step = width / _GRID_COLUMNS
    columns = np.arange(0.1 * width, 0.9 * width, step)
    if horizon is None:
        above = np.arange(_ABOVE * height, _HIGHEST * height, 2.0 * step)
        rows = np.concatenate([above, np.arange(_HIGHEST * height, _LOWEST * height, step)])
    else:
        rows = np.array([horizon])
    support = _support(lines, columns, rows, width, height - 1.0)
    usual = ((columns / width - 0.5) / 0.25)[None, :] ** 2
    if horizon is None:
        usual = usual + ((rows / height - _USUAL) / _SPREAD)[:, None] ** 2
    score = support + 0.15 * lines.votes.sum() * np.exp(-0.5 * usual)
    best = np.unravel_index(int(np.argmax(score)), score.shape)
    x, y = float(columns[best[1]]), float(rows[best[0]])
    weight = float(np.clip(2.0 * support[best] / lines.votes.sum(), 0.0, 1.0))
    for _ in range(3):
        x, y = _least_squares_step(lines, x, y, width, height - 1.0, horizon is not None)
    if horizon is None:
        y = float(np.clip(y, _ABOVE * height, _LOWEST * height))
    return VanishingPoint(float(np.clip(x, 0.0, width - 1.0)), y, 0.0, weight)


def _support(lines: HoughLines, columns: FloatArray, rows: FloatArray, width: int, bottom: float) -> FloatArray:
    """Returns the votes (R, C) for each point of the grid.

    Lines from both sides of the road must support a point, or parallel lines would win.
    """
    at_rows = lines.x_bottom[None, :] + lines.slope[None, :] * (rows[:, None] - bottom)
    scale = _TOLERANCE * width * np.hypot(1.0, lines.slope)
    distance = columns[None, :, None] / scale - (at_rows / scale)[:, None, :]
    kernel = 1.0 / (1.0 + distance**2)
    on_left = lines.votes * (lines.x_bottom < columns[:, None])
    left = np.einsum("rcl,cl->rc", kernel, on_left)
    right = kernel @ lines.votes - left
    support: FloatArray = np.maximum(left, right) * 0.35 + np.minimum(left, right) * 1.65
    return support


def _least_squares_step(
    lines: HoughLines, x: float, y: float, width: int, bottom: float, row_known: bool
) -> tuple[float, float]:
    """Returns the point after one reweighted least-squares step towards where all supporting lines meet."""
    residual = lines.x_bottom + lines.slope * (y - bottom) - x
    norm = np.hypot(1.0, lines.slope)
    distance = residual / norm / (_TOLERANCE * width)
    weight = lines.votes / (1.0 + distance**2) ** 2 / norm**2
    if row_known:
        return x + float((weight * residual).sum() / (weight.sum() + 1e-9)), y
    # Minimize sum w (residual + slope dy - dx)^2, damped so that parallel lines do not move the point far away.
    design = np.stack([np.ones(len(lines)), -lines.slope], axis=1)
    normal = design.T @ (design * weight[:, None]) + np.eye(2) * 1e-3 * weight.sum()
    move = np.linalg.solve(normal, design.T @ (weight * residual))
    limit = 0.03 * width
    return x + float(np.clip(move[0], -limit, limit)), y + float(np.clip(move[1], -limit, limit))


# --- Refinement by the ridges ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SearchRange:
    """The range around a first guess in which the vanishing point and the curvature are searched for.

    `x` and `y` are in image widths; `curvature` is k over the squared depth. The search uses the strongest `ridges`.
    Each of the `rounds` (number, share) tries this number of values of all three, within this share of the range around
    the best values so far.
    """

    x: float
    y: float
    curvature: float
    ridges: int
    rounds: tuple[tuple[int, float], ...]


WIDE: Final = SearchRange(0.12, 0.1, 0.06, 1000, ((7, 1.0), (5, 0.3), (5, 0.1)))
# A known horizon moves only with the vehicle's pitch.
KNOWN_HORIZON: Final = SearchRange(0.12, 0.02, 0.06, 1000, ((7, 1.0), (5, 0.3), (5, 0.1)))
NEAR_PRIOR: Final = SearchRange(0.03, 0.01, 0.015, 300, ((3, 0.7), (3, 0.35), (3, 0.12)))

# The histogram on the bottom row: the width of a cell, and its reach from the middle, both in image widths.
_CELL: Final = 0.012
_CELLS_REACH: Final = 3.0
# The penalty of a hypothesis at the end of its range, as a share of the best score.
_PRIOR_PENALTY: Final = 0.15
_FEWEST_RIDGES: Final = 8


def refine(guess: VanishingPoint, ridges: Ridges, width: int, bottom: float, search: SearchRange) -> VanishingPoint:
    """Returns `guess` moved to where `ridges` gather most sharply, coarse to fine."""
    if len(ridges.x) < _FEWEST_RIDGES:
        return guess
    ridges = ridges.strongest(search.ridges)
    spread = np.array([search.x * width, search.y * width, search.curvature])
    start = np.array([guess.x, guess.y, guess.k / (bottom - guess.y) ** 2])
    best = start
    for steps, share in search.rounds:
        axes = best[:, None] + np.linspace(-share, share, steps) * spread[:, None]
        score = _sharpness(axes, ridges, width, bottom)
        x, y, curvature = ((axes - start[:, None]) / spread[:, None]) ** 2
        distance = x[:, None, None] + y[:, None] + curvature
        index = np.unravel_index(int(np.argmax(score - _PRIOR_PENALTY * score.max() * distance)), score.shape)
        best = axes[np.arange(3), index]
    x, y, curvature = best.tolist()
    return VanishingPoint(x, y, curvature * (bottom - y) ** 2, guess.weight)


def _sharpness(axes: FloatArray, ridges: Ridges, width: int, bottom: float) -> NDArray[np.float32]:
    """Returns how sharply the ridges gather for each hypothesis: the variance of a histogram about its smooth self.

    `axes` (3, S) are the hypotheses' x, y and curvatures; the result is (S, S, S). The histogram counts where the
    boundaries through the ridges cross the bottom row. Scattered points have the same variance however closely a
    hypothesis packs them, so a high horizon has no advantage.
    """
    # Single precision: a hundredth of a pixel on the bottom row, in half the time.
    x, y, curvature = axes.astype(np.float32)
    depth = np.float32(bottom) - y[:, None]
    nearness = depth / np.maximum(ridges.y.astype(np.float32) - y[:, None], np.float32(4.0))
    # A ridge crosses at x + (x_r - x - curvature depth n) n: one term with x, another with the curvature.
    with_x = x[:, None, None] * (np.float32(1.0) - nearness) + ridges.x.astype(np.float32) * nearness
    with_curvature = curvature[:, None] * (depth * nearness**2)[:, None]
    per_cell = np.float32(1.0 / (_CELL * width))
    cells = int(2 * _CELLS_REACH / _CELL)
    first = with_x * per_cell + np.float32((_CELLS_REACH - 0.5) / _CELL + 1.0)
    crossing = first[:, :, None] - with_curvature * per_cell
    # A cell at either end takes what lies beyond.
    np.clip(crossing, 0.0, np.float32(cells + 1), out=crossing)
    cell = crossing.astype(np.int32).reshape(axes.shape[1] ** 3, -1)
    cell += np.arange(len(cell), dtype=np.int32)[:, None] * (cells + 2)
    weight = np.broadcast_to(ridges.weight, cell.shape)
    counts = np.bincount(cell.ravel(), weight.ravel(), minlength=len(cell) * (cells + 2))
    counts = counts.reshape(len(cell), cells + 2)[:, 1:-1].astype(np.float32)
    sharp = cv2.blur(counts, (2, 1)) - cv2.blur(counts, (31, 1))
    sharpness: NDArray[np.float32] = np.einsum("ij,ij->i", sharp, sharp)
    return sharpness.reshape((axes.shape[1],) * 3)


# --- Lines through the vanishing point ------------------------------------------------------------------------------

# A ridge votes for lines within the first distance; two lines are at least the second apart. Both are differences of
# the lateral position b.
_VOTE_WIDTH: Final = 0.08
_SEPARATION: Final = 0.16
_MOST_LINES: Final = 24


@dataclass(frozen=True)
class FoundLines:
    """Lines through the vanishing point: lateral positions `positions` (N,) and `strength` (N,) in ridges per row.

    The strongest comes first.
    """

    positions: FloatArray
    strength: FloatArray


def find_lines(ridges: Ridges, point: VanishingPoint, width: int) -> FoundLines:
    """Returns the strongest lines through `point` in an image `width` pixels wide.

    This is a Hough transform in one dimension: each ridge votes for the lateral position of the line through it. The
    votes of dashes and dots add up over all rows.
    """
    # Squared, so that a few bright dots outweigh a wheel track that is slightly lighter over its whole length.
    return _lines(ridges, ridges.weight**2, point, width, STEP)


def find_step_lines(steps: Ridges, point: VanishingPoint, width: int) -> FoundLines:
    """Returns the strongest lines through `point` along steps of the same sign in an image `width` pixels wide.

    Noise has steps of both signs, whose votes cancel.
    """
    return _lines(steps, steps.weight, point, width, COARSE)


def _lines(points: Ridges, weights: FloatArray, point: VanishingPoint, width: int, step: float) -> FoundLines:
    """Returns the strongest lines by the votes of `points` with `weights` (N,), at positions that are `step` apart."""
    cells = np.arange(-REACH, REACH + step / 2, step)
    votes = np.abs(_votes(point.positions(points.x, points.y), weights, len(cells), step))
    # Lines that are visible in few rows, near the sides of the image, would win, so the mean includes some empty rows.
    profile = votes / (_visible_rows(cells, points.rows, point, width) + 0.2 * len(points.rows))
    window = 2 * max(1, round(_SEPARATION / step / 2)) + 1
    highest = cv2.dilate(profile.reshape(1, -1), np.ones((1, window), np.uint8)).ravel()
    peaks = np.flatnonzero((profile == highest) & (profile > 0.0))
    order = peaks[np.argsort(-profile[peaks], kind="stable")[:_MOST_LINES]]
    return FoundLines(cells[order], profile[order])


def _votes(positions: FloatArray, weight: FloatArray, cells: int, step: float) -> FloatArray:
    """Returns a smooth histogram (cells,) of the ridges' lateral positions, each counted in its two nearest cells."""
    position = np.clip((positions + REACH) / step, 0.0, cells - 1.001)
    cell = position.astype(int)
    right = (position - cell) * weight
    counts = np.bincount(cell, weight - right, cells) + np.bincount(cell + 1, right, cells)
    return np.convolve(counts, np.hanning(2 * round(_VOTE_WIDTH / step) + 1), mode="same")


def _visible_rows(positions: FloatArray, rows: FloatArray, point: VanishingPoint, width: int) -> FloatArray:
    """Returns in how many of `rows` the boundaries at `positions` (N,), in ascending order, are inside the image."""
    leftmost, rightmost = (np.sort(point.positions(np.full(len(rows), x), rows)) for x in (0.0, width - 1.0))
    visible = np.searchsorted(leftmost, positions, "right") - np.searchsorted(rightmost, positions, "left")
    return np.asarray(visible, float)
