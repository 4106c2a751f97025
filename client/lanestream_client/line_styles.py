"""How boundaries are drawn: their shape shows what they are, their color where they are, their opacity how sure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream_client.colors import WHITE, YELLOW, Color, position_color

if TYPE_CHECKING:
    from lanestream.protocol import LaneModel

# The start and the end of a painted piece of a line, as shares of its length.
Piece = tuple[float, float]

# The number of dashes of a boundary, and the share of a dash and its gap that is painted: of continuous lines by state,
# and of those that are interrupted on the road.
_BY_STATE: Final[dict[str, tuple[int, float]]] = {"detected": (1, 1.0), "inferred": (4, 0.8), "predicted": (8, 0.5)}
_BY_TYPE: Final[dict[str, tuple[int, float]]] = {"dashed": (7, 0.5), "dots": (18, 0.3)}
# The opacity of boundaries by state: near the vehicle, and at the far end, where they are least certain.
_OPACITY: Final[dict[str, tuple[float, float]]] = {
    "detected": (1.0, 0.5),
    "inferred": (0.8, 0.3),
    "predicted": (0.6, 0.1),
}
# The share of the opacity that is left of boundaries with these probabilities.
_PROBABILITIES, _SHARES = (0.5, 0.85), (0.4, 1.0)


@dataclass(frozen=True)
class Strand:
    """One of the parallel stripes of a line: its middle and its width, in widths of a usual line."""

    middle: float
    width: float


_SINGLE: Final = (Strand(0.0, 1.0),)
_DOUBLE: Final = (Strand(-0.65, 0.5), Strand(0.65, 0.5))
_THIN: Final = (Strand(0.0, 0.5),)


@dataclass(frozen=True)
class LineStyle:
    """The shape and the color of a line.

    A line with a `core` has a narrow stripe of that color along its middle. `ticks` is the side of the short ticks that
    mark a road edge, -1 left and 1 right, away from the vehicle; 0 if there are none. `near_opacity` applies to its
    near part and `far_opacity` to its far end.
    """

    pieces: tuple[Piece, ...]
    strands: tuple[Strand, ...]
    color: Color
    core: Color | None
    ticks: int
    near_opacity: float
    far_opacity: float


def line_style(lane: LaneModel) -> LineStyle:
    """Returns how a boundary is drawn.

    Markings have the color of their position, and road edges are white. Without a known type, a marking is drawn
    as a solid one. Boundaries that are barely probable are faint, and those that were not detected are paler and fade
    sooner.
    """
    is_edge, marking = lane.kind == "road_edge", lane.marking
    marking_type = "solid" if marking is None else marking.type
    share = _share_of_opacity(lane.probability)
    near, far = _OPACITY[lane.state]
    is_yellow = marking is not None and marking.color == "yellow"
    return LineStyle(
        pieces=_pieces(*_BY_TYPE.get(marking_type, _BY_STATE[lane.state])),
        strands=_THIN if is_edge else _DOUBLE if marking_type == "double" else _SINGLE,
        color=WHITE if is_edge else position_color(lane.position),
        core=YELLOW if is_yellow else None,
        ticks=0 if not is_edge else 1 if lane.position > 0 else -1,
        near_opacity=share * near,
        far_opacity=share * far,
    )


def line_name(lane: LaneModel) -> str:
    """Returns what a boundary is, such as `dashed white`; nothing if a marking's type is unknown."""
    if lane.kind == "road_edge":
        return "road edge"
    return "" if lane.marking is None else f"{lane.marking.type} {lane.marking.color}"


def _pieces(count: int, painted: float) -> tuple[Piece, ...]:
    length = count - 1.0 + painted
    return tuple((start / length, (start + painted) / length) for start in range(count))


def _share_of_opacity(probability: float) -> float:
    """Returns the share of the opacity for a probability."""
    (low, high), (least, most) = _PROBABILITIES, _SHARES
    return least + (most - least) * min(1.0, max(0.0, (probability - low) / (high - low)))
