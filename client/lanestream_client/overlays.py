"""Draws lanes on their image: the ego lane as an area, boundaries as ribbons that taper with distance.

Colors show positions. Solid ribbons were detected in the frame, dashed ones are predicted. Sizes scale with the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra

with needs_extra("video"):
    import cv2
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.protocol import ErrorMessage, LaneModel, LanesMessage
    from lanestream_client.frames import BgrImage

    FloatArray = NDArray[np.float64]

Color = tuple[int, int, int]

# Blue, green, red. People with red-green color blindness can distinguish these colors, too.
_EGO_LANE: Final[Color] = (150, 220, 60)
_POSITIONS: Final[dict[int, tuple[Color, str]]] = {
    -2: ((200, 120, 220), "next left"),
    -1: ((40, 170, 255), "ego left"),
    1: ((255, 190, 70), "ego right"),
    2: ((110, 230, 240), "next right"),
}
_OTHER: Final[tuple[Color, str]] = ((190, 190, 190), "further out")
_WHITE: Final[Color] = (245, 245, 245)
_DARK: Final[Color] = (28, 24, 20)
_ALERT: Final[Color] = (70, 70, 235)
_FONT: Final = cv2.FONT_HERSHEY_DUPLEX
_SAMPLES: Final = 64  # points along an outline
_DASHES: Final = 8
_SUBPIXEL_BITS: Final = 4


@dataclass(frozen=True)
class _Overlay:
    """The image being drawn on. `scale` is the size of text and lines, 1 for an image 1280 pixels wide."""

    image: BgrImage
    scale: float
    horizon: float

    @classmethod
    def on_copy_of(cls, image: BgrImage, horizon: float) -> _Overlay:
        """Returns an overlay on a copy of `image`. `horizon` is a row of the image."""
        return cls(image.copy(), max(0.4, image.shape[1] / 1280.0), horizon)

    def polygon(self, points: FloatArray, color: Color) -> None:
        """Fills the polygon with corners `points` (N, 2), anti-aliased, with subpixel precision."""
        fixed = np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(self.image, [fixed], color, cv2.LINE_AA, _SUBPIXEL_BITS)

    def text(self, text: str, at: tuple[float, float], color: Color, size: float = 0.55) -> None:
        """Writes `text` with its lower left corner `at`."""
        origin = round(at[0]), round(at[1])
        cv2.putText(self.image, text, origin, _FONT, size * self.scale, color, max(1, round(self.scale)), cv2.LINE_AA)

    def text_width(self, text: str, size: float = 0.55) -> float:
        """Returns the width of `text` in pixels."""
        return float(cv2.getTextSize(text, _FONT, size * self.scale, max(1, round(self.scale)))[0][0])

    def panel(self, left: float, top: float, width: float, height: float) -> None:
        """Darkens a rectangle as a background for text."""
        rows = slice(max(0, round(top)), max(0, round(top + height)))
        columns = slice(max(0, round(left)), max(0, round(left + width)))
        part = self.image[rows, columns]
        part[:] = (0.35 * part + 0.65 * np.array(_DARK)).astype(np.uint8)


def draw_lanes(image: BgrImage, message: LanesMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the lanes of `message` drawn on it."""
    overlay = _Overlay.on_copy_of(image, message.horizon)
    _draw_ego_lane(overlay, message)
    for lane in message.lanes:
        _draw_ribbon(overlay, lane)
    for lane in message.lanes:
        _draw_label(overlay, lane)
    _draw_legend(overlay, message)
    return overlay.image


def draw_error(image: BgrImage, error: ErrorMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the error message written on it."""
    overlay = _Overlay.on_copy_of(image, 0.0)
    step = 26 * overlay.scale
    text = f"frame {error.seq}: {error.message}"
    overlay.panel(step / 2, step / 2, overlay.text_width(text) + step, 1.5 * step)
    overlay.text(text, (step, 1.45 * step), _ALERT)
    return overlay.image


def _color(position: int) -> Color:
    return _POSITIONS.get(position, _OTHER)[0]


def _columns(lane: LaneModel, rows: FloatArray) -> FloatArray:
    return np.array([lane.x(float(row)) for row in rows])


def _draw_ego_lane(overlay: _Overlay, message: LanesMessage) -> None:
    """Fills the ego lane with a color that fades with distance."""
    by_id = {lane.track_id: lane for lane in message.lanes}
    left, right = by_id.get(message.ego.left or -1), by_id.get(message.ego.right or -1)
    if left is None or right is None:
        return
    bottom = min(left.line.bottom[1], right.line.bottom[1])
    top = max(left.line.top[1], right.line.top[1])
    if bottom - top < 2.0:
        return
    rows = np.linspace(bottom, top, _SAMPLES)
    outline = np.vstack(
        [np.column_stack([_columns(left, rows), rows]), np.column_stack([_columns(right, rows), rows])[::-1]]
    )
    filled = _Overlay(overlay.image.copy(), overlay.scale, overlay.horizon)
    filled.polygon(outline, _EGO_LANE)
    band = slice(max(0, int(top) - 1), int(bottom) + 2)
    under, over = overlay.image[band], filled.image[band]
    alpha = np.interp(np.arange(band.start, band.start + len(under)), [top, bottom], [0.08, 0.38])[:, None, None]
    under[:] = (under + alpha * (over.astype(np.float32) - under)).astype(np.uint8)


def _draw_ribbon(overlay: _Overlay, lane: LaneModel) -> None:
    """Draws a boundary, dashed if predicted. A dark rim keeps it visible on bright concrete."""
    bottom, top = lane.line.bottom[1], lane.line.top[1]
    pieces = 1 if lane.state == "detected" else _DASHES
    # Dashes get shorter with distance, as those on a road do.
    edges = top + (bottom - top) * np.linspace(1.0, 0.0, 2 * pieces) ** 1.6 if pieces > 1 else np.array([bottom, top])
    for start, end in zip(edges[0::2], edges[1::2], strict=True):
        rows = np.linspace(start, end, max(2, _SAMPLES // pieces))
        _fill_ribbon(overlay, lane, rows, _DARK, rim=1.3 * overlay.scale)
        _fill_ribbon(overlay, lane, rows, _color(lane.position), rim=0.0)


def _fill_ribbon(overlay: _Overlay, lane: LaneModel, rows: FloatArray, color: Color, rim: float) -> None:
    road_height = max(1.0, overlay.image.shape[0] - 1.0 - overlay.horizon)
    nearness = np.clip((rows - overlay.horizon) / road_height, 0.0, 1.0)
    columns = _columns(lane, rows)
    # The width is measured across the ribbon, not along the row, so that oblique boundaries do not shrink to hairlines.
    obliquity = np.minimum(3.0, np.hypot(1.0, np.gradient(columns, rows)))
    half_width = ((1.2 + 4.3 * nearness) * overlay.scale + rim) * obliquity
    left, right = np.column_stack([columns - half_width, rows]), np.column_stack([columns + half_width, rows])
    overlay.polygon(np.vstack([left, right[::-1]]), color)


def _draw_label(overlay: _Overlay, lane: LaneModel) -> None:
    """Writes the track id on a small label, a third of the way up the boundary."""
    row = lane.line.bottom[1] + 0.3 * (lane.line.top[1] - lane.line.bottom[1])
    column = float(_columns(lane, np.array([row]))[0])
    text = str(lane.track_id)
    width, height = overlay.text_width(text) + 14 * overlay.scale, 24 * overlay.scale
    left = min(max(0.0, column - width / 2), overlay.image.shape[1] - width)
    corners = np.array([[left, row], [left + width, row], [left + width, row + height], [left, row + height]])
    overlay.polygon(corners, _DARK)
    inset = 2 * overlay.scale
    overlay.polygon(corners + inset * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), _color(lane.position))
    overlay.text(text, (left + 7 * overlay.scale, row + 17.5 * overlay.scale), _DARK)


def _draw_legend(overlay: _Overlay, message: LanesMessage) -> None:
    """Writes the frame number and the latency, then the positions of the boundaries in their colors."""
    step = 26 * overlay.scale
    title = f"frame {message.seq}   {message.timing_ms.total:.1f} ms"
    entries = [
        (_POSITIONS.get(lane.position, _OTHER)[1] + ("" if lane.state == "detected" else ", predicted"), lane.position)
        for lane in message.lanes
    ]
    swatch = 1.1 * step
    width = (
        max([overlay.text_width(title), *(swatch + overlay.text_width(text, 0.5) for text, _ in entries)]) + 1.2 * step
    )
    overlay.panel(step / 2, step / 2, width, (1.5 + len(entries)) * step)
    overlay.text(title, (1.1 * step, 1.5 * step), _WHITE)
    for line, (text, position) in enumerate(entries, 1):
        middle = (1.3 + line) * step
        bar = np.array([[1.1, -0.12], [1.9, -0.12], [1.9, 0.12], [1.1, 0.12]]) * step + np.array([0.0, middle])
        overlay.polygon(bar, _color(position))
        overlay.text(text, (1.1 * step + swatch, middle + 0.2 * step), _WHITE, 0.5)
