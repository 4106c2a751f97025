"""Draws lanes on their image: the ego lane as an area, boundaries as ribbons that taper with distance.

Colors show positions. Solid ribbons were detected in the frame, ones with long dashes are inferred, ones with short
dashes predicted. Sizes scale with the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra
from lanestream_client.canvas import ALERT, DARK, WHITE, Canvas, Color, dashes, position_color, position_name
from lanestream_client.road_panel import draw_road_panel

with needs_extra("video"):
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.protocol import ErrorMessage, LaneModel, LanesMessage
    from lanestream_client.frames import BgrImage

    FloatArray = NDArray[np.float64]

_EGO_LANE: Final[Color] = (150, 220, 60)
_SAMPLES: Final = 64  # points along an outline
_FORESHORTENING: Final = 1.6


def draw_lanes(image: BgrImage, message: LanesMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the lanes of `message` drawn on it."""
    canvas = Canvas.on_copy_of(image)
    _draw_ego_lane(canvas, message)
    for lane in message.lanes:
        _draw_ribbon(canvas, lane)
    for lane in message.lanes:
        _draw_label(canvas, lane)
    _draw_legend(canvas, message)
    draw_road_panel(canvas, message)
    return canvas.image


def draw_error(image: BgrImage, error: ErrorMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the error message written on it."""
    canvas = Canvas.on_copy_of(image)
    step = 26 * canvas.scale
    text = f"frame {error.seq}: {error.message}"
    canvas.part(step / 2, step / 2, canvas.text_width(text) + step, 1.5 * step).darken()
    canvas.text(text, (step, 1.45 * step), ALERT)
    return canvas.image


def _columns(lane: LaneModel, rows: FloatArray) -> FloatArray:
    return np.array([lane.x(float(row)) for row in rows])


def _draw_ego_lane(canvas: Canvas, message: LanesMessage) -> None:
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
    filled = Canvas(canvas.image.copy(), canvas.scale)
    filled.polygon(outline, _EGO_LANE)
    band = slice(max(0, int(top) - 1), int(bottom) + 2)
    under, over = canvas.image[band], filled.image[band]
    alpha = np.interp(np.arange(band.start, band.start + len(under)), [top, bottom], [0.08, 0.38])[:, None, None]
    under[:] = (under + alpha * (over.astype(np.float32) - under)).astype(np.uint8)


def _draw_ribbon(canvas: Canvas, lane: LaneModel) -> None:
    """Draws a boundary, with dashes unless it was detected. A dark rim keeps it visible on bright concrete."""
    bottom, top = lane.line.bottom[1], lane.line.top[1]
    pieces = dashes(lane.state)
    for piece in pieces:
        # Dashes get shorter with distance, as those on a road do.
        start, end = (top + (bottom - top) * (1.0 - share) ** _FORESHORTENING for share in piece)
        rows = np.linspace(start, end, max(2, _SAMPLES // len(pieces)))
        _fill_ribbon(canvas, lane, rows, DARK, rim=1.3 * canvas.scale)
        _fill_ribbon(canvas, lane, rows, position_color(lane.position), rim=0.0)


def _fill_ribbon(canvas: Canvas, lane: LaneModel, rows: FloatArray, color: Color, rim: float) -> None:
    road_height = max(1.0, canvas.image.shape[0] - 1.0 - lane.horizon)
    nearness = np.clip((rows - lane.horizon) / road_height, 0.0, 1.0)
    columns = _columns(lane, rows)
    # The width is measured across the ribbon, not along the row, so that oblique boundaries do not shrink to hairlines.
    obliquity = np.minimum(3.0, np.hypot(1.0, np.gradient(columns, rows)))
    half_width = ((1.2 + 4.3 * nearness) * canvas.scale + rim) * obliquity
    left, right = np.column_stack([columns - half_width, rows]), np.column_stack([columns + half_width, rows])
    canvas.polygon(np.vstack([left, right[::-1]]), color)


def _draw_label(canvas: Canvas, lane: LaneModel) -> None:
    """Writes the track id on a small label, a third of the way up the boundary."""
    row = lane.line.bottom[1] + 0.3 * (lane.line.top[1] - lane.line.bottom[1])
    column = float(_columns(lane, np.array([row]))[0])
    text = str(lane.track_id)
    width, height = canvas.text_width(text) + 14 * canvas.scale, 24 * canvas.scale
    left = min(max(0.0, column - width / 2), canvas.image.shape[1] - width)
    corners = np.array([[left, row], [left + width, row], [left + width, row + height], [left, row + height]])
    canvas.polygon(corners, DARK)
    inset = 2 * canvas.scale
    canvas.polygon(corners + inset * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), position_color(lane.position))
    canvas.text(text, (left + 7 * canvas.scale, row + 17.5 * canvas.scale), DARK)


def _draw_legend(canvas: Canvas, message: LanesMessage) -> None:
    """Writes the frame number and the latency, then the positions of the boundaries in their colors."""
    step = 26 * canvas.scale
    title = f"frame {message.seq}   {message.timing_ms.total:.1f} ms"
    entries = [
        (position_name(lane.position) + ("" if lane.state == "detected" else f", {lane.state}"), lane.position)
        for lane in message.lanes
    ]
    swatch = 1.1 * step
    width = (
        max([canvas.text_width(title), *(swatch + canvas.text_width(text, 0.5) for text, _ in entries)]) + 1.2 * step
    )
    canvas.part(step / 2, step / 2, width, (1.5 + len(entries)) * step).darken()
    canvas.text(title, (1.1 * step, 1.5 * step), WHITE)
    for line, (text, position) in enumerate(entries, 1):
        middle = (1.3 + line) * step
        bar = np.array([[1.1, -0.12], [1.9, -0.12], [1.9, 0.12], [1.1, 0.12]]) * step + np.array([0.0, middle])
        canvas.polygon(bar, position_color(position))
        canvas.text(text, (1.1 * step + swatch, middle + 0.2 * step), WHITE, 0.5)
