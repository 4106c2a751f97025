"""The marking filter: finds narrow bright bars between darker sides, which is what painted markings are, row by row.

It runs on images whose rows are resampled in proportion to their row offset, so that a marking has the same width in
every row: on the road unrolled around its vanishing point, and on strips along single curves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray, VanishingPoint
from lanestream.road.view import Image

# The unrolled road: lateral positions up to this far on both sides in steps of STEP, on ROWS rows from TOP_SHARE of the
# depth down to the bottom. Lateral positions are in columns per row offset: meters over the camera's height.
REACH: Final = 6.5
STEP: Final = 0.02
ROWS: Final = 72
TOP_SHARE: Final = 0.08

# Markings are about as wide as one of these.
_WIDTHS: Final = (0.06, 0.12)
# Contrast is relative to the texture of the road. A ridge has at least the first value; from the second value on its
# weight is 1.
_LEAST_CONTRAST: Final = 0.5
_FULL_CONTRAST: Final = 3.0
# Ridges of one row are at least this far apart.
_SEPARATION: Final = 0.14


@dataclass(frozen=True)
class Ridges:
    """Centers of bright bars: columns `x` and rows `y` (N,) in pixels, strongest first, with `weight` (N,), 0 to 1.

    `rows` are all rows that were searched.
    """

    x: FloatArray
    y: FloatArray
    weight: FloatArray
    rows: FloatArray

    def strongest(self, number: int) -> Ridges:
        """Returns the first `number` ridges."""
        return Ridges(self.x[:number], self.y[:number], self.weight[:number], self.rows)


def bar_contrast(image: NDArray[Any], widths: Sequence[int], gap: float = 0.0) -> NDArray[np.float32]:
    """Returns how much brighter a bar centered at each pixel is than the brighter of its two sides.

    `image` is (R, C); bars and sides are one of the `widths` in pixels (odd), with `gap` widths between them. Of
    several widths the highest contrast counts. Beyond the left and right border the last pixel repeats.
    """
    best: NDArray[np.float32] | None = None
    for width in widths:
        offset = width + int(gap * width)
        mean = cv2.boxFilter(image, cv2.CV_32F, (width, 1))
        padded = cv2.copyMakeBorder(mean, 0, 0, offset, offset, cv2.BORDER_REPLICATE)
        sides = cv2.max(padded[:, : -2 * offset], padded[:, 2 * offset :])
        contrast = np.asarray(cv2.subtract(mean, sides), np.float32)
        best = contrast if best is None else np.maximum(best, contrast, out=best)
    assert best is not None  # noqa: S101 - widths are never empty
    return best


def find_ridges(gray: Image, point: VanishingPoint) -> Ridges:
    """Returns the ridges of a gray working image (H, W) whose road has approximately the vanishing point `point`."""
    height, width = gray.shape
    rows = np.linspace(point.y + TOP_SHARE * (height - 1.0 - point.y), height - 1.0, ROWS)
    positions = np.arange(-REACH, REACH + STEP / 2, STEP)
    columns = point.columns(positions, rows).astype(np.float32)
    row_map = np.repeat(rows.astype(np.float32)[:, None], len(positions), axis=1)
    road = np.asarray(cv2.remap(gray, columns, row_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    texture = cv2.absdiff(road, cv2.blur(road, (_cells(0.5), 1)))
    around = cv2.boxFilter(texture, cv2.CV_32F, (_cells(2.0), 9)) + 6.0
    contrast = bar_contrast(road, [_cells(width) for width in _WIDTHS], gap=0.5) / around
    highest = cv2.dilate(contrast, np.ones((1, _cells(_SEPARATION)), np.uint8))
    inside = (columns >= 0.0) & (columns <= width - 1.0)
    row, cell = np.nonzero((contrast == highest) & (contrast > _LEAST_CONTRAST) & inside)
    strength = contrast[row, cell]
    order = np.argsort(-strength, kind="stable")
    row, cell = row[order], cell[order]
    weight = np.minimum(strength[order].astype(float) / _FULL_CONTRAST, 1.0)
    return Ridges(columns[row, cell].astype(float), rows[row], weight, rows)


def _cells(width: float) -> int:
    """Returns a width in cells of the unrolled road, odd so that it has a middle."""
    return round(width / STEP) | 1
