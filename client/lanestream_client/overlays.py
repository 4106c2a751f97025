"""Draws lanes on their image: the ego lane as an area, boundaries as ribbons that taper and fade with distance.

Colors show positions, and shapes what a boundary is: a dashed marking is drawn with dashes, a double one as two lines,
raised dots as dots, a yellow one with a yellow core, and a road edge as a thin white line with ticks away from the
vehicle. A boundary that is barely probable is faint. One that was not detected in the frame is paler; if its line is
continuous, it has long dashes if it is inferred, and short ones if it is predicted. Sizes scale with the image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra
from lanestream_client.colors import ALERT, DARK, EGO_LANE, Color
from lanestream_client.drawing import Drawing
from lanestream_client.ego_lane import columns, ego_boundaries, ego_lane_outline
from lanestream_client.labels import STEP, draw_labels, draw_legend
from lanestream_client.line_styles import LineStyle, Strand, line_style
from lanestream_client.road_panel import draw_road_panel, panel_width

with needs_extra("video"):
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.protocol import ErrorMessage, LaneModel, LanesMessage
    from lanestream_client.pixels import BgrImage

    FloatArray = NDArray[np.float64]

_SAMPLES: Final = 64  # points along an outline
_FORESHORTENING: Final = 1.6
_CORE: Final = 0.5  # the width of a core, in widths of its line
_TICKS: Final = 12  # along a road edge
_TICK_LENGTH: Final = 6.0  # in half widths of a line
_MARGIN: Final = 48.0  # pixels around a boundary that its ribbon and its ticks may cover
# The opacity of the ego lane at shares of its rows from the farthest to the nearest. It fades with distance, and just
# in front of the vehicle, where the hood may hide the road.
_LANE_ROWS: Final = (0.0, 0.35, 0.6, 1.0)
_LANE_OPACITY: Final = (0.02, 0.28, 0.34, 0.0)
# The share of the rows of a boundary, from its far end, in which it fades.
_FADING: Final = 0.45


def draw_lanes(image: BgrImage, message: LanesMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the lanes of `message` drawn on it."""
    drawing = Drawing.on_copy_of(image)
    layer = drawing.copy()
    _draw_ego_lane(drawing, layer, message)
    for lane in sorted(message.lanes, key=lambda lane: -abs(lane.position)):
        _draw_boundary(drawing, layer, lane)
    room = image.shape[1] - panel_width(drawing, message)
    boxes = [draw_legend(drawing, message, room), *draw_road_panel(drawing, message)]
    draw_labels(drawing, message.lanes, [box for box in boxes if box is not None])
    return drawing.image


def draw_error(image: BgrImage, error: ErrorMessage) -> BgrImage:
    """Returns a copy of `image`, BGR (H, W, 3) uint8, with the error message written on it."""
    drawing = Drawing.on_copy_of(image)
    step = STEP * drawing.text_scale
    lines = _wrapped(drawing, f"frame {error.seq}: {error.message}", image.shape[1] - 2.0 * step)
    width = max(drawing.text_width(line) for line in lines)
    drawing.part(step / 2, step / 2, width + step, (0.5 + len(lines)) * step).darken()
    for number, line in enumerate(lines):
        drawing.text(line, (step, (1.25 + number) * step), ALERT)
    return drawing.image


def _wrapped(drawing: Drawing, text: str, width: float) -> list[str]:
    """Returns the lines of a text, none of which is wider than `width` pixels unless a single word is."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and drawing.text_width(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _draw_ego_lane(drawing: Drawing, layer: Drawing, message: LanesMessage) -> None:
    """Fills the ego lane with a color that fades with distance. `layer` is a copy of the image, and is again later."""
    boundaries, outline = ego_boundaries(message), ego_lane_outline(message)
    if boundaries is None or outline is None:
        return
    bottom, top = float(outline[:, 1].max()), float(outline[:, 1].min())
    if bottom - top < 2.0:
        return
    layer.polygon(outline, EGO_LANE)
    opacity = np.array(_LANE_OPACITY) * min(line_style(lane).near_opacity for lane in boundaries)
    _blend(drawing, layer, outline, 2.0, top + np.array(_LANE_ROWS) * (bottom - top), opacity)


def _draw_boundary(drawing: Drawing, layer: Drawing, lane: LaneModel) -> None:
    """Draws a boundary in its style. `layer` is a copy of the image, and is again later."""
    style = line_style(lane)
    _draw_ribbon(layer, lane, style)
    bottom, top = lane.line.bottom[1], lane.line.top[1]
    rows = np.linspace(top, bottom, _SAMPLES)
    shares = np.array([0.0, _FADING, 1.0])
    opacity = np.array([style.far_opacity, style.near_opacity, style.near_opacity])
    outline = np.column_stack([columns(lane, rows), rows])
    _blend(drawing, layer, outline, _MARGIN * drawing.scale, top + shares * (bottom - top), opacity)


def _blend(
    drawing: Drawing, layer: Drawing, outline: FloatArray, margin: float, rows: FloatArray, opacity: FloatArray
) -> None:
    """Blends what was drawn on `layer` within `margin` pixels of `outline` (N, 2) into the image, then removes it.

    The opacity of a row is interpolated between `opacity` (N,) at the ascending `rows` (N,).
    """
    size = np.array([drawing.image.shape[1], drawing.image.shape[0]])
    left, top = np.clip(np.floor(outline.min(axis=0) - margin), 0, size).astype(int)
    right, bottom = np.clip(np.ceil(outline.max(axis=0) + margin), 0, size).astype(int)
    under = drawing.part(left, top, right - left, bottom - top)
    over = layer.part(left, top, right - left, bottom - top)
    under.blend(over, rows - top, opacity)
    over.image[:] = under.image


def _draw_ribbon(drawing: Drawing, lane: LaneModel, style: LineStyle) -> None:
    """Draws a boundary as ribbons. A dark rim keeps them visible on bright concrete."""
    rim = 1.3 * drawing.scale
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
    middles = columns(lane, rows)
    # The width is measured across the ribbon, not along the row, so that oblique boundaries do not shrink to hairlines.
    obliquity = np.minimum(3.0, np.hypot(1.0, np.gradient(middles, rows)))
    half = _half_widths(drawing, lane, rows)
    middle = middles + 2.0 * strand.middle * half * obliquity
    reach = (strand.width * half + rim) * obliquity
    left, right = np.column_stack([middle - reach, rows]), np.column_stack([middle + reach, rows])
    drawing.polygon(np.vstack([left, right[::-1]]), color)


def _draw_ticks(drawing: Drawing, lane: LaneModel, color: Color, side: int) -> None:
    """Draws short ticks along a road edge, away from the vehicle."""
    rows = _rows(lane, (np.arange(_TICKS) + 0.5) / _TICKS)
    for row, column, half in zip(rows, columns(lane, rows), _half_widths(drawing, lane, rows), strict=True):
        for height, tick_color in ((0.4 * half + 1.3 * drawing.scale, DARK), (0.4 * half, color)):
            end = column + side * _TICK_LENGTH * half
            drawing.rectangle(min(column, end), row - height, abs(end - column), 2.0 * height, tick_color)
