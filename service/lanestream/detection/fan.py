"""Lines through the vanishing point, found in one dimension: where the ridges of the road gather.

A ridge says which of the boundaries that share a perspective it would belong to. What dashes and dots leave is gathered
over all rows, which edges alone would not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lanestream.detection.marking_filter import Ridges
from lanestream.detection.perspective import Perspective
from lanestream.road.curve import FloatArray


@dataclass(frozen=True)
class FanLines:
    """Lines through the vanishing point: `slope` in columns a row, `strength` in ridges a row, strongest first."""

    slope: FloatArray
    strength: FloatArray


@dataclass(frozen=True)
class Fan:
    """The search's settings, in slopes (columns a row), which on a flat road are metres over camera heights.

    Slopes run to `reach` on both sides in steps of `step`. Ridges count for lines nearer than `spread`; two lines are
    at least `separation` apart.
    """

    reach: float = 6.5
    step: float = 0.02
    spread: float = 0.08
    separation: float = 0.16
    limit: int = 24

    def lines(self, ridges: Ridges, point: Perspective, width: int, bottom: float) -> FanLines:
        """The strongest lines through `point` of an image `width` pixels wide, whose lowest row is `bottom`."""
        slopes = np.arange(-self.reach, self.reach + self.step / 2, self.step)
        gathered = self._gathered(point.slopes(ridges.x, ridges.y, bottom), ridges.weight, len(slopes))
        # Short stretches near the image's side would win on a few rows: they share the mean with rows of nothing.
        profile = gathered / (_rows_in_view(slopes, ridges.rows, point, width, bottom) + 0.2 * len(ridges.rows))
        cells = 2 * max(1, round(self.separation / self.step / 2)) + 1
        highest = cv2.dilate(profile.reshape(1, -1), np.ones((1, cells), np.uint8)).ravel()
        peaks = np.flatnonzero((profile == highest) & (profile > 0.0))
        order = peaks[np.argsort(-profile[peaks], kind="stable")[: self.limit]]
        return FanLines(slopes[order], profile[order])

    def _gathered(self, slopes: FloatArray, weight: FloatArray, cells: int) -> FloatArray:
        """A smooth histogram (cells,) of the ridges' slopes (N,), each counted in its two nearest cells."""
        place = np.clip((slopes + self.reach) / self.step, 0.0, cells - 1.001)
        cell = place.astype(int)
        # Squared: a few bright dots count for more than a wheel track that is a little lighter all along.
        right = (place - cell) * weight**2
        counts = np.bincount(cell, weight**2 - right, cells) + np.bincount(cell + 1, right, cells)
        return np.convolve(counts, np.hanning(2 * round(self.spread / self.step) + 1), mode="same")


def _rows_in_view(slopes: FloatArray, rows: FloatArray, point: Perspective, width: int, bottom: float) -> FloatArray:
    """On how many of `rows` the boundaries with the `slopes` (N,), in rising order, are inside the image."""
    leftmost, rightmost = (np.sort(point.slopes(np.full(len(rows), x), rows, bottom)) for x in (0.0, width - 1.0))
    in_view = np.searchsorted(leftmost, slopes, "right") - np.searchsorted(rightmost, slopes, "left")
    return np.asarray(in_view, float)
