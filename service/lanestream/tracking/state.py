"""The state of a tracker as a small value of plain types: it can be saved, and restored exactly in another process."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.view import USUAL_LANE_WIDTH
from lanestream.tracking.kalman import STATE, TrackedRows
from lanestream.tracking.tracks import Track

_NUMBERS: Final = "<f8"


@dataclass(frozen=True)
class TrackSnapshot:
    """One track: `filter` holds its state (6) and covariance (6 x 6), little-endian doubles in base 64."""

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
    drift: float = 0.0

    @classmethod
    def of(cls, track: Track) -> TrackSnapshot:
        """Returns the snapshot of `track`."""
        numbers = np.concatenate([track.state, track.covariance.ravel()])
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
            drift=track.drift,
        )

    def track(self, memory: int) -> Track:
        """Returns the track, which keeps the hits of `memory` frames. Raises ValueError for an incomplete filter."""
        numbers = np.frombuffer(b64decode(self.filter, validate=True), _NUMBERS).astype(float)
        return Track(
            numbers[:STATE].copy(),
            numbers[STATE:].reshape(STATE, STATE).copy(),
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
            drift=self.drift,
        )


@dataclass(frozen=True)
class TrackerState:
    """A tracker: its tracks, the rows at which it follows them, its clock, and the ids it has assigned."""

    tracks: tuple[TrackSnapshot, ...] = ()
    horizon: float | None = None
    rows: tuple[float, float, float] | None = None
    lane_width: float = USUAL_LANE_WIDTH
    next_id: int = 1
    clock: float = 0.0
    last_timestamp: float | None = None
    frames: int = 0

    @property
    def tracked_rows(self) -> TrackedRows | None:
        """The rows as the tracker has them; None before its first frame."""
        if self.horizon is None or self.rows is None:
            return None
        return TrackedRows(self.horizon, np.array(self.rows))
