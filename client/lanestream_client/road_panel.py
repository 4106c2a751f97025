"""The panel of an overlay: the vehicle in its lane, its departure from it, and the road from above, in meters.

Bands show 95 % intervals.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra
from lanestream_client.colors import ALERT, CAUTION, GRAY, WHITE, Color, faded, position_color
from lanestream_client.line_styles import line_style

with needs_extra("video"):
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.protocol import DepartureModel, EgoModel, LaneModel, LanesMessage
    from lanestream_client.drawing import Drawing
    from lanestream_client.labels import Box

    FloatArray = NDArray[np.float64]

# All sizes are in pixels of an image of 1280 x 720.
_STEP: Final = 26.0
_WIDTH: Final = 262.0
_MAP_WIDTH: Final = 150.0
_MAP_HEIGHT: Final = 230.0
# In narrower images, there is no room beside the legend.
_LEAST_WIDTH: Final = 480.0
_LEAST_WIDTH_FOR_MAP: Final = 800.0
# The readings and the map take at most these shares of the height.
_MOST_HEIGHT: Final = 0.32
_MOST_HEIGHT_OF_MAP: Final = 0.6
# The part of the road that the map shows in meters: ahead, behind and on either side of the vehicle.
_AHEAD_M: Final = 45.0
_BEHIND_M: Final = 5.0
_SIDE_M: Final = 7.0
_GRID_M: Final = (10.0, 20.0, 30.0, 40.0)
_VEHICLE_M: Final = (4.4, 1.8)
_SAMPLES: Final = 48
# On the map, in meters: the width of a line, and the distance and the length of the ticks of a road edge.
_LINE_M: Final = 0.35
_TICKS_M, _TICK_M = 4.0, 0.6
# A normal distribution has 95 % within this many sigmas.
_SIGMAS: Final = 1.96
# A wider lane half than this many lane widths is cut off on the offset bar.
_BAR_LANES: Final = 0.62
# Weaker curvatures, in 1/m, count as straight.
_STRAIGHT: Final = 1.0 / 3000.0


def panel_width(drawing: Drawing, message: LanesMessage) -> float:
    """Returns how many pixels at the right of the image the panel takes with its margins; 0 if it is not drawn."""
    readings, road = _readings_width(drawing, message), _map_width(drawing, message)
    gaps = (readings > 0.0) + (road > 0.0)
    return readings + road + 0.5 * gaps * _STEP * drawing.text_scale


def draw_road_panel(drawing: Drawing, message: LanesMessage) -> list[Box]:
    """Draws the panel at the top right, and the map of the road beside it if the camera is known.

    Leaves out what an image is too small for. Returns the boxes that it takes.
    """
    gap = 0.5 * _STEP * drawing.text_scale
    right = drawing.image.shape[1] - gap
    boxes = []
    if width := _map_width(drawing, message):
        height = _MAP_HEIGHT * drawing.text_scale
        boxes.append((right - width, gap, right, gap + height))
        part = drawing.part(right - width, gap, width, height)
        part.darken()
        _draw_map(part, [lane for lane in message.lanes if lane.ground is not None])
        right -= width + gap
    if width := _readings_width(drawing, message):
        height = _draw_readings(drawing, right - width, gap, message.ego, message.departure)
        boxes.append((right - width, gap, right, gap + height))
    return boxes


def _map_width(drawing: Drawing, message: LanesMessage) -> float:
    height, width = drawing.image.shape[:2]
    scale = drawing.text_scale
    has_room = width >= _LEAST_WIDTH_FOR_MAP * scale and _MAP_HEIGHT * scale <= _MOST_HEIGHT_OF_MAP * height
    known = any(lane.ground is not None for lane in message.lanes)
    return _MAP_WIDTH * drawing.text_scale if known and has_room else 0.0


def _readings_width(drawing: Drawing, message: LanesMessage) -> float:
    has_room = drawing.image.shape[1] >= _LEAST_WIDTH * drawing.text_scale
    known = message.ego.offset is not None or message.departure is not None
    return _WIDTH * drawing.text_scale if known and has_room else 0.0


def _draw_readings(drawing: Drawing, left: float, top: float, ego: EgoModel, departure: DepartureModel | None) -> float:
    """Draws the offset bar and lines of text with the upper left corner at `left`, `top`. Returns their height."""
    step, width = _STEP * drawing.text_scale, _WIDTH * drawing.text_scale
    texts = [(_offset_text(ego), WHITE), *((text, WHITE) for text in _road_texts(ego))]
    if departure is not None:
        texts.append(_departure_text(departure))
    # In a small image, what lies between the offset and the departure has no room.
    while len(texts) > 2 and (1.4 + len(texts)) * step > _MOST_HEIGHT * drawing.image.shape[0]:
        del texts[-2]
    height = (1.4 + len(texts)) * step
    part = drawing.part(left, top, width, height)
    part.darken()
    color = WHITE if departure is None else _departure_text(departure)[1]
    if ego.offset is not None:
        _draw_offset_bar(part, ego.offset, ego.offset_sigma or 0.0, color)
    for line, (text, text_color) in enumerate(texts, 2):
        part.text(text, (0.5 * step, (line - 0.1) * step), text_color, 0.5)
    return height


def _draw_offset_bar(drawing: Drawing, offset: float, sigma: float, color: Color) -> None:
    """Draws the lane as a bar between its boundaries, and the vehicle's middle at `offset` lane widths in it."""
    step, width = _STEP * drawing.text_scale, _WIDTH * drawing.text_scale
    middle, lane = 0.7 * step, 0.78 * width

    def column(share: float) -> float:
        return width / 2.0 + min(max(share, -_BAR_LANES), _BAR_LANES) * lane

    drawing.rectangle(column(-0.5), middle - 0.06 * step, lane, 0.12 * step, GRAY)
    for edge, position in ((-0.5, -1), (0.5, 1)):
        drawing.rectangle(
            column(edge) - 0.09 * step, middle - 0.35 * step, 0.18 * step, 0.7 * step, position_color(position)
        )
    start, end = column(offset - _SIGMAS * sigma), column(offset + _SIGMAS * sigma)
    drawing.rectangle(start, middle - 0.12 * step, end - start, 0.24 * step, color)
    at = column(offset)
    drawing.polygon(
        np.array(
            [
                [at, middle - 0.42 * step],
                [at + 0.24 * step, middle],
                [at, middle + 0.42 * step],
                [at - 0.24 * step, middle],
            ]
        ),
        color,
    )


def _offset_text(ego: EgoModel) -> str:
    if ego.offset_m is not None:
        return f"offset {abs(ego.offset_m):.2f} m {_side(ego.offset_m, 0.005)}"
    if ego.offset is not None:
        return f"offset {100.0 * abs(ego.offset):.0f} % {_side(ego.offset, 0.005)}"
    return "offset unknown"


def _side(value: float, least: float) -> str:
    return "" if abs(value) < least else "right" if value > 0.0 else "left"


def _road_texts(ego: EgoModel) -> list[str]:
    """Returns the lane width and the radius of the road, as far as they are known."""
    texts = []
    if ego.lane_width_m is not None:
        texts.append(f"lane width {ego.lane_width_m:.2f} m")
    if ego.curvature is not None:
        if abs(ego.curvature) < _STRAIGHT:
            texts.append("straight")
        else:
            texts.append(f"radius {1.0 / abs(ego.curvature):.0f} m {_side(-ego.curvature, 0.0)}")
    return texts


def _departure_text(departure: DepartureModel) -> tuple[str, Color]:
    """Returns the word for a departure and its color."""
    if departure.state == "none":
        return "in lane", WHITE
    if departure.state == "crossed":
        return f"LINE CROSSED {departure.side}".upper(), ALERT
    time_s = departure.time_to_crossing
    return f"DEPARTURE {departure.side}".upper() + ("" if time_s is None else f" {time_s:.1f} s"), CAUTION


def _draw_map(drawing: Drawing, lanes: list[LaneModel]) -> None:
    """Draws boundaries from above, ahead is up, with their uncertainty as bands; fills the image."""
    height, width = drawing.image.shape[:2]
    for distance in _GRID_M:
        across = _map_points(np.array([distance] * 2), np.array([-_SIDE_M, _SIDE_M]), width, height)
        drawing.line(across, (80, 76, 72), 1.0)
    for lane in lanes:
        _draw_band(drawing, lane)
    for lane in lanes:
        _draw_line(drawing, lane)
    inset = 3.0 * drawing.text_scale
    for distance in _GRID_M[1::2]:
        (at,) = _map_points(np.array([distance]), np.array([_SIDE_M]), width, height)
        drawing.text(f"{distance:.0f} m", (at[0] + inset, at[1] - inset), GRAY, 0.4)
    length, breadth = _VEHICLE_M
    corners = np.array([[-length, breadth], [0.0, breadth], [0.0, -breadth], [-length, -breadth]]) / np.array(
        [1.0, 2.0]
    )
    drawing.polygon(_map_points(corners[:, 0], corners[:, 1], width, height), WHITE)


def _draw_line(drawing: Drawing, lane: LaneModel) -> None:
    """Draws a boundary in its style."""
    height, width = drawing.image.shape[:2]
    style = line_style(lane)
    color = faded(style.color, style.near_opacity)
    for start, end in style.pieces:
        x = np.linspace(start * _AHEAD_M, end * _AHEAD_M, _SAMPLES)
        for strand in style.strands:
            points = _map_points(x, _lateral(lane, x) - strand.middle * _LINE_M, width, height)
            drawing.line(points, color, 2.0 * strand.width)
            if style.core is not None:
                drawing.line(points, faded(style.core, style.near_opacity), 1.0)
    if style.ticks:
        for at in np.arange(1.0, _AHEAD_M, _TICKS_M):
            x = np.array([at, at])
            y = _lateral(lane, x) - np.array([0.0, style.ticks * _TICK_M])
            drawing.line(_map_points(x, y, width, height), color, 1.0)


def _draw_band(drawing: Drawing, lane: LaneModel) -> None:
    if lane.ground_covariance is None:
        return
    x = np.linspace(0.0, _AHEAD_M, _SAMPLES)
    powers = np.column_stack([x**2, x, np.ones_like(x)])
    variance = np.einsum("ni,ij,nj->n", powers, np.array(lane.ground_covariance), powers)
    half = np.minimum(_SIGMAS * np.sqrt(np.maximum(variance, 0.0)), 2.0 * _SIDE_M)
    y = _lateral(lane, x)
    height, width = drawing.image.shape[:2]
    outline = np.vstack([_map_points(x, y + half, width, height), _map_points(x, y - half, width, height)[::-1]])
    drawing.polygon(outline, position_color(lane.position), opacity=0.35)


def _lateral(lane: LaneModel, x: FloatArray) -> FloatArray:
    """Returns how far left of the vehicle a boundary is at the distances `x`, all in meters."""
    assert lane.ground is not None  # noqa: S101 - only lanes in meters are drawn
    a, b, c = lane.ground
    return np.clip(a * x**2 + b * x + c, -4.0 * _SIDE_M, 4.0 * _SIDE_M)


def _map_points(x: FloatArray, y: FloatArray, width: int, height: int) -> FloatArray:
    """Returns the pixels (N, 2) of points in the vehicle frame: x ahead, y to the left, in meters."""
    return np.column_stack([width * (0.5 - 0.5 * y / _SIDE_M), height * (_AHEAD_M - x) / (_AHEAD_M + _BEHIND_M)])
