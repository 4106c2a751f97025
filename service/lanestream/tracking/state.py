"""The state of a tracker as a small value of plain types: it can be saved, and restored exactly in another process."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.errors import one_line
from lanestream.road.view import LANE_WIDTHS, USUAL_LANE_WIDTH
from lanestream.tracking.kalman import STATE, TrackedRows
from lanestream.tracking.tracks import Track

_NUMBERS: Final = "<f8"
_FILTER_BYTES: Final = 8 * (STATE + STATE**2)

# The largest count or time in seconds of a saved state; larger integers are not exact as floats.
MAX_COUNT: Final = float(2**53)
# The limits of pixel coordinates, and of the numbers of a filter, which include velocities and variances.
_MOST_PIXELS: Final = 1e6
_MOST_IN_FILTER: Final = 1e10
_MOST_TRACKS: Final = 128
_MOST_HITS: Final = 32
# Of a wrong number in an error message.
_MOST_DIGITS: Final = 24
# Each tracked row is this much farther below the horizon than the next one, so that three rows determine a curve.
_ROW_RATIO: Final = 1.1
# By rounding, a covariance may be asymmetric, and an eigenvalue negative, by this share of its largest number.
_ROUNDING: Final = 1e-12


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

    def validate(self, clock: float, next_id: int) -> None:
        """Raises ValueError if no track of a tracker with this `clock` and `next_id` can have this state."""
        if self.track_id is not None:
            check_range("track_id", self.track_id, 1, next_id - 1)
        check_range("last_hit", self.last_hit, 0.0, clock)
        check_range("born", self.born, 0.0, self.last_hit)
        check_range("probability", self.probability, 0.0, 1.0)
        check_range("bottom", self.bottom, -_MOST_PIXELS, _MOST_PIXELS)
        check_range("top", self.top, -_MOST_PIXELS, self.bottom)
        check_range("number of hits", len(self.hits), 1, _MOST_HITS)
        check_range("crossing", self.crossing, 0, MAX_COUNT)
        check_range("drift", self.drift, 0.0, MAX_COUNT)
        if self.side not in (-1, 1):
            raise ValueError("the side of a track is neither -1 nor 1")
        _check_filter(self.filter)

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

    def validate(self) -> None:
        """Checks a state from outside this process. Raises ValueError, on one line, if no tracker can have it."""
        check_range("number of tracks", len(self.tracks), 0, _MOST_TRACKS)
        check_range("frames", self.frames, 0, MAX_COUNT)
        check_range("clock", self.clock, 0.0, MAX_COUNT)
        check_range("last_timestamp", self.last_timestamp, -MAX_COUNT, MAX_COUNT)
        check_range("lane_width", self.lane_width, *LANE_WIDTHS)
        check_range("next_id", self.next_id, 1, MAX_COUNT)
        self._check_rows()
        for track in self.tracks:
            track.validate(self.clock, self.next_id)
        ids = [track.track_id for track in self.tracks if track.track_id is not None]
        if len(set(ids)) < len(ids):
            raise ValueError("two tracks have the same id")

    def _check_rows(self) -> None:
        if self.horizon is None or self.rows is None:
            if self.horizon is not None or self.rows is not None or self.tracks:
                raise ValueError("the tracked rows or their horizon are missing")
            return
        check_range("horizon", self.horizon, -_MOST_PIXELS, _MOST_PIXELS)
        # Row offsets below 1 count as 1.
        near, middle, far = (max(row - self.horizon, 1.0) for row in self.rows)
        if not (_MOST_PIXELS >= near >= _ROW_RATIO * middle >= _ROW_RATIO**2 * far):
            raise ValueError(f"the tracked rows are {self.rows}, below the horizon {self.horizon:g}")

    @property
    def tracked_rows(self) -> TrackedRows | None:
        """The rows as the tracker has them; None before its first frame."""
        if self.horizon is None or self.rows is None:
            return None
        return TrackedRows(self.horizon, np.array(self.rows))


def check_range(name: str, value: float | None, least: float, most: float) -> None:
    """Raises ValueError if `value` is outside a range, or NaN. None is accepted."""
    if value is not None and not least <= value <= most:
        raise ValueError(f"{name} is {one_line(value, _MOST_DIGITS)}; expected {least:g} to {most:g}")


def _check_filter(text: str) -> None:
    """Raises ValueError unless `text` holds the state and the covariance of a filter."""
    try:
        data = b64decode(text, validate=True)
    except ValueError:
        raise ValueError("the filter of a track is not valid base 64") from None
    if len(data) != _FILTER_BYTES:
        raise ValueError(f"the filter of a track has {len(data)} bytes; expected {_FILTER_BYTES}")
    numbers = np.frombuffer(data, _NUMBERS)
    if not (np.abs(numbers) <= _MOST_IN_FILTER).all():
        raise ValueError("the filter of a track has numbers that are not finite, or too large")
    covariance = numbers[STATE:].reshape(STATE, STATE)
    tolerance = _ROUNDING * float(np.abs(covariance).max())
    if (np.abs(covariance - covariance.T) > tolerance).any():
        raise ValueError("the covariance of a track is not symmetric")
    if np.linalg.eigvalsh(covariance)[0] < -tolerance or covariance.diagonal().min() < 0.0:
        raise ValueError("the covariance of a track is not positive semidefinite")
