"""The text of overlays: a label with the track id on each boundary, and the legend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra
from lanestream_client.colors import DARK, WHITE, faded, position_color, position_name
from lanestream_client.line_styles import line_name, line_style

with needs_extra("video"):
    pass

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lanestream.protocol import LaneModel, LanesMessage
    from lanestream_client.drawing import Drawing

# Left, top, right and bottom in pixels.
Box = tuple[float, float, float, float]

# All sizes are in pixels of an image of 1280 x 720.
STEP: Final = 26.0  # from line to line
_LABEL_HEIGHT: Final = 24.0
_LABEL_PADDING: Final = 7.0
# Where a label is put, as shares of the rows of its boundary from the lowest: the first place that is free.
_PLACES: Final = (0.3, 0.45, 0.15, 0.6, 0.75)
# The legend takes at most this share of the height; of the others, the boundaries next to the vehicle come first.
_MOST_HEIGHT: Final = 0.46
_LEAST_STRENGTH: Final = 0.7
_TITLE, _ENTRY = 0.55, 0.5  # sizes of text


def draw_legend(drawing: Drawing, message: LanesMessage, width: float) -> Box | None:
    """Writes the frame number and the latency, then the positions of the boundaries in their colors.

    Uses `width` pixels of the image at most. Returns the box that it takes, or None if it does not fit.
    """
    step = STEP * drawing.text_scale
    height = drawing.image.shape[0]
    lanes = _nearest(message.lanes, int(_MOST_HEIGHT * height / step - 1.5))
    swatch = 1.1 * step
    room = width - 2.2 * step
    title = _first_that_fits(drawing, room, _TITLE, *_titles(message))
    texts = [_legend_text(drawing, lane, room - swatch) for lane in lanes]
    widest = max([drawing.text_width(title, _TITLE), *(swatch + drawing.text_width(text, _ENTRY) for text in texts)])
    if widest > room or _MOST_HEIGHT * height < 1.5 * step:
        return None
    box = (0.5 * step, 0.5 * step, 1.7 * step + widest, (2.0 + len(lanes)) * step)
    drawing.part(box[0], box[1], box[2] - box[0], box[3] - box[1]).darken()
    drawing.text(title, (1.1 * step, 1.5 * step), WHITE, _TITLE)
    for line, (lane, text) in enumerate(zip(lanes, texts, strict=True), 1):
        middle = (1.3 + line) * step
        color = faded(position_color(lane.position), _label_strength(lane))
        drawing.rectangle(1.1 * step, middle - 0.12 * step, 0.8 * step, 0.24 * step, color)
        drawing.text(text, (1.1 * step + swatch, middle + 0.2 * step), WHITE, _ENTRY)
    return box


def draw_labels(drawing: Drawing, lanes: Sequence[LaneModel], taken: Sequence[Box]) -> None:
    """Writes the track ids on the boundaries, where the boxes `taken` and other labels leave room for it."""
    boxes = list(taken)
    for lane in sorted(lanes, key=lambda lane: abs(lane.position)):
        candidates = (_label_box(drawing, lane, place) for place in _PLACES)
        box = next((box for box in candidates if not any(_overlap(box, other) for other in boxes)), None)
        if box is not None:
            boxes.append(box)
            _draw_label(drawing, lane, box)


def _nearest(lanes: Sequence[LaneModel], count: int) -> list[LaneModel]:
    """Returns up to `count` boundaries next to the vehicle, from left to right."""
    nearest = sorted(lanes, key=lambda lane: abs(lane.position))[: max(0, count)]
    return sorted(nearest, key=lambda lane: lane.position)


def _legend_text(drawing: Drawing, lane: LaneModel, room: float) -> str:
    """Returns what a boundary is, or only its position if the rest does not fit."""
    position = position_name(lane.position)
    parts = [position, line_name(lane), "" if lane.state == "detected" else lane.state]
    return _first_that_fits(drawing, room, _ENTRY, ", ".join(part for part in parts if part), position)


def _titles(message: LanesMessage) -> tuple[str, ...]:
    """Returns the frame number with the latency, unless it is unknown, and without it."""
    frame, total_ms = f"frame {message.seq}", message.timing_ms.total
    return (f"{frame}   {total_ms:.1f} ms", frame) if total_ms else (frame,)


def _first_that_fits(drawing: Drawing, room: float, size: float, *texts: str) -> str:
    """Returns the first text that is at most `room` pixels wide, or else the last one."""
    return next((text for text in texts if drawing.text_width(text, size) <= room), texts[-1])


def _label_box(drawing: Drawing, lane: LaneModel, place: float) -> Box:
    height, width = _LABEL_HEIGHT * drawing.text_scale, _label_width(drawing, lane)
    rows, columns = drawing.image.shape[:2]
    row = lane.line.bottom[1] + place * (lane.line.top[1] - lane.line.bottom[1])
    left = min(max(0.0, lane.x(row) - width / 2), columns - width)
    top = min(max(0.0, row - height / 2), rows - height)
    return left, top, left + width, top + height


def _label_width(drawing: Drawing, lane: LaneModel) -> float:
    return drawing.text_width(str(lane.track_id)) + 2.0 * _LABEL_PADDING * drawing.text_scale


def _draw_label(drawing: Drawing, lane: LaneModel, box: Box) -> None:
    left, top, right, bottom = box
    scale = drawing.text_scale
    rim = 2.0 * scale
    drawing.rectangle(left, top, right - left, bottom - top, DARK)
    color = faded(position_color(lane.position), _label_strength(lane))
    drawing.rectangle(left + rim, top + rim, right - left - 2.0 * rim, bottom - top - 2.0 * rim, color)
    drawing.text(str(lane.track_id), (left + _LABEL_PADDING * scale, top + 17.5 * scale), DARK)


def _label_strength(lane: LaneModel) -> float:
    """Returns how strong the color of a label is. Even on the label of a faint boundary, the text must be legible."""
    return max(_LEAST_STRENGTH, line_style(lane).near_opacity)


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
