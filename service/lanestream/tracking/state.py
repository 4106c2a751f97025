"""The state of a tracker as a small value of plain types: it can be saved, and restored exactly in another process."""

from __future__ import annotations

from base64 import b64decode, b64encode
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final, get_args

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import one_line
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES, Appearance
from lanestream.road.results import TrackState
from lanestream.road.view import LANE_WIDTHS, USUAL_LANE_WIDTH
from lanestream.tracking.frame_clock import FrameClock
from lanestream.tracking.kalman import Gaussian
from lanestream.tracking.road_filter import MOST_PITCH, OWN, PITCH, ROAD, RoadFilter
from lanestream.tracking.tracks import ACTIVITIES, FRAMES, SCALES, Track

# The road filter: its mean, and the lower triangle of its covariance.
_NUMBER: Final = np.dtype("<f4")
# A track; id 0 is that of a tentative one, and bit n of `hits` the frame n frames ago. Types and colors that are not
# known are zero.
_TRACK: Final = np.dtype(
    [
        ("track_id", "<u8"),
        ("born", "<f8"),
        ("last_hit", "<f8"),
        ("crossed", "<f8"),
        ("probability", "<f4"),
        ("top", "<f4"),
        ("bottom", "<f4"),
        ("place", "<f4"),
        ("scale", "<f4"),
        ("paint", "<f4"),
        ("side", "i1"),
        ("state", "u1"),
        ("hits", "u1"),
        ("frames", "u1"),
        ("surprising", "<u4"),
        ("road_edge", "<f4"),
        ("types", "<f2", len(MARKING_TYPES)),
        ("colors", "<f2", len(MARKING_COLORS)),
    ]
)
_STATES: Final[tuple[TrackState, ...]] = get_args(TrackState)

# The largest count or time in seconds of a saved state; larger integers are not exact as floats.
MAX_COUNT: Final = float(2**53)
# The limits of pixel coordinates, of the depth of a view in pixels, and of the numbers of a filter, in depths.
_MOST_PIXELS: Final = 1e6
_LEAST_DEPTH: Final = 10.0
_MOST_IN_FILTER: Final = 1e3
_MOST_TRACKS: Final = 32
# Of a wrong number in an error message.
_MOST_DIGITS: Final = 24
# By rounding to single precision, an eigenvalue of a covariance scaled to correlations may be negative by this.
_ROUNDING: Final = 1e-4
# By rounding to half precision, the sum of probabilities may miss 1 by this.
_SUM_ROUNDING: Final = 2e-3


@dataclass(frozen=True)
class TrackerState:
    """A tracker: its tracks and its road filter, packed, and the rest that it remembers.

    `tracks` and `filter` are arrays in base 64. `horizon` and `depth` are those of the filter, in pixels.
    """

    tracks: str = ""
    filter: str = ""
    horizon: float = 0.0
    depth: float = 100.0
    mean_horizon: float = 0.0
    lane_width: float = USUAL_LANE_WIDTH
    next_id: int = 1
    clock: FrameClock = field(default_factory=FrameClock)
    frames: int = 0
    activity: float = 1.0

    @classmethod
    def packed(
        cls,
        tracks: Sequence[Track],
        road: RoadFilter | None,
        *,
        mean_horizon: float,
        lane_width: float,
        next_id: int,
        clock: FrameClock,
        frames: int,
        activity: float,
    ) -> TrackerState:
        """Returns the state of a tracker with these `tracks` on this `road`."""
        if road is None:
            return cls(lane_width=lane_width, next_id=next_id, clock=clock, frames=frames, activity=activity)
        return cls(
            tracks=_pack_tracks(tracks),
            filter=_pack_filter(road),
            horizon=road.horizon,
            depth=road.depth,
            mean_horizon=mean_horizon,
            lane_width=lane_width,
            next_id=next_id,
            clock=clock,
            frames=frames,
            activity=activity,
        )

    def unpacked(self) -> tuple[list[Track], RoadFilter | None]:
        """Returns the tracks and the road filter. Raises ValueError for incomplete ones."""
        tracks = [_unpack_track(record) for record in _unpack(self.tracks, _TRACK)]
        if not self.filter:
            if tracks:
                raise ValueError("the road filter is missing")
            return [], None
        numbers = _unpack(self.filter, _NUMBER).astype(np.float64)
        size = ROAD + OWN * len(tracks)
        if len(numbers) != size + size * (size + 1) // 2:
            raise ValueError(f"the road filter has {len(numbers)} numbers, which are not those of {len(tracks)} tracks")
        covariance = np.zeros((size, size))
        lower = np.tril_indices(size)
        covariance[lower] = numbers[size:]
        covariance.T[lower] = numbers[size:]
        return tracks, RoadFilter(self.horizon, self.depth, 0.0, Gaussian(numbers[:size].copy(), covariance))

    def validate(self) -> None:
        """Checks a state from outside this process. Raises ValueError, on one line, if no tracker can have it."""
        check_range("frames", self.frames, 0, MAX_COUNT)
        check_range("activity", self.activity, *ACTIVITIES)
        check_range("lane_width", self.lane_width, *LANE_WIDTHS)
        check_range("next_id", self.next_id, 1, MAX_COUNT)
        check_range("horizon", self.horizon, -_MOST_PIXELS, _MOST_PIXELS)
        check_range("depth", self.depth, _LEAST_DEPTH, _MOST_PIXELS)
        reach = MOST_PITCH * self.depth
        check_range("mean_horizon", self.mean_horizon, self.horizon - reach, self.horizon + reach)
        check_range("clock", self.clock.now, 0.0, MAX_COUNT)
        check_range("timestamp", self.clock.timestamp, -MAX_COUNT, MAX_COUNT)
        check_range("step", self.clock.step, 1e-9, MAX_COUNT)
        check_range("long_steps", self.clock.long_steps, 0, MAX_COUNT)
        check_range("factor", self.clock.factor, 1e-3, 1.0)
        tracks, road = self.unpacked()
        check_range("number of tracks", len(tracks), 0, _MOST_TRACKS)
        for track in tracks:
            self._check_track(track)
        ids = [track.track_id for track in tracks if track.track_id is not None]
        if len(set(ids)) < len(ids):
            raise ValueError("two tracks have the same id")
        if road is not None:
            _check_filter(road.state)

    def _check_track(self, track: Track) -> None:
        if track.track_id is not None:
            check_range("track_id", track.track_id, 1, self.next_id - 1)
        check_range("last_hit", track.last_hit, 0.0, self.clock.now)
        check_range("born", track.born, 0.0, track.last_hit)
        check_range("crossed", track.crossed, 0.0, self.clock.now)
        check_range("probability", track.probability, 0.0, 1.0)
        check_range("bottom", track.bottom, -_MOST_PIXELS, _MOST_PIXELS)
        check_range("top", track.top, -_MOST_PIXELS, track.bottom)
        check_range("place", track.place, -_MOST_IN_FILTER, _MOST_IN_FILTER)
        check_range("scale", track.scale, *SCALES)
        check_range("paint", track.paint, 0.0, 1.0)
        check_range("number of hits", len(track.hits), 1, FRAMES)
        check_range("road_edge", track.appearance.road_edge, 0.0, 1.0)
        _check_distribution("types", track.appearance.types)
        _check_distribution("colors", track.appearance.colors)
        if track.side not in (-1, 1):
            raise ValueError("the side of a track is neither -1 nor 1")


def check_range(name: str, value: float | None, least: float, most: float) -> None:
    """Raises ValueError if `value` is outside a range, or NaN. None is accepted."""
    if value is not None and not least <= value <= most:
        raise ValueError(f"{name} is {one_line(value, _MOST_DIGITS)}; expected {least:g} to {most:g}")


def _check_distribution(name: str, probabilities: tuple[float, ...] | None) -> None:
    """Raises ValueError unless the numbers are probabilities with the sum 1. None is accepted."""
    if probabilities is None:
        return
    for probability in probabilities:
        check_range(name, probability, 0.0, 1.0)
    check_range(f"sum of {name}", sum(probabilities), 1.0 - _SUM_ROUNDING, 1.0 + _SUM_ROUNDING)


def _pack_tracks(tracks: Sequence[Track]) -> str:
    records = np.array(
        [
            (
                track.track_id or 0,
                track.born,
                track.last_hit,
                track.crossed,
                track.probability,
                track.top,
                track.bottom,
                track.place,
                track.scale,
                track.paint,
                track.side,
                _STATES.index(track.state),
                sum(hit << age for age, hit in enumerate(reversed(track.hits))),
                len(track.hits),
                track.surprising,
                track.appearance.road_edge,
                track.appearance.types or (0.0,) * len(MARKING_TYPES),
                track.appearance.colors or (0.0,) * len(MARKING_COLORS),
            )
            for track in tracks
        ],
        _TRACK,
    )
    return b64encode(records.tobytes()).decode()


def _unpack_track(record: np.void) -> Track:
    values: dict[str, Any] = dict(zip(_TRACK.names or (), record.item(), strict=True))
    state, hits, frames = (values.pop(name) for name in ("state", "hits", "frames"))
    if state >= len(_STATES):
        raise ValueError(f"the state of a track is {state}; expected 0 to {len(_STATES) - 1}")
    values["track_id"] = values["track_id"] or None
    road_edge, types, colors = (values.pop(name) for name in ("road_edge", "types", "colors"))
    appearance = Appearance(road_edge, _known(types), _known(colors))
    recent = (bool(hits >> age & 1) for age in reversed(range(frames)))
    return Track(**values, state=_STATES[state], appearance=appearance, hits=deque(recent, maxlen=FRAMES))


def _known(probabilities: NDArray[np.float16]) -> tuple[float, ...] | None:
    return tuple(probabilities.tolist()) if probabilities.any() else None


def _pack_filter(road: RoadFilter) -> str:
    state = road.state
    numbers = np.concatenate([state.mean, state.covariance[np.tril_indices(len(state.mean))]])
    return b64encode(numbers.astype(_NUMBER).tobytes()).decode()


def _unpack(text: str, kind: np.dtype[np.void] | np.dtype[np.float32]) -> np.ndarray:
    try:
        data = b64decode(text, validate=True)
    except ValueError:
        raise ValueError("a packed array is not valid base 64") from None
    if len(data) % kind.itemsize:
        raise ValueError(f"a packed array has {len(data)} bytes; expected a multiple of {kind.itemsize}")
    return np.frombuffer(data, kind)


def _check_filter(state: Gaussian) -> None:
    """Raises ValueError unless the numbers are finite and the covariance is positive semidefinite."""
    if not (np.abs(state.mean) <= _MOST_IN_FILTER).all() or not (np.abs(state.covariance) <= _MOST_IN_FILTER).all():
        raise ValueError("the road filter has numbers that are not finite, or too large")
    check_range("pitch", float(state.mean[PITCH]), -MOST_PITCH, MOST_PITCH)
    variances = state.covariance.diagonal()
    if variances.min() < 0.0:
        raise ValueError("the road filter has a negative variance")
    scale = 1.0 / np.sqrt(np.maximum(variances, 1e-12))
    if np.linalg.eigvalsh(state.covariance * np.outer(scale, scale))[0] < -_ROUNDING:
        raise ValueError("the covariance of the road filter is not positive semidefinite")
