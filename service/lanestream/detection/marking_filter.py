"""Ridges of a road: the centres of narrow bright bars, which markings are, row by row.

Seen along the boundaries of a perspective, a flat road has constant lane widths and constant marking widths. So the
road is unrolled to (row, slope) once; there every marking is a bar of known width and a box filter finds it, even where
dashes and dots leave too few edges. Under a perspective that is a little wrong bars lean, but are as wide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray
from lanestream.road.view import Image

if TYPE_CHECKING:
    from lanestream.detection.perspective import Perspective


@dataclass(frozen=True)
class Ridges:
    """Columns `x` and rows `y` (N,) of ridges in pixels, strongest first, and their `weight` (0 to 1) by contrast.

    `rows` are all rows that were searched.
    """

    x: FloatArray
    y: FloatArray
    weight: FloatArray
    rows: FloatArray

    def strongest(self, number: int) -> Ridges:
        """The first `number` of them."""
        return Ridges(self.x[:number], self.y[:number], self.weight[:number], self.rows)


@dataclass(frozen=True)
class RidgeSearch:
    """The search's settings; widths are slopes, columns a row, which on a flat road are metres over camera heights.

    The road is unrolled to `reach` on both sides in steps of `step`, on `rows` rows from `top_share` of the depth down
    to the bottom. Markings are about as wide as one of `widths`. `least` is the contrast from which on there is a
    ridge, `most` the one that no ridge can be surer than; the road's own unrest has a contrast of about 1.
    """

    reach: float = 6.5
    step: float = 0.02
    rows: int = 72
    top_share: float = 0.08
    widths: tuple[float, ...] = (0.06, 0.12)
    least: float = 0.5
    most: float = 3.0

    def find(self, grey: Image, guess: Perspective) -> Ridges:
        """The ridges of a grey working image (H, W) whose perspective is about `guess`."""
        height, width = grey.shape
        rows = np.linspace(guess.y + self.top_share * (height - 1.0 - guess.y), height - 1.0, self.rows)
        slopes = np.arange(-self.reach, self.reach + self.step / 2, self.step)
        columns = guess.columns(slopes, rows, height - 1.0).astype(np.float32)
        places = np.repeat(rows.astype(np.float32)[:, None], len(slopes), axis=1)
        road = cv2.remap(grey, columns, places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        contrast = self._contrast(np.asarray(road, np.uint8))
        highest = cv2.dilate(contrast, np.ones((1, self._cells(0.14)), np.uint8))
        row, cell = np.nonzero((contrast == highest) & (contrast > self.least))
        strength, x, y = contrast[row, cell], columns[row, cell].astype(float), rows[row]
        order = np.argsort(-strength, kind="stable")
        order = order[(x[order] >= 0.0) & (x[order] <= width - 1.0)]
        weight = np.minimum(strength[order].astype(float) / self.most, 1.0)
        return Ridges(x[order], y[order], weight, rows)

    def _contrast(self, road: NDArray[np.uint8]) -> NDArray[np.float32]:
        """How much brighter bars are than the brighter one of their neighbours, over the unrest around (row, slope)."""
        unrest = cv2.absdiff(road, cv2.blur(road, (self._cells(0.5), 1)))
        around = cv2.boxFilter(unrest, cv2.CV_32F, (self._cells(2.0), 9)) + 6.0
        best = np.zeros(road.shape, np.float32)
        for width in self.widths:
            cells = self._cells(width)
            side = cells + cells // 2
            mean = cv2.boxFilter(road, cv2.CV_32F, (cells, 1))
            darker = mean[:, side:-side] - np.maximum(mean[:, : -2 * side], mean[:, 2 * side :])
            np.maximum(best[:, side:-side], darker, out=best[:, side:-side])
        return np.asarray(best / around, np.float32)

    def _cells(self, width: float) -> int:
        """A width in cells, odd so that it has a middle."""
        return round(width / self.step) | 1
