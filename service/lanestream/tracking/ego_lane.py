"""The ego lane: its width, the positions of boundaries relative to the vehicle, and lane changes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lanestream.road.view import LANE_WIDTHS
from lanestream.tracking.tracks import Track

# How quickly the lane width follows that of a frame.
_WIDTH_GAIN: Final = 0.05
# A boundary has changed sides this many lane widths beyond the middle of the vehicle: the first if the vehicle moves
# towards that side by at least this many lane widths per second, or else the second.
_MOVING_MARGIN, _MOVING, _MARGIN = 0.01, 0.1, 0.1
# A gap of more lane widths than this counts as two lanes. The vehicle may be anywhere in its lane, so the first
# boundary is up to a whole lane width away.
_FIRST_GAP: Final = 1.3
_NEXT_GAP: Final = 1.6


def learned_width(width: float, measured: float) -> float:
    """Returns the updated lane width, in row offsets; a `measured` width outside the limits of lanes is ignored."""
    narrowest, widest = LANE_WIDTHS
    return width + _WIDTH_GAIN * (measured - width) if narrowest <= measured <= widest else width


def has_changed_sides(
    track: Track, place: float, sideways: float, lane_width: float, earlier: float, now: float
) -> bool:
    """Records where a boundary is at the time `now`; returns whether it has changed sides of the vehicle.

    `place` and `lane_width` are in row offsets, `place` from the vehicle's middle; `sideways` is the speed at which the
    vehicle moves to the right, in row offsets per second. The last frame was at the time `earlier`. The track's
    `crossed` is then the time of the crossing, interpolated between frames.
    """
    if (place < 0.0) != (track.place < 0.0):
        track.crossed = earlier + (now - earlier) * track.place / (track.place - place)
    track.place = place
    # A boundary that moves to the left shows that the vehicle moves to the right.
    moves = -track.side * sideways < -_MOVING * lane_width
    margin = _MOVING_MARGIN if moves else _MARGIN
    if place * track.side > -margin * lane_width:
        return False
    track.side = -track.side
    return True


def lane_positions(tracks: Sequence[Track], places: Sequence[float], lane_width: float) -> list[int]:
    """Returns the position of each track from its place, in row offsets from the vehicle's middle.

    Boundaries are counted outwards from the vehicle. A gap of about two lane widths counts as two, so that a boundary
    that is not seen leaves its position empty.
    """
    result = [0] * len(tracks)
    for side in (-1, 1):
        outwards = sorted((side * places[i], i) for i, track in enumerate(tracks) if track.side == side)
        position, last = 0, 0.0
        for number, (distance, index) in enumerate(outwards):
            gap = (distance - last) / lane_width
            position += 1 if gap < (_FIRST_GAP if number == 0 else _NEXT_GAP) else 2
            last = distance
            result[index] = side * position
    return result
