"""The vanishing point of a frame's lines: where the road ends, and with it the horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.hough import HoughLines


@dataclass(frozen=True)
class VanishingPoint:
    """A point (x, y) of the working image and how much speaks for it, from 0 (a guess) to 1."""

    x: float
    y: float
    weight: float


@dataclass(frozen=True)
class VanishingPointSearch:
    """A vote of all lines over a grid of points, then a weighted least-squares step at the winner.

    A line supports a point with a Cauchy weight of its distance in units of `tolerance` image widths. The prior says
    that cameras look about ahead: the horizon lies near `middle` of the height, give or take `spread`.
    """

    tolerance: float = 0.012
    lowest: float = 0.72
    highest: float = 0.2
    middle: float = 0.46
    spread: float = 0.16

    def find(self, lines: HoughLines, width: int, height: int, horizon: float | None = None) -> VanishingPoint:
        """The vanishing point of `lines` in a `width` x `height` image; on the row `horizon` where that is known."""
        if len(lines) < 2:
            return VanishingPoint((width - 1) / 2.0, self._row(height, horizon), 0.0)
        step = width / 80.0
        columns = np.arange(0.1 * width, 0.9 * width, step)
        rows = np.arange(self.highest * height, self.lowest * height, step) if horizon is None else np.array([horizon])
        support = self._support(lines, columns, rows, width, height - 1.0)
        score = support + 0.15 * lines.votes.sum() * self._prior(columns, rows, width, height, horizon is not None)
        best = np.unravel_index(int(np.argmax(score)), score.shape)
        x, y = float(columns[best[1]]), float(rows[best[0]])
        weight = float(np.clip(2.0 * support[best] / lines.votes.sum(), 0.0, 1.0))
        for _ in range(3):
            x, y = self._step(lines, x, y, width, height - 1.0, horizon is not None)
        y = float(np.clip(y, self.highest * height, self.lowest * height))
        return VanishingPoint(float(np.clip(x, 0.0, width - 1.0)), y, weight)

    def _row(self, height: int, horizon: float | None) -> float:
        return self.middle * height if horizon is None else horizon

    def _prior(
        self, columns: NDArray[np.float64], rows: NDArray[np.float64], width: int, height: int, known: bool
    ) -> NDArray[np.float64]:
        across = ((columns / width - 0.5) / 0.25) ** 2
        down = np.zeros(len(rows)) if known else ((rows / height - self.middle) / self.spread) ** 2
        prior: NDArray[np.float64] = np.exp(-0.5 * (across[None, :] + down[:, None]))
        return prior

    def _support(
        self, lines: HoughLines, columns: NDArray[np.float64], rows: NDArray[np.float64], width: int, bottom: float
    ) -> NDArray[np.float64]:
        """Votes for each point of the grid; both ways of leaning must speak for it, or parallels would win."""
        at_rows = lines.x_bottom[None, :] + lines.slope[None, :] * (rows[:, None] - bottom)
        scale = self.tolerance * width * np.hypot(1.0, lines.slope)
        distance = (columns[None, :, None] - at_rows[:, None, :]) / scale
        kernel = lines.votes / (1.0 + distance**2)
        # A line that stands left of the point at the bottom belongs to the left half of the road.
        left = lines.x_bottom[None, None, :] < columns[None, :, None]
        on_left = (kernel * left).sum(axis=2)
        on_right = (kernel * ~left).sum(axis=2)
        support: NDArray[np.float64] = np.maximum(on_left, on_right) * 0.35 + np.minimum(on_left, on_right) * 1.65
        return support

    def _step(
        self, lines: HoughLines, x: float, y: float, width: int, bottom: float, known: bool
    ) -> tuple[float, float]:
        """One reweighted least-squares step towards the point that all supporting lines pass through."""
        residual = lines.x_bottom + lines.slope * (y - bottom) - x
        norm = np.hypot(1.0, lines.slope)
        distance = residual / norm / (self.tolerance * width)
        weight = lines.votes / (1.0 + distance**2) ** 2 / norm**2
        if known:
            return x + float((weight * residual).sum() / (weight.sum() + 1e-9)), y
        # Minimise sum w (residual + slope dy - dx)^2, damped so that parallel lines do not send it away.
        design = np.stack([np.ones(len(lines)), -lines.slope], axis=1)
        normal = design.T @ (design * weight[:, None]) + np.eye(2) * 1e-3 * weight.sum()
        move = np.linalg.solve(normal, design.T @ (weight * residual))
        limit = 0.03 * width
        return x + float(np.clip(move[0], -limit, limit)), y + float(np.clip(move[1], -limit, limit))
