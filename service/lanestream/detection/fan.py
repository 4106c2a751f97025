"""Lines through the vanishing point, found in one dimension.

Seen along the rays that leave the vanishing point, a flat road has constant lane widths and constant marking widths. So
the road is warped to (row, slope) once; there a marking is a vertical bar of known width, a box filter finds it, and
the mean over the rows gathers what dashes and dots leave, which edges alone would not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.perspective import Perspective
from lanestream.lanes import Image


@dataclass(frozen=True)
class FanLines:
    """Lines through the vanishing point: `slope` in columns a row, `strength` in ridge contrast, strongest first."""

    slope: NDArray[np.float64]
    strength: NDArray[np.float64]


@dataclass(frozen=True)
class Fan:
    """The search's settings, in slopes (columns a row), which on a flat road are metres over camera heights.

    Slopes run to `reach` on both sides in steps of `step`; a marking is `widths` wide; the rows from `top_share` of the
    depth down to the bottom count, `rows` of them; two lines are at least `separation` apart.
    """

    reach: float = 6.5
    step: float = 0.02
    widths: tuple[float, ...] = (0.06, 0.12)
    top_share: float = 0.12
    rows: int = 96
    separation: float = 0.16
    limit: int = 24

    def lines(self, grey: Image, point: Perspective) -> FanLines:
        """The strongest lines through `point` of a grey working image (H, W)."""
        slopes = np.arange(-self.reach, self.reach + self.step / 2, self.step)
        warped, inside = self._warp(grey, point, slopes)
        profile = self._profile(warped, inside)
        return self._peaks(slopes, profile)

    def _warp(
        self, grey: Image, point: Perspective, slopes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The road by (row, slope), and 1 where that is inside the image."""
        bottom = grey.shape[0] - 1.0
        rows = np.linspace(point.y + self.top_share * (bottom - point.y), bottom, self.rows)
        columns = point.columns(slopes, rows, bottom).astype(np.float32)
        row_map = np.broadcast_to(rows[:, None], columns.shape).astype(np.float32)
        warped = cv2.remap(grey, columns, row_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inside = (columns >= 0) & (columns <= grey.shape[1] - 1)
        return warped.astype(np.float32), inside.astype(np.float32)

    def _profile(self, warped: NDArray[np.float32], inside: NDArray[np.float32]) -> NDArray[np.float64]:
        """Mean ridge contrast of each slope over the rows in which it is in view."""
        around = cv2.blur(np.abs(warped - cv2.blur(warped, (25, 1))), (101, 9)) + 6.0
        best = np.zeros_like(warped)
        for width in self.widths:
            cells = max(1, round(width / self.step)) | 1
            mean = cv2.blur(warped, (cells, 1))
            shift = round(1.5 * cells)
            left, right = np.roll(mean, shift, axis=1), np.roll(mean, -shift, axis=1)
            best = np.maximum(best, mean - np.maximum(left, right))
        # Squared above a floor: a few bright dots count for more than a wheel track that is a little lighter all along.
        contrast = np.clip(best / around - 0.5, 0.0, 4.0) ** 2 * inside
        # Short stretches near the image's side would win on a few rows: they share the mean with 20 rows of nothing.
        profile: NDArray[np.float64] = contrast.sum(axis=0) / (inside.sum(axis=0) + 0.2 * self.rows)
        return profile

    def _peaks(self, slopes: NDArray[np.float64], profile: NDArray[np.float64]) -> FanLines:
        smooth = np.convolve(profile, [0.25, 0.5, 0.25], mode="same")
        cells = 2 * max(1, round(self.separation / self.step / 2)) + 1
        highest = cv2.dilate(smooth.reshape(1, -1), np.ones((1, cells), np.uint8)).ravel()
        peaks = np.flatnonzero((smooth == highest) & (smooth > 0.0))
        order = peaks[np.argsort(smooth[peaks], kind="stable")[::-1][: self.limit]]
        return FanLines(slopes[order], smooth[order])
