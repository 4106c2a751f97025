"""The image that overlays are drawn on: polygons, lines and text whose sizes follow that of the image."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import ceil, floor
from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra
from lanestream_client.colors import DARK, Color

with needs_extra("video"):
    import cv2
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream_client.pixels import BgrImage

    FloatArray = NDArray[np.float64]

_FONT: Final = cv2.FONT_HERSHEY_DUPLEX
_SUBPIXEL_BITS: Final = 4
# An image of this size has scale 1.
_USUAL_PIXELS: Final = 1280 * 720
# Thinner lines disappear, and smaller text can't be read.
_LEAST_SCALE: Final = 0.4
_LEAST_TEXT_SCALE: Final = 0.62
# Text is drawn larger and scaled down: OpenCV's own letters are uneven in small sizes.
_OVERSAMPLING: Final = 4
# Steps of an opacity that changes with the row. More can't be seen.
_OPACITY_STEPS: Final = 48


@dataclass(frozen=True)
class Drawing:
    """An image to draw on. Sizes of lines are multiplied by `scale`, and those of text by `text_scale`.

    Both are 1 for an image of 1280 x 720 pixels and grow with its width and height. In small images, text shrinks less
    than lines.
    """

    image: BgrImage
    scale: float
    text_scale: float

    @classmethod
    def on_copy_of(cls, image: BgrImage) -> Drawing:
        """Returns a copy of `image`, BGR (H, W, 3) uint8, to draw on."""
        size = (image.shape[0] * image.shape[1] / _USUAL_PIXELS) ** 0.5
        return cls(np.array(image, order="C"), max(_LEAST_SCALE, size), max(_LEAST_TEXT_SCALE, size))

    def part(self, left: float, top: float, width: float, height: float) -> Drawing:
        """Returns a rectangle of this image to draw on, as far as it lies inside; they share their pixels."""
        rows = slice(max(0, round(top)), max(0, round(top + height)))
        columns = slice(max(0, round(left)), max(0, round(left + width)))
        return Drawing(self.image[rows, columns], self.scale, self.text_scale)

    def copy(self) -> Drawing:
        """Returns a copy, to be drawn on and then blended."""
        return Drawing(self.image.copy(), self.scale, self.text_scale)

    def blend(self, over: Drawing, rows: FloatArray, opacity: FloatArray) -> None:
        """Blends `over`, an image of the same size, into this one.

        The opacity of a row is interpolated between `opacity` (N,) at the ascending `rows` (N,).
        """
        edges = np.linspace(0, len(self.image), _OPACITY_STEPS + 1).astype(int)
        for start, end in pairwise(edges.tolist()):
            share = float(np.interp(0.5 * (start + end - 1), rows, opacity))
            if start < end:
                under = self.image[start:end]
                cv2.addWeighted(over.image[start:end], share, under, 1.0 - share, 0.0, dst=under)

    def polygon(self, points: FloatArray, color: Color, opacity: float = 1.0) -> None:
        """Fills the polygon with corners `points` (N, 2), anti-aliased, with subpixel precision."""
        fixed = np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        filled = self.image if opacity == 1.0 else self.image.copy()
        cv2.fillPoly(filled, [fixed], color, cv2.LINE_AA, _SUBPIXEL_BITS)
        if opacity < 1.0:
            cv2.addWeighted(filled, opacity, self.image, 1.0 - opacity, 0.0, dst=self.image)

    def line(self, points: FloatArray, color: Color, width: float) -> None:
        """Draws the line through `points` (N, 2), anti-aliased, with subpixel precision; `width` is scaled."""
        fixed = np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        thickness = max(1, round(width * self.scale))
        cv2.polylines(self.image, [fixed], False, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)

    def rectangle(self, left: float, top: float, width: float, height: float, color: Color) -> None:
        """Fills a rectangle."""
        right, bottom = left + width, top + height
        self.polygon(np.array([[left, top], [right, top], [right, bottom], [left, bottom]]), color)

    def text(self, text: str, at: tuple[float, float], color: Color, size: float = 0.55) -> None:
        """Writes `text` with its lower left corner `at`, as far as it lies inside the image."""
        font_scale, thickness = self._font(size)
        (width, height), below = cv2.getTextSize(text, _FONT, font_scale, thickness)
        # The image pixels that the text touches, and the same rectangle enlarged.
        left, top = floor(at[0]) - 1, floor(at[1] - height / _OVERSAMPLING) - 1
        right = ceil(at[0] + width / _OVERSAMPLING) + 1
        bottom = ceil(at[1] + below / _OVERSAMPLING) + 1
        large = np.zeros(((bottom - top) * _OVERSAMPLING, (right - left) * _OVERSAMPLING), np.uint8)
        origin = round((at[0] - left) * _OVERSAMPLING), round((at[1] - top) * _OVERSAMPLING)
        cv2.putText(large, text, origin, _FONT, font_scale, 255, thickness, cv2.LINE_8)
        mask = cv2.resize(large, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        inside = self.image[max(0, top) : max(0, bottom), max(0, left) : max(0, right)]
        rows, columns = max(0, -top), max(0, -left)
        share = mask[rows : rows + inside.shape[0], columns : columns + inside.shape[1], None] / np.float32(255.0)
        inside[:] = np.round(inside + share * (np.array(color, np.float32) - inside)).astype(np.uint8)

    def text_width(self, text: str, size: float = 0.55) -> float:
        """Returns the width of `text` in pixels."""
        return cv2.getTextSize(text, _FONT, *self._font(size))[0][0] / _OVERSAMPLING

    def darken(self) -> None:
        """Darkens the image as a background for text."""
        if self.image.size:
            cv2.addWeighted(self.image, 0.3, np.full_like(self.image, DARK), 0.7, 0.0, dst=self.image)

    def _font(self, size: float) -> tuple[float, int]:
        """Returns the scale and the thickness of the font for `text`, enlarged."""
        scale = _OVERSAMPLING * self.text_scale
        return size * scale, max(1, round(scale))
