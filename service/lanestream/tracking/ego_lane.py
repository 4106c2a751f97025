"""The ego lane: its width, the positions of boundaries relative to the camera, and lane changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lanestream.road.results import LaneChange
from lanestream.road.view import LANE_WIDTHS
from lanestream.tracking.tracks import Track

# How quickly the lane width follows that of a frame.
_WIDTH_GAIN: Final = 0.05
# A boundary has changed sides after this many frames at least this many lane widths beyond the camera.
_CROSSING_MARGIN: Final = 0.1
_CROSSING_FRAMES: Final = 3
# A gap of more lane widths than this counts as two lanes. The camera may be anywhere in its lane, so the first boundary
# is up to a whole lane width away.
_FIRST_GAP: Final = 1.3
_NEXT_GAP: Final = 1.6


def learned_width(width: float, measured: float) -> float:
    """Returns the updated lane width, in row offsets; a `measured` width outside the limits of lanes is ignored."""
    narrowest, widest = LANE_WIDTHS
    return width + _WIDTH_GAIN * (measured - width) if narrowest <= measured <= widest else width


def lane_change(track: Track, column: float, camera: float, lane_width: float) -> LaneChange | None:
    """Records a track's `column` at the bottom row; returns a lane change if the track has just changed sides.

    `camera` is the camera's column, `lane_width` is in pixels at that row.
    """
    if (column - camera) * track.side > -_CROSSING_MARGIN * lane_width:
        track.crossing = 0
        return None
    track.crossing += 1
    if track.crossing < _CROSSING_FRAMES:
        return None
    track.side, track.crossing = -track.side, 0
    if track.track_id is None:
        return None
    # A boundary that moves to the left shows that the camera moves to the right.
    return LaneChange(track.track_id, "right" if track.side < 0 else "left")


def lane_positions(tracks: Sequence[Track], columns: Sequence[float], camera: float, lane_width: float) -> list[int]:
    """Returns the position of each track from its column at the bottom row.

    Boundaries are counted outwards from the camera. A gap of about two lane widths counts as two, so that a boundary
    that is not seen leaves its position empty.
    """
    result = [0] * len(tracks)
    for side in (-1, 1):
        outwards = sorted((side * (columns[i] - camera), i) for i, track in enumerate(tracks) if track.side == side)
        position, last = 0, 0.0
        for number, (distance, index) in enumerate(outwards):
            gap = (distance - last) / lane_width
            position += 1 if gap < (_FIRST_GAP if number == 0 else _NEXT_GAP) else 2
            last = distance
            result[index] = side * position
    return result
