"""What a tracker remembers, as a small value of plain types: saved in one process, it goes on exactly in another."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream.tracking.kalman import Rows, boundary_filter
from lanestream.tracking.tracks import Track

_STATE: Final = 6
_NUMBERS: Final = "<f8"


@dataclass(frozen=True)
class TrackState:
    """One track: `filter` holds its filter's state (6) and covariance (6 x 6), little-endian doubles in base 64."""

    track_id: int | None
    filter: str
    born: float
    last_hit: float
    probability: float
    top: float
    bottom: float
    hits: tuple[bool, ...]
    side: int
    crossing: int
    detected: bool
    turned: float = 0.0

    @classmethod
    def of(cls, track: Track) -> TrackState:
        """The state of `track`."""
        numbers = np.concatenate([track.kalman.x, track.kalman.P.ravel()])
        return cls(
            track_id=track.track_id,
            filter=b64encode(numbers.astype(_NUMBERS).tobytes()).decode(),
            born=track.born,
            last_hit=track.last_hit,
            probability=track.probability,
            top=track.top,
            bottom=track.bottom,
            hits=tuple(track.hits),
            side=track.side,
            crossing=track.crossing,
            detected=track.detected,
            turned=track.turned,
        )

    def track(self, memory: int) -> Track:
        """The track in this state, which remembers the hits of `memory` frames. Raises ValueError for half a filter."""
        numbers = np.frombuffer(b64decode(self.filter, validate=True), _NUMBERS).astype(float)
        x, covariance = numbers[:_STATE], numbers[_STATE:].reshape(_STATE, _STATE)
        kalman = boundary_filter(x[:3], covariance[:3, :3], np.zeros(3))
        kalman.x, kalman.P = x.copy(), covariance.copy()
        return Track(
            kalman,
            born=self.born,
            last_hit=self.last_hit,
            probability=self.probability,
            top=self.top,
            bottom=self.bottom,
            hits=deque(self.hits, maxlen=memory),
            side=self.side,
            track_id=self.track_id,
            crossing=self.crossing,
            detected=self.detected,
            turned=self.turned,
        )


@dataclass(frozen=True)
class TrackerState:
    """A tracker: its tracks, the rows that it follows them at, its clock, and the ids that it has given."""

    tracks: tuple[TrackState, ...]
    horizon: float | None
    rows: tuple[float, float, float] | None
    lane_width: float
    next_id: int
    clock: float
    last_timestamp: float | None
    frames: int

    @property
    def followed_rows(self) -> Rows | None:
        """The rows as the tracker has them; None before its first frame."""
        if self.horizon is None or self.rows is None:
            return None
        return Rows(self.horizon, np.array(self.rows))


def told_rows(rows: Rows | None) -> tuple[float | None, tuple[float, float, float] | None]:
    """Horizon and rows as plain numbers."""
    return (None, None) if rows is None else (rows.horizon, _three(rows.y))


def _three(values: FloatArray) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in values)
    return a, b, c
