"""The tracker of one camera: detections in, boundaries with identities out."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import Detection, EgoLane, FrameResult, LaneBoundary, LaneChange
from lanestream.road.view import RoadView, visible_spans
from lanestream.tracking.association import associate, recover
from lanestream.tracking.ego_lane import LaneWidth, Sides, positions
from lanestream.tracking.kalman import Motion, Rows, boundary_filter
from lanestream.tracking.state import TrackerState, TrackState, told_rows
from lanestream.tracking.tracks import Track


@dataclass(frozen=True)
class TrackerSettings:
    """A tracker's settings; lengths are shares of the depth of the road view unless said otherwise.

    Boundaries are followed at the depths `shares`, where they accelerate by about `acceleration` per second squared and
    start with up to `speed` per second. A detection's own covariance is widened by `noise` and by a horizon that nods
    by `nod`. A track is confirmed by `birth[0]` hits in `birth[1]` frames and coasts for `coast_s` seconds. Where the
    road turns or the camera nods nobody knows where a coasting boundary is: it is told until the columns that it was
    moved by at the near and the middle row, each over its rows below the horizon, differ by `turn` in all. One that a
    detection leaves behind by less than `recover` lane widths starts again there. Tracks of one marking, nearer than
    `merge` lane widths, become one.
    """

    shares: tuple[float, float, float] = (1.0, 0.5, 0.2)
    acceleration: tuple[float, float, float] = (2.5, 1.6, 1.0)
    speed: tuple[float, float, float] = (1.0, 0.5, 0.3)
    noise: float = 0.05
    nod: float = 0.006
    birth: tuple[int, int] = (3, 5)
    coast_s: float = 0.7
    turn: float = 0.15
    recover: float = 0.3
    merge: float = 0.35


class LaneTracker:
    """Follows the boundaries of one camera with one Kalman filter each.

    The first frames of a camera have nothing to be compared with, so there tentative tracks are told as well: a single
    image gets its lanes, and a stream has lanes from its first frame on.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self._settings = settings or TrackerSettings()
        self._tracks: list[Track] = []
        self._rows: Rows | None = None
        self._width = LaneWidth()
        self._sides = Sides()
        self._next_id = 1
        self._clock = 0.0
        self._last_timestamp: float | None = None
        self._frames = 0

    @classmethod
    def restored(cls, state: TrackerState, ids_lost: int = 0) -> LaneTracker:
        """The tracker that goes on where `state` was taken, with the default settings.

        `ids_lost` more ids are taken as given: by the tracker that went on after `state` was taken, and was lost.
        Raises ValueError for a state that is none.
        """
        tracker = cls()
        tracker._tracks = [each.track(tracker._settings.birth[1]) for each in state.tracks]
        tracker._rows = state.followed_rows
        tracker._width.value = state.lane_width
        tracker._next_id = state.next_id + ids_lost
        tracker._clock, tracker._last_timestamp = state.clock, state.last_timestamp
        tracker._frames = state.frames
        return tracker

    @property
    def state(self) -> TrackerState:
        """All that it remembers, to be restored later."""
        horizon, rows = told_rows(self._rows)
        return TrackerState(
            tracks=tuple(TrackState.of(track) for track in self._tracks),
            horizon=horizon,
            rows=rows,
            lane_width=self._width.value,
            next_id=self._next_id,
            clock=self._clock,
            last_timestamp=self._last_timestamp,
            frames=self._frames,
        )

    @property
    def curves(self) -> tuple[Curve, ...]:
        """Where the boundaries were in the last frame."""
        rows = self._rows
        return () if rows is None else tuple(rows.curve(t.columns) for t in self._tracks if t.confirmed)

    def update(self, detections: Sequence[Detection], timestamp: float, view: RoadView) -> FrameResult:
        """One step: `detections` of the frame captured at `timestamp` (seconds), seen in `view`.

        A timestamp that goes backwards counts as no time at all.
        """
        rows = self._rows_for(view)
        self._predict(self._elapsed(timestamp), view)
        self._forget()
        measured = [self._measured(detection, rows, view) for detection in detections]
        pairs = associate(self._tracks, measured)
        lost = recover(self._tracks, measured, pairs, self._lane_widths(self._settings.recover, view))
        for i, j in lost:
            self._tracks[i].restart(boundary_filter(*measured[j], self._scaled(self._settings.speed, view)))
        pairs = [*lost, *(pair for pair in pairs if all(pair[1] != j for _, j in lost))]
        for i, j in pairs:
            self._tracks[i].hit(detections[j], *measured[j], self._clock)
        matched = {i for i, _ in pairs}
        for i, track in enumerate(self._tracks):
            if i not in matched:
                track.miss()
        self._shift_coasting(matched, view)
        taken = {j for _, j in pairs}
        for j, detection in enumerate(detections):
            if j not in taken:
                self._tracks.append(self._new(detection, *measured[j], view))
        self._frames += 1
        self._confirm()
        self._tracks = self._merged(self._alive(view), view)
        return self._result(view)

    def _elapsed(self, timestamp: float) -> float:
        last, self._last_timestamp = self._last_timestamp, timestamp
        seconds = 0.0 if last is None else max(0.0, timestamp - last)
        self._clock += seconds
        return seconds

    def _rows_for(self, view: RoadView) -> Rows:
        """The rows to follow; chosen anew when the horizon has moved too far from the one they were chosen for."""
        if self._rows is None or abs(self._rows.horizon - view.horizon) > 0.02 * view.depth:
            rows = Rows.of(view, self._settings.shares)
            for track in self._tracks:
                track.move_rows(self._rows or rows, rows)
            self._rows = rows
        return self._rows

    def _scaled(self, shares: tuple[float, float, float], view: RoadView) -> FloatArray:
        return np.asarray(shares) * view.depth

    def _lane_widths(self, number: float, view: RoadView) -> FloatArray:
        """`number` lane widths in pixels at the rows that boundaries are followed at (3,)."""
        return number * self._width.value * self._scaled(self._settings.shares, view)

    def _predict(self, seconds: float, view: RoadView) -> None:
        # Beyond the coasting time a track dies anyway, and a long step would only overflow.
        step = min(seconds, 2.0 * self._settings.coast_s)
        motion = Motion.over(step, self._scaled(self._settings.acceleration, view))
        for track in self._tracks:
            track.previous_columns = track.columns.copy()
            motion.move(track.kalman)

    def _forget(self) -> None:
        """Drops what a gap in the stream has made too old; with nothing left, the stream begins anew."""
        self._tracks = [t for t in self._tracks if self._clock - t.last_hit <= self._settings.coast_s]
        if not self._tracks:
            self._frames = 0

    def _measured(self, detection: Detection, rows: Rows, view: RoadView) -> tuple[FloatArray, FloatArray]:
        """Columns of a detection and what they are worth: the fit, the eye, and the nodding horizon that moves all."""
        columns, covariance = rows.measured(detection.curve, detection.covariance)
        nod = detection.curve.slope(rows.y) * self._settings.nod * view.depth
        noise = (self._settings.noise * view.depth) ** 2 * np.eye(3)
        return columns, covariance + noise + np.outer(nod, nod)

    def _shift_coasting(self, matched: set[int], view: RoadView) -> None:
        """Moves unmatched tracks as the matched ones have moved: it was the camera, not the road."""
        seen = [
            track.columns - track.previous_columns
            for i, track in enumerate(self._tracks)
            if i in matched and track.confirmed and track.seen_twice
        ]
        for i, track in enumerate(self._tracks):
            if i not in matched:
                if seen:
                    track.kalman.x[:3] = track.previous_columns + np.median(seen, axis=0)
                track.carried(self._scaled(self._settings.shares, view))

    def _new(self, detection: Detection, columns: FloatArray, noise: FloatArray, view: RoadView) -> Track:
        kalman = boundary_filter(columns, noise, self._scaled(self._settings.speed, view))
        return Track(
            kalman,
            born=self._clock,
            last_hit=self._clock,
            probability=detection.probability,
            top=detection.top,
            bottom=detection.bottom,
            hits=deque([True], maxlen=self._settings.birth[1]),
            side=1 if detection.curve.x(view.bottom) >= _camera(view) else -1,
        )

    def _confirm(self) -> None:
        hits_needed = self._settings.birth[0]
        for track in sorted(self._tracks, key=lambda t: float(t.columns[0])):
            if not track.confirmed and (sum(track.hits) >= hits_needed or self._frames < hits_needed):
                track.track_id = self._next_id
                self._next_id += 1

    def _alive(self, view: RoadView) -> list[Track]:
        return [track for track in self._tracks if self._lives(track, view)]

    def _lives(self, track: Track, view: RoadView) -> bool:
        if not track.confirmed:
            misses = len(track.hits) - sum(track.hits)
            return misses <= self._settings.birth[1] - self._settings.birth[0]
        return float(np.sqrt(track.kalman.P[0, 0])) <= self._settings.merge * self._width.value * view.depth

    def _merged(self, tracks: list[Track], view: RoadView) -> list[Track]:
        """Of tracks that have run together the oldest stays, with its identity."""
        kept: list[Track] = []
        least = self._lane_widths(self._settings.merge, view)
        for track in sorted(tracks, key=lambda t: (not t.confirmed, t.born, t.track_id or 0)):
            if not any(bool((np.abs(track.columns - other.columns) < least)[:2].all()) for other in kept):
                kept.append(track)
        return kept

    def _result(self, view: RoadView) -> FrameResult:
        assert self._rows is not None  # noqa: S101 - chosen at the start of the update
        told = (t for t in self._tracks if t.confirmed and t.turned <= self._settings.turn)
        tracks = sorted(told, key=lambda t: float(t.columns[0]))
        curves = [self._rows.curve(track.columns) for track in tracks]
        columns = [float(curve.x(view.bottom)) for curve in curves]
        lane_width = self._width.value * view.depth
        events = self._changes(tracks, columns, view, lane_width)
        places = positions(tracks, columns, _camera(view), lane_width)
        lanes = []
        spans = visible_spans(curves, view, 0.1)
        for track, curve, place, span in zip(tracks, curves, places, spans, strict=True):
            if span is not None:
                lanes.append(self._boundary(track, place, curve, (max(span[0], track.top), span[1])))
        return FrameResult(tuple(lanes), self._ego(tracks, columns, places, view), view.horizon, tuple(events))

    def _changes(
        self, tracks: Sequence[Track], columns: Sequence[float], view: RoadView, lane_width: float
    ) -> list[LaneChange]:
        found = [self._sides.update(t, c, _camera(view), lane_width) for t, c in zip(tracks, columns, strict=True)]
        return [change for change in found if change is not None]

    def _boundary(self, track: Track, place: int, curve: Curve, span: tuple[float, float]) -> LaneBoundary:
        assert self._rows is not None and track.track_id is not None  # noqa: S101, PT018 - a confirmed track
        # A boundary that nobody has seen for a while is less and less sure to be there.
        fade = 1.0 - 0.5 * min(1.0, (self._clock - track.last_hit) / self._settings.coast_s)
        return LaneBoundary(
            track_id=track.track_id,
            position=place,
            state="detected" if track.detected else "predicted",
            probability=track.probability * fade,
            curve=curve,
            covariance=self._rows.covariance_of_curve(track.kalman.P[:3, :3]),
            top=span[0],
            bottom=span[1],
            age_s=self._clock - track.born,
        )

    def _ego(self, tracks: Sequence[Track], columns: Sequence[float], places: Sequence[int], view: RoadView) -> EgoLane:
        at = {place: index for index, place in enumerate(places)}
        left, right = at.get(-1), at.get(1)
        offset = None
        if left is not None and right is not None:
            width = columns[right] - columns[left]
            self._width.learn(width / view.depth)
            if width > 0.0:
                offset = (_camera(view) - 0.5 * (columns[left] + columns[right])) / width
        return EgoLane(
            None if left is None else tracks[left].track_id, None if right is None else tracks[right].track_id, offset
        )


def _camera(view: RoadView) -> float:
    """The column that the camera stands in."""
    return (view.width - 1) / 2.0
