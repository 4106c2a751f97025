"""The image that overlays are drawn on, and their colors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra

with needs_extra("video"):
    import cv2
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream_client.pixels import BgrImage

    FloatArray = NDArray[np.float64]

Color = tuple[int, int, int]

# Blue, green, red. People with red-green color blindness can distinguish these colors, too.
POSITIONS: Final[dict[int, tuple[Color, str]]] = {
    -2: ((200, 120, 220), "next left"),
    -1: ((40, 170, 255), "ego left"),
    1: ((255, 190, 70), "ego right"),
    2: ((110, 230, 240), "next right"),
}
_OTHER: Final[tuple[Color, str]] = ((190, 190, 190), "further out")
WHITE: Final[Color] = (245, 245, 245)
DARK: Final[Color] = (28, 24, 20)
ALERT: Final[Color] = (70, 70, 235)
CAUTION: Final[Color] = (40, 200, 250)
_FONT: Final = cv2.FONT_HERSHEY_DUPLEX
_SUBPIXEL_BITS: Final = 4


def position_color(position: int) -> Color:
    """Returns the color of the boundaries at a position."""
    return POSITIONS.get(position, _OTHER)[0]


def position_name(position: int) -> str:
    """Returns the name of a position."""
    return POSITIONS.get(position, _OTHER)[1]


@dataclass(frozen=True)
class Drawing:
    """An image to draw on. `scale` is the size of text and lines, 1 for an image 1280 pixels wide."""

    image: BgrImage
    scale: float

    @classmethod
    def on_copy_of(cls, image: BgrImage) -> Drawing:
        """Returns a copy of `image`, BGR (H, W, 3) uint8, to draw on."""
        return cls(image.copy(), max(0.4, image.shape[1] / 1280.0))

    def part(self, left: float, top: float, width: float, height: float) -> Drawing:
        """Returns a rectangle of this image to draw on, as far as it lies inside; they share their pixels."""
        rows = slice(max(0, round(top)), max(0, round(top + height)))
        columns = slice(max(0, round(left)), max(0, round(left + width)))
        return Drawing(self.image[rows, columns], self.scale)

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
        """Writes `text` with its lower left corner `at`."""
        origin = round(at[0]), round(at[1])
        cv2.putText(self.image, text, origin, _FONT, size * self.scale, color, max(1, round(self.scale)), cv2.LINE_AA)

    def text_width(self, text: str, size: float = 0.55) -> float:
        """Returns the width of `text` in pixels."""
        return float(cv2.getTextSize(text, _FONT, size * self.scale, max(1, round(self.scale)))[0][0])

    def darken(self) -> None:
        """Darkens the image as a background for text."""
        self.image[:] = (0.35 * self.image + 0.65 * np.array(DARK)).astype(np.uint8)
