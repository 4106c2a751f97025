"""Draws lanes on their image: the ego lane as an area, boundaries as ribbons that taper with distance.

Colors show positions, and shapes what a boundary is: a dashed marking is drawn with dashes, a double one as two lines,
raised dots as dots, a yellow one with a yellow core, and a road edge as a thin white line with ticks away from the
vehicle. A boundary that was not detected in the frame is paler. If its line is continuous, it has long dashes if it is
inferred, and short ones if it is predicted. Sizes scale with the image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra
from lanestream_client.drawing import ALERT, DARK, WHITE, Color, Drawing, position_color, position_name
from lanestream_client.line_styles import Strand, line_name, line_style
from lanestream_client.road_panel import draw_road_panel

with needs_extra("video"):
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.protocol import ErrorMessage, LaneModel, LanesMessage
    from lanestream_client.pixels import BgrImage

    FloatArray = NDArray[np.float64]

_EGO_LANE: Final[Color] = (150, 220, 60)
_SAMPLES: Final = 64  # points along an outline
_FORESHORTENING: Final = 1.6
_CORE: Final = 0.5  # the width of a core, in widths of its line
_TICKS: Final = 12  # along a road edge
_TICK_LENGTH: Final = 6.0  # in half widths of a line


def draw_lanes(image: BgrImage, message: LanesMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the lanes of `message` drawn on it."""
    drawing = Drawing.on_copy_of(image)
    _draw_ego_lane(drawing, message)
    for lane in message.lanes:
        _draw_ribbon(drawing, lane)
    for lane in message.lanes:
        _draw_label(drawing, lane)
    _draw_legend(drawing, message)
    draw_road_panel(drawing, message)
    return drawing.image


def draw_error(image: BgrImage, error: ErrorMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the error message written on it."""
    drawing = Drawing.on_copy_of(image)
    step = 26 * drawing.scale
    text = f"frame {error.seq}: {error.message}"
    drawing.part(step / 2, step / 2, drawing.text_width(text) + step, 1.5 * step).darken()
    drawing.text(text, (step, 1.45 * step), ALERT)
    return drawing.image


def _columns(lane: LaneModel, rows: FloatArray) -> FloatArray:
    return np.array([lane.x(float(row)) for row in rows])


def _draw_ego_lane(drawing: Drawing, message: LanesMessage) -> None:
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
    filled = Drawing(drawing.image.copy(), drawing.scale)
    filled.polygon(outline, _EGO_LANE)
    band = slice(max(0, int(top) - 1), int(bottom) + 2)
    under, over = drawing.image[band], filled.image[band]
    alpha = np.interp(np.arange(band.start, band.start + len(under)), [top, bottom], [0.08, 0.38])[:, None, None]
    under[:] = (under + alpha * (over.astype(np.float32) - under)).astype(np.uint8)


def _draw_ribbon(drawing: Drawing, lane: LaneModel) -> None:
    """Draws a boundary in its style. A dark rim keeps it visible on bright concrete."""
    style, rim = line_style(lane), 1.3 * drawing.scale
    if style.ticks:
        _draw_ticks(drawing, lane, style.color, style.ticks)
    for piece in style.pieces:
        start, end = _rows(lane, np.array(piece))
        rows = np.linspace(start, end, max(2, _SAMPLES // len(style.pieces)))
        for strand in style.strands:
            _fill_ribbon(drawing, lane, rows, strand, DARK, rim)
            _fill_ribbon(drawing, lane, rows, strand, style.color)
            if style.core is not None:
                _fill_ribbon(drawing, lane, rows, replace(strand, width=_CORE * strand.width), style.core)


def _rows(lane: LaneModel, shares: FloatArray) -> FloatArray:
    """Returns the rows at shares of a boundary's length. Equal shares get shorter with distance, as on a road."""
    bottom, top = lane.line.bottom[1], lane.line.top[1]
    return np.asarray(top + (bottom - top) * (1.0 - shares) ** _FORESHORTENING)


def _half_widths(drawing: Drawing, lane: LaneModel, rows: FloatArray) -> FloatArray:
    road_height = max(1.0, drawing.image.shape[0] - 1.0 - lane.horizon)
    nearness = np.clip((rows - lane.horizon) / road_height, 0.0, 1.0)
    return np.asarray((1.2 + 4.3 * nearness) * drawing.scale)


def _fill_ribbon(
    drawing: Drawing, lane: LaneModel, rows: FloatArray, strand: Strand, color: Color, rim: float = 0.0
) -> None:
    columns = _columns(lane, rows)
    # The width is measured across the ribbon, not along the row, so that oblique boundaries do not shrink to hairlines.
    obliquity = np.minimum(3.0, np.hypot(1.0, np.gradient(columns, rows)))
    half = _half_widths(drawing, lane, rows)
    middle = columns + 2.0 * strand.middle * half * obliquity
    reach = (strand.width * half + rim) * obliquity
    left, right = np.column_stack([middle - reach, rows]), np.column_stack([middle + reach, rows])
    drawing.polygon(np.vstack([left, right[::-1]]), color)


def _draw_ticks(drawing: Drawing, lane: LaneModel, color: Color, side: int) -> None:
    """Draws short ticks along a road edge, away from the vehicle."""
    rows = _rows(lane, (np.arange(_TICKS) + 0.5) / _TICKS)
    for row, column, half in zip(rows, _columns(lane, rows), _half_widths(drawing, lane, rows), strict=True):
        for height, tick_color in ((0.4 * half + 1.3 * drawing.scale, DARK), (0.4 * half, color)):
            end = column + side * _TICK_LENGTH * half
            drawing.rectangle(min(column, end), row - height, abs(end - column), 2.0 * height, tick_color)


def _draw_label(drawing: Drawing, lane: LaneModel) -> None:
    """Writes the track id on a small label, a third of the way up the boundary."""
    row = lane.line.bottom[1] + 0.3 * (lane.line.top[1] - lane.line.bottom[1])
    column = float(_columns(lane, np.array([row]))[0])
    text = str(lane.track_id)
    width, height = drawing.text_width(text) + 14 * drawing.scale, 24 * drawing.scale
    left = min(max(0.0, column - width / 2), drawing.image.shape[1] - width)
    corners = np.array([[left, row], [left + width, row], [left + width, row + height], [left, row + height]])
    drawing.polygon(corners, DARK)
    inset = 2 * drawing.scale
    drawing.polygon(corners + inset * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]), position_color(lane.position))
    drawing.text(text, (left + 7 * drawing.scale, row + 17.5 * drawing.scale), DARK)


def _draw_legend(drawing: Drawing, message: LanesMessage) -> None:
    """Writes the frame number and the latency, then the positions of the boundaries in their colors."""
    step = 26 * drawing.scale
    title = f"frame {message.seq}   {message.timing_ms.total:.1f} ms"
    entries = [(_legend_text(lane), lane.position) for lane in message.lanes]
    swatch = 1.1 * step
    width = (
        max([drawing.text_width(title), *(swatch + drawing.text_width(text, 0.5) for text, _ in entries)]) + 1.2 * step
    )
    drawing.part(step / 2, step / 2, width, (1.5 + len(entries)) * step).darken()
    drawing.text(title, (1.1 * step, 1.5 * step), WHITE)
    for line, (text, position) in enumerate(entries, 1):
        middle = (1.3 + line) * step
        bar = np.array([[1.1, -0.12], [1.9, -0.12], [1.9, 0.12], [1.1, 0.12]]) * step + np.array([0.0, middle])
        drawing.polygon(bar, position_color(position))
        drawing.text(text, (1.1 * step + swatch, middle + 0.2 * step), WHITE, 0.5)


def _legend_text(lane: LaneModel) -> str:
    parts = [position_name(lane.position), line_name(lane), "" if lane.state == "detected" else lane.state]
    return ", ".join(part for part in parts if part)
