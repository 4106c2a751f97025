"""The image that is being rendered, and drawing of lit, hazy shapes into it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lanestream.road.curve import FloatArray
    from lanestream.road.view import Image
    from lanestream_exporter.scenes.light import Atmosphere, SceneLight
    from lanestream_exporter.scenes.projection import RoadProjection
    from lanestream_exporter.scenes.surface import Color

SUBPIXEL_BITS = 4
FARTHEST_PIXEL = 20_000.0  # polygons are clamped to this, far outside any image, to stay within OpenCV's range


@dataclass(frozen=True)
class RenderTarget:
    """The image (H, W, 3) uint8, and the mask (H, W) of static objects that hide the road: walls, trees, houses."""

    image: Image
    hidden: Image
    projection: RoadProjection
    light: SceneLight
    atmosphere: Atmosphere

    def tone(self, color: Color, x: float, y: float) -> tuple[float, float, float]:
        """Returns the displayed color, 0 to 255, of an object at vehicle-frame (x, y)."""
        level = self.light.level(x, y)
        transmitted = self.atmosphere.transmittance(x)
        blue, green, red = (
            255.0 * min(1.0, part * level * transmitted + haze * (1.0 - transmitted))
            for part, haze in zip(color, self.atmosphere.color, strict=True)
        )
        return blue, green, red

    def polygon(self, points: FloatArray, tone: tuple[float, float, float], *, hides: bool = False) -> None:
        """Fills a polygon (N, 2) in image pixels; with `hides` the road behind it is also marked as hidden."""
        fixed = fixed_point(points)
        cv2.fillPoly(self.image, [fixed], tone, cv2.LINE_AA, SUBPIXEL_BITS)
        if hides:
            cv2.fillPoly(self.hidden, [fixed], (255.0,), cv2.LINE_8, SUBPIXEL_BITS)

    def blend(self, source: NDArray[np.float32], alpha: NDArray[np.float32], left: int, top: int) -> None:
        """Blends `source` (h, w, 3), 0 to 255, over the image at (left, top), clipped at the image border."""
        rows, columns = (
            overlap(top, source.shape[0], self.image.shape[0]),
            overlap(left, source.shape[1], self.image.shape[1]),
        )
        inside = (slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left))
        region = self.image[rows, columns]
        if region.size:
            mixed = region + alpha[inside][..., None] * (source[inside] - region)
            region[...] = mixed.astype(np.uint8)

    def glow(self, point: FloatArray, radius: float, strength: float) -> None:
        """Adds a soft white light around an image point that fades out within `radius` pixels."""
        size = round(radius)
        left, top = round(float(point[0])) - size, round(float(point[1])) - size
        distance = np.hypot(*np.ogrid[-size : size + 1, -size : size + 1]) / max(radius, 1.0)
        alpha = (strength * np.square(np.clip(1.0 - distance, 0.0, 1.0))).astype(np.float32)
        self.blend(np.full((*alpha.shape, 3), 255.0, np.float32), alpha, left, top)

    def darken(self, points: FloatArray, depth: float, softness: float) -> None:
        """Darkens a polygon by the share `depth`, with edges blurred over `softness` pixels."""
        margin = 2.0 * softness + 2.0
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        height, width = self.image.shape[:2]
        left, top = (int(np.clip(low[i], 0, limit)) for i, limit in ((0, width), (1, height)))
        right, bottom = (int(np.clip(high[i], 0, limit)) for i, limit in ((0, width), (1, height)))
        if right - left < 2 or bottom - top < 2:
            return
        mask = np.zeros((bottom - top, right - left), np.uint8)
        cv2.fillPoly(mask, [fixed_point(points - (left, top))], (255.0,), cv2.LINE_AA, SUBPIXEL_BITS)
        if softness > 0.4:
            mask = np.asarray(cv2.GaussianBlur(mask, (0, 0), softness), dtype=np.uint8)
        region = self.image[top:bottom, left:right]
        region[...] = (region * (1.0 - np.float32(depth / 255.0) * mask[..., None])).astype(np.uint8)


def overlap(start: int, length: int, limit: int) -> slice:
    """Returns the part of [start, start + length) that lies in [0, limit)."""
    first = min(max(start, 0), limit)
    return slice(first, max(first, min(start + length, limit)))


def fixed_point(points: FloatArray | Sequence[Sequence[float]]) -> NDArray[np.int32]:
    """Returns points in the fixed-point format of OpenCV's drawing calls with SUBPIXEL_BITS."""
    clamped = np.clip(np.asarray(points), -FARTHEST_PIXEL, FARTHEST_PIXEL)
    return np.asarray(np.round(clamped * (1 << SUBPIXEL_BITS)), dtype=np.int32)
