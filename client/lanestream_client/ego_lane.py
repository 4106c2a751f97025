"""The outline of the ego lane in the image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lanestream.errors import needs_extra

with needs_extra("video"):
    import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from lanestream.protocol import LaneModel, LanesMessage

    FloatArray = NDArray[np.float64]

_POINTS: Final = 48  # along each boundary
# A boundary that ends this near to the side of the image, as a share of the width, is taken to go on outside.
_AT_SIDE: Final = 0.06


def ego_boundaries(message: LanesMessage) -> tuple[LaneModel, LaneModel] | None:
    """Returns the left and the right boundary of the ego lane, or None unless both are known."""
    by_id = {lane.track_id: lane for lane in message.lanes}
    left, right = by_id.get(message.ego.left or -1), by_id.get(message.ego.right or -1)
    return None if left is None or right is None else (left, right)


def ego_lane_outline(message: LanesMessage) -> FloatArray | None:
    """Returns the outline (N, 2) of the ego lane as x, y in pixels of the image; None unless both sides are known.

    It starts at the lowest point of each boundary. A boundary that leaves the image at its side goes on outside, so the
    outline may have points there, until the row where the other one starts.
    """
    boundaries = ego_boundaries(message)
    if boundaries is None:
        return None
    lowest = max(lane.line.bottom[1] for lane in boundaries)
    left, right = (_points(lane, lowest, message.width) for lane in boundaries)
    return np.vstack([left, right[::-1]])


def columns(lane: LaneModel, rows: FloatArray) -> FloatArray:
    """Returns the columns of a boundary at `rows` (N,)."""
    return np.array([lane.x(float(row)) for row in rows])


def _points(lane: LaneModel, lowest: float, width: int) -> FloatArray:
    """Returns points (N, 2) along a boundary, from its lowest row, or from `lowest` if it leaves at the side."""
    column, bottom = lane.line.bottom
    leaves = min(column, width - 1.0 - column) < _AT_SIDE * width
    outside = not -0.5 <= lane.x(lowest) <= width - 0.5
    rows = np.linspace(lowest if leaves and outside else bottom, lane.line.top[1], _POINTS)
    return np.column_stack([columns(lane, rows), rows])
