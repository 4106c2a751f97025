"""Places beside the camera: which boundaries bound the ego lane, and when the camera has crossed one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lanestream.road.results import LaneChange
from lanestream.tracking.tracks import Track

# A lane is 2.5 to 4 m wide and a camera 1.0 to 2.4 m high: its width over the rows below the horizon.
_WIDTHS = (1.1, 4.0)


@dataclass
class LaneWidth:
    """The ego lane's width in rows below the horizon, learned slowly; starts as 3.5 m seen from 1.5 m."""

    value: float = 2.3
    gain: float = 0.05

    def learn(self, width: float) -> None:
        """Takes in one frame's width; one that no lane has is ignored."""
        if _WIDTHS[0] <= width <= _WIDTHS[1]:
            self.value += self.gain * (width - self.value)


@dataclass(frozen=True)
class Sides:
    """When a boundary has changed sides: beyond `margin` lane widths from the camera, for `frames` frames."""

    margin: float = 0.1
    frames: int = 3

    def update(self, track: Track, column: float, camera: float, lane_width: float) -> LaneChange | None:
        """Notes a track's column at the bottom row; a lane change where it has just changed sides for good."""
        away = (column - camera) * track.side
        if away > -self.margin * lane_width:
            track.crossing = 0
            return None
        track.crossing += 1
        if track.crossing < self.frames:
            return None
        track.side, track.crossing = -track.side, 0
        if track.track_id is None:
            return None
        # A boundary that wanders to the left shows that the camera went to the right.
        return LaneChange(track.track_id, "right" if track.side < 0 else "left")


def positions(tracks: Sequence[Track], columns: Sequence[float], camera: float, lane_width: float) -> list[int]:
    """The position of each track from its column at the bottom row.

    Boundaries are counted outwards from the camera. A gap of about two lane widths counts as two, so that a boundary
    nobody sees leaves its place empty.
    """
    result = [0] * len(tracks)
    for side in (-1, 1):
        outwards = sorted((side * (columns[i] - camera), i) for i, track in enumerate(tracks) if track.side == side)
        place, last = 0, 0.0
        for number, (distance, index) in enumerate(outwards):
            gap = (distance - last) / lane_width
            # The camera may be anywhere in its lane, so the first boundary is up to a whole lane width away.
            steps = 1 if gap < (1.3 if number == 0 else 1.6) else 2
            place, last = place + steps, distance
            result[index] = side * place
    return result
