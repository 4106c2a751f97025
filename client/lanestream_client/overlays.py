"""Lanes drawn on their image: the ego lane as a carpet, boundaries as ribbons that taper away from the camera.

Colours tell positions, full ribbons are backed by the frame, dashed ones are predicted. Sizes follow the image's width.
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
    from lanestream_client.frames import Image

    FloatArray = NDArray[np.float64]

Colour = tuple[int, int, int]

# Blue, green, red; told apart by those who see no red or green, too.
_EGO_LANE: Final[Colour] = (150, 220, 60)
_POSITIONS: Final[dict[int, tuple[Colour, str]]] = {
    -2: ((200, 120, 220), "next left"),
    -1: ((40, 170, 255), "ego left"),
    1: ((255, 190, 70), "ego right"),
    2: ((110, 230, 240), "next right"),
}
_OTHER: Final[tuple[Colour, str]] = ((190, 190, 190), "further out")
_WHITE: Final[Colour] = (245, 245, 245)
_DARK: Final[Colour] = (28, 24, 20)
_ALERT: Final[Colour] = (70, 70, 235)
_FONT: Final = cv2.FONT_HERSHEY_DUPLEX
_SAMPLES: Final = 64
_DASHES: Final = 8
_SUBPIXEL_BITS: Final = 4


@dataclass(frozen=True)
class _Canvas:
    """The image being drawn on, and how large things are on it."""

    image: Image
    scale: float
    horizon: float

    @classmethod
    def over(cls, image: Image, horizon: float) -> _Canvas:
        return cls(image.copy(), max(0.4, image.shape[1] / 1280.0), horizon)

    def polygon(self, points: FloatArray, colour: Colour) -> None:
        """Fills the polygon with corners `points` (N, 2), anti-aliased, at fractions of pixels."""
        fixed = np.round(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.fillPoly(self.image, [fixed], colour, cv2.LINE_AA, _SUBPIXEL_BITS)

    def text(self, text: str, at: tuple[float, float], colour: Colour, size: float = 0.55) -> None:
        """Writes `text` with its lower left corner `at`."""
        place = round(at[0]), round(at[1])
        cv2.putText(self.image, text, place, _FONT, size * self.scale, colour, max(1, round(self.scale)), cv2.LINE_AA)

    def text_width(self, text: str, size: float = 0.55) -> float:
        """How wide `text` will be, in pixels."""
        return float(cv2.getTextSize(text, _FONT, size * self.scale, max(1, round(self.scale)))[0][0])

    def panel(self, left: float, top: float, width: float, height: float) -> None:
        """Darkens a rectangle to write on."""
        rows = slice(max(0, round(top)), max(0, round(top + height)))
        columns = slice(max(0, round(left)), max(0, round(left + width)))
        part = self.image[rows, columns]
        part[:] = (0.35 * part + 0.65 * np.array(_DARK)).astype(np.uint8)


def draw_lanes(image: Image, message: LanesMessage) -> Image:
    """A copy of `image`, BGR (H, W, 3) uint8, with the lanes of `message` on it."""
    canvas = _Canvas.over(image, message.horizon)
    _draw_carpet(canvas, message)
    for lane in message.lanes:
        _draw_ribbon(canvas, lane)
    for lane in message.lanes:
        _draw_label(canvas, lane)
    _draw_legend(canvas, message)
    return canvas.image


def draw_error(image: Image, error: ErrorMessage) -> Image:
    """A copy of `image` that says why it has no lanes."""
    canvas = _Canvas.over(image, 0.0)
    step = 26 * canvas.scale
    text = f"frame {error.seq}: {error.message}"
    canvas.panel(step / 2, step / 2, canvas.text_width(text) + step, 1.5 * step)
    canvas.text(text, (step, 1.45 * step), _ALERT)
    return canvas.image


def _colour(position: int) -> Colour:
    return _POSITIONS.get(position, _OTHER)[0]


def _columns(lane: LaneModel, rows: FloatArray) -> FloatArray:
    return np.array([lane.x(float(row)) for row in rows])


def _draw_carpet(canvas: _Canvas, message: LanesMessage) -> None:
    """Fills the ego lane, fading out with distance."""
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
    filled = _Canvas(canvas.image.copy(), canvas.scale, canvas.horizon)
    filled.polygon(outline, _EGO_LANE)
    band = slice(max(0, int(top) - 1), int(bottom) + 2)
    under, over = canvas.image[band], filled.image[band]
    alpha = np.interp(np.arange(band.start, band.start + len(under)), [top, bottom], [0.08, 0.38])[:, None, None]
    under[:] = (under + alpha * (over.astype(np.float32) - under)).astype(np.uint8)


def _draw_ribbon(canvas: _Canvas, lane: LaneModel) -> None:
    """Draws a boundary over a dark rim, which keeps it visible on bright concrete; in dashes where it is predicted."""
    bottom, top = lane.line.bottom[1], lane.line.top[1]
    pieces = 1 if lane.state == "detected" else _DASHES
    # Dashes shorten with distance as painted ones do.
    edges = top + (bottom - top) * np.linspace(1.0, 0.0, 2 * pieces) ** 1.6 if pieces > 1 else np.array([bottom, top])
    for start, end in zip(edges[0::2], edges[1::2], strict=True):
        rows = np.linspace(start, end, max(2, _SAMPLES // pieces))
        _draw_strip(canvas, lane, rows, _DARK, rim=1.3 * canvas.scale)
        _draw_strip(canvas, lane, rows, _colour(lane.position), rim=0.0)


def _draw_strip(canvas: _Canvas, lane: LaneModel, rows: FloatArray, colour: Colour, rim: float) -> None:
    depth = max(1.0, canvas.image.shape[0] - 1.0 - canvas.horizon)
    near = np.clip((rows - canvas.horizon) / depth, 0.0, 1.0)
    columns = _columns(lane, rows)
    # Measured across the ribbon, not along the row, so that flat boundaries do not come out as hairlines.
    lean = np.minimum(3.0, np.hypot(1.0, np.gradient(columns, rows)))
    half = ((1.2 + 4.3 * near) * canvas.scale + rim) * lean
    left, right = np.column_stack([columns - half, rows]), np.column_stack([columns + half, rows])
    canvas.polygon(np.vstack([left, right[::-1]]), colour)


def _draw_label(canvas: _Canvas, lane: LaneModel) -> None:
    """Writes the track id on a small plate, a third of the way up."""
    row = lane.line.bottom[1] + 0.3 * (lane.line.top[1] - lane.line.bottom[1])
    column = float(_columns(lane, np.array([row]))[0])
    text = str(lane.track_id)
    width, height = canvas.text_width(text) + 14 * canvas.scale, 24 * canvas.scale
    left = min(max(0.0, column - width / 2), canvas.image.shape[1] - width)
    corners = np.array([[left, row], [left + width, row], [left + width, row + height], [left, row + height]])
    canvas.polygon(corners, _DARK)
    inset = 2 * canvas.scale
    canvas.polygon(corners + inset * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), _colour(lane.position))
    canvas.text(text, (left + 7 * canvas.scale, row + 17.5 * canvas.scale), _DARK)


def _draw_legend(canvas: _Canvas, message: LanesMessage) -> None:
    """Frame number and latency, then the positions that are there, in their colours."""
    step = 26 * canvas.scale
    title = f"frame {message.seq}   {message.timing_ms.total:.1f} ms"
    entries = [
        (_POSITIONS.get(lane.position, _OTHER)[1] + ("" if lane.state == "detected" else ", predicted"), lane.position)
        for lane in message.lanes
    ]
    swatch = 1.1 * step
    width = (
        max([canvas.text_width(title), *(swatch + canvas.text_width(text, 0.5) for text, _ in entries)]) + 1.2 * step
    )
    canvas.panel(step / 2, step / 2, width, (1.5 + len(entries)) * step)
    canvas.text(title, (1.1 * step, 1.5 * step), _WHITE)
    for line, (text, position) in enumerate(entries, 1):
        middle = (1.3 + line) * step
        bar = np.array([[1.1, -0.12], [1.9, -0.12], [1.9, 0.12], [1.1, 0.12]]) * step + np.array([0.0, middle])
        canvas.polygon(bar, _colour(position))
        canvas.text(text, (1.1 * step + swatch, middle + 0.2 * step), _WHITE, 0.5)
