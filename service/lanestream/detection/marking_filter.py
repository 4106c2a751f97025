"""Filters that find boundaries row by row: bright bars between darker sides, and steps between two surfaces.

Painted markings are such bars; edges of the road are steps. The filters run on images whose rows are resampled in
proportion to their row offset, so that a marking has the same width in every row: on the road unrolled around its
vanishing point, and on strips along single curves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.features import Channels
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
# Ridges of one row are at least this far apart, and so are steps.
_SEPARATION: Final = 0.14
# Steps are searched on a coarser grid, with this distance between cells and this many rows. Both sides of one have this
# width.
COARSE: Final = 0.04
_COARSE_ROWS: Final = 36
_STEP_WIDTH: Final = 0.12


@dataclass(frozen=True)
class Ridges:
    """Centers of bars or of steps: columns `x` and rows `y` (N,) in pixels, strongest first.

    `weight` (N,) is from 0 to 1, and may be negative for steps. `rows` are all rows that were searched.
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


def step_contrast(image: NDArray[Any], width: int) -> NDArray[np.float32]:
    """Returns how much brighter the right side of each pixel of `image` (R, C) is than its left side.

    Both sides are `width` pixels wide.
    """
    offset = width // 2 + 1
    mean = cv2.boxFilter(image, cv2.CV_32F, (width, 1))
    padded = cv2.copyMakeBorder(mean, 0, 0, offset, offset, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.subtract(padded[:, 2 * offset :], padded[:, : -2 * offset]), np.float32)


def find_ridges(paint: Image, point: VanishingPoint) -> Ridges:
    """Returns the ridges of a gray working image (H, W) whose road has approximately the vanishing point `point`."""
    height, width = paint.shape
    rows = np.linspace(_top(point, height), height - 1.0, ROWS)
    grid = _Grid.around(point, width, rows, STEP)
    road = grid.sampled(paint)
    contrast = bar_contrast(road, [grid.cells(width) for width in _WIDTHS], gap=0.5) / grid.texture(road)
    return grid.peaks(np.maximum(contrast, 0.0))


def find_steps(channels: Channels, point: VanishingPoint) -> Ridges:
    """Returns the steps between surfaces in the channels of a frame whose road has the vanishing point `point`.

    The weight of a step is positive if its right side is brighter, else negative.
    """
    height, width = channels.paint.shape
    # Denser towards the horizon: the far edge of a wide road crosses only a few rows there.
    offsets = np.geomspace(_top(point, height) - point.y, height - 1.0 - point.y, _COARSE_ROWS)
    grid = _Grid.around(point, width, point.y + offsets, COARSE)
    steps = []
    for channel in (channels.paint, channels.blue):
        road = grid.sampled(channel)
        steps.append(step_contrast(road, grid.cells(_STEP_WIDTH)) / grid.texture(road))
    paint, blue = steps
    return grid.peaks(np.where(np.abs(paint) >= np.abs(blue), paint, blue))


@dataclass(frozen=True)
class _Grid:
    """The unrolled road: image `columns` (R, P) of all lateral positions on `rows` (R,), inside an image's `width`.

    Neighboring positions are `step` apart.
    """

    columns: NDArray[np.float32]
    rows: FloatArray
    width: int
    step: float

    @classmethod
    def around(cls, point: VanishingPoint, width: int, rows: FloatArray, step: float) -> _Grid:
        positions = np.arange(-REACH, REACH + step / 2, step)
        return cls(point.columns(positions, rows).astype(np.float32), rows, width, step)

    def cells(self, width: float) -> int:
        """Returns a width in cells of the unrolled road, odd so that it has a middle."""
        return round(width / self.step) | 1

    def sampled(self, image: Image) -> Image:
        row_map = np.repeat(self.rows.astype(np.float32)[:, None], self.columns.shape[1], axis=1)
        road = cv2.remap(image, self.columns, row_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(road, np.uint8)

    def peaks(self, contrast: NDArray[np.float32]) -> Ridges:
        """Returns the strongest points (N,) of each row, of either sign."""
        size = np.abs(contrast)
        highest = cv2.dilate(size, np.ones((1, self.cells(_SEPARATION)), np.uint8))
        inside = (self.columns >= 0.0) & (self.columns <= self.width - 1.0)
        row, cell = np.nonzero((size == highest) & (size > _LEAST_CONTRAST) & inside)
        order = np.argsort(-size[row, cell], kind="stable")
        row, cell = row[order], cell[order]
        weight = np.clip(contrast[row, cell].astype(float) / _FULL_CONTRAST, -1.0, 1.0)
        return Ridges(self.columns[row, cell].astype(float), self.rows[row], weight, self.rows)

    def texture(self, road: Image) -> NDArray[np.float32]:
        """Returns the mean texture around each pixel of the unrolled road (R, P), and a floor for noise."""
        texture = cv2.absdiff(road, cv2.blur(road, (self.cells(0.5), 1)))
        return np.asarray(cv2.boxFilter(texture, cv2.CV_32F, (self.cells(2.0), 9)) + 6.0, np.float32)


def _top(point: VanishingPoint, height: int) -> float:
    """Returns the highest row of an image in which boundaries are searched."""
    return max(point.y + TOP_SHARE * (height - 1.0 - point.y), 0.0)
