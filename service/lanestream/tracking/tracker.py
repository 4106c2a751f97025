"""The tracker of one camera: follows its boundaries from frame to frame and gives them identities."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from lanestream.road.curve import Curves, FloatArray
from lanestream.road.results import Detection, EgoLane, FrameResult, LaneBoundary, LaneChange
from lanestream.road.view import USUAL_LANE_WIDTH, RoadView, visible_spans
from lanestream.tracking.association import associate, recover
from lanestream.tracking.ego_lane import lane_change, lane_positions, learned_width
from lanestream.tracking.kalman import MEASURED, TrackedRows, initial_state, predict, update
from lanestream.tracking.state import TrackerState, TrackSnapshot
from lanestream.tracking.tracks import Track

# Lengths are shares of the depth of the road view. Boundaries are tracked at these rows, with this acceleration noise
# (per second squared) and this sigma of the initial velocity (per second).
_ROWS: Final[FloatArray] = np.array([1.0, 0.5, 0.2])
_ACCELERATION: Final[FloatArray] = np.array([2.5, 1.6, 1.0])
_SPEED: Final[FloatArray] = np.array([1.0, 0.5, 0.3])
# Noise that is added to a detection's covariance: of its columns, and of the horizon's row as the camera pitches.
_NOISE: Final = 0.05
_PITCH: Final = 0.006
# A track is confirmed by this many hits within this many frames, and coasts for this many seconds without any.
_HITS: Final = 3
_FRAMES: Final = 5
_COAST_S: Final = 0.7
# If the road turns or the camera pitches, the position of a coasting boundary is uncertain. It is reported until its
# shifts at the near and the middle row, each over its row offset, have diverged by this in total.
_MOST_DRIFT: Final = 0.15
# In lane widths: a track restarts at a detection outside its gate that is closer than the first, and tracks closer than
# the second follow one marking and are merged.
_RECOVER: Final = 0.3
_MERGE: Final = 0.35
# The rows are chosen again if the horizon has moved by this much.
_HORIZON_MOVED: Final = 0.02


class LaneTracker:
    """Tracks the boundaries of one camera, one Kalman filter each.

    In the first frames of a camera tentative tracks are reported too, so that a single image has lanes and a stream has
    them from its first frame on.
    """

    def __init__(self) -> None:
        self._tracks: list[Track] = []
        self._rows: TrackedRows | None = None
        self._lane_width = USUAL_LANE_WIDTH
        self._next_id = 1
        self._clock = 0.0
        self._last_timestamp: float | None = None
        self._frames = 0

    @classmethod
    def restored(cls, state: TrackerState, ids_lost: int = 0) -> LaneTracker:
        """Returns a tracker that continues where `state` was taken.

        `ids_lost` more ids count as assigned, because a tracker that continued after `state` was taken and is now lost
        may have assigned them.
        Raises ValueError for an invalid state.
        """
        tracker = cls()
        tracker._tracks = [snapshot.track(_FRAMES) for snapshot in state.tracks]
        tracker._rows = state.tracked_rows
        tracker._lane_width = state.lane_width
        tracker._next_id = state.next_id + ids_lost
        tracker._clock, tracker._last_timestamp = state.clock, state.last_timestamp
        tracker._frames = state.frames
        return tracker

    @property
    def state(self) -> TrackerState:
        """Everything it remembers, to be restored later."""
        rows = self._rows
        return TrackerState(
            tracks=tuple(TrackSnapshot.of(track) for track in self._tracks),
            horizon=None if rows is None else rows.horizon,
            rows=None if rows is None else (float(rows.y[0]), float(rows.y[1]), float(rows.y[2])),
            lane_width=self._lane_width,
            next_id=self._next_id,
            clock=self._clock,
            last_timestamp=self._last_timestamp,
            frames=self._frames,
        )

    @property
    def curves(self) -> Curves | None:
        """The confirmed boundaries in the last frame; None before the first frame."""
        if self._rows is None:
            return None
        columns = [track.columns for track in self._tracks if track.confirmed]
        return self._rows.curves(np.array(columns).reshape(-1, MEASURED))

    def update(self, detections: Sequence[Detection], timestamp: float, view: RoadView) -> FrameResult:
        """Takes the `detections` of the frame captured at `timestamp` (seconds) in `view`, and returns its result.

        A timestamp that goes backwards counts as no time passing.
        """
        rows = self._rows_for(view)
        self._predict(self._elapsed(timestamp), view)
        self._delete_old()
        columns, noise = self._measure(detections, rows, view)
        pairs = associate(self._tracks, columns, noise)
        recovered = recover(self._tracks, columns, pairs, self._in_lane_widths(_RECOVER, view))
        taken = {j for _, j in recovered}
        self._update([pair for pair in pairs if pair[1] not in taken], recovered, detections, columns, noise, view)
        self._frames += 1
        self._confirm()
        self._tracks = self._merged([track for track in self._tracks if self._is_alive(track, view)], view)
        return self._result(view, rows)

    def _elapsed(self, timestamp: float) -> float:
        last, self._last_timestamp = self._last_timestamp, timestamp
        seconds = 0.0 if last is None else max(0.0, timestamp - last)
        self._clock += seconds
        return seconds

    def _rows_for(self, view: RoadView) -> TrackedRows:
        """Returns the tracked rows, chosen again if the horizon has moved too far."""
        if self._rows is None or abs(self._rows.horizon - view.horizon) > _HORIZON_MOVED * view.depth:
            rows = TrackedRows.of(view, _ROWS)
            for track in self._tracks:
                track.change_rows(self._rows or rows, rows)
            self._rows = rows
        return self._rows

    def _in_lane_widths(self, number: float, view: RoadView) -> FloatArray:
        """Returns `number` lane widths in pixels at the tracked rows (3,)."""
        return number * self._lane_width * _ROWS * view.depth

    def _predict(self, seconds: float, view: RoadView) -> None:
        for track in self._tracks:
            track.previous_columns = track.columns
        if not self._tracks:
            return
        # A track is deleted after the coasting time anyway; a longer step could overflow.
        states, covariances = predict(
            np.stack([track.state for track in self._tracks]),
            np.stack([track.covariance for track in self._tracks]),
            min(seconds, 2.0 * _COAST_S),
            _ACCELERATION * view.depth,
        )
        for track, state, covariance in zip(self._tracks, states, covariances, strict=True):
            track.state, track.covariance = state, covariance

    def _delete_old(self) -> None:
        """Deletes tracks that are too old after a gap in the stream; if none is left, the stream counts as new."""
        self._tracks = [track for track in self._tracks if self._clock - track.last_hit <= _COAST_S]
        if not self._tracks:
            self._frames = 0

    def _measure(
        self, detections: Sequence[Detection], rows: TrackedRows, view: RoadView
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the columns (M, 3) of detections and their covariances (M, 3, 3).

        A covariance is the sum of those of the fit, of the detector's noise and of the pitch, which moves all rows.
        """
        columns, noise = np.empty((len(detections), MEASURED)), np.empty((len(detections), MEASURED, MEASURED))
        for j, detection in enumerate(detections):
            columns[j], noise[j] = rows.measure(detection.curve, detection.covariance)
            pitch = detection.curve.slope(rows.y) * _PITCH * view.depth
            noise[j] += np.outer(pitch, pitch)
        return columns, noise + (_NOISE * view.depth) ** 2 * np.eye(MEASURED)

    def _update(
        self,
        pairs: Sequence[tuple[int, int]],
        recovered: Sequence[tuple[int, int]],
        detections: Sequence[Detection],
        columns: FloatArray,
        noise: FloatArray,
        view: RoadView,
    ) -> None:
        """Updates matched tracks, moves unmatched ones, and begins a track for each unmatched detection."""
        tracks = self._tracks
        if pairs:
            mine, theirs = np.array(pairs).T
            states, covariances = update(
                np.stack([tracks[i].state for i in mine]),
                np.stack([tracks[i].covariance for i in mine]),
                columns[theirs],
                noise[theirs],
            )
            for i, state, covariance in zip(mine, states, covariances, strict=True):
                tracks[i].state, tracks[i].covariance = state, covariance
        for i, j in recovered:
            tracks[i].state, tracks[i].covariance = initial_state(columns[j], noise[j], _SPEED * view.depth)
        matched = dict([*pairs, *recovered])
        for i, track in enumerate(tracks):
            if i in matched:
                track.hit(detections[matched[i]], self._clock)
            else:
                track.miss()
        self._coast(set(matched), view)
        taken = set(matched.values())
        self._tracks += [
            self._new_track(detection, columns[j], noise[j], view)
            for j, detection in enumerate(detections)
            if j not in taken
        ]

    def _coast(self, matched: set[int], view: RoadView) -> None:
        """Moves unmatched tracks by the median motion of matched ones, which is the camera's motion."""
        seen = [
            track.columns - track.previous_columns
            for i, track in enumerate(self._tracks)
            if i in matched and track.confirmed and track.detected_twice
        ]
        for i, track in enumerate(self._tracks):
            if i not in matched:
                if seen:
                    moved = track.previous_columns + np.median(seen, axis=0)
                    track.state = np.concatenate([moved, track.state[MEASURED:]])
                track.coast(_ROWS * view.depth)

    def _new_track(self, detection: Detection, columns: FloatArray, noise: FloatArray, view: RoadView) -> Track:
        state, covariance = initial_state(columns, noise, _SPEED * view.depth)
        return Track(
            state,
            covariance,
            born=self._clock,
            last_hit=self._clock,
            probability=detection.probability,
            top=detection.top,
            bottom=detection.bottom,
            hits=deque([True], maxlen=_FRAMES),
            side=1 if detection.curve.x(view.bottom) >= view.middle else -1,
        )

    def _confirm(self) -> None:
        for track in sorted(self._tracks, key=lambda each: float(each.columns[0])):
            if not track.confirmed and (sum(track.hits) >= _HITS or self._frames < _HITS):
                track.track_id = self._next_id
                self._next_id += 1

    def _is_alive(self, track: Track, view: RoadView) -> bool:
        if not track.confirmed:
            return len(track.hits) - sum(track.hits) <= _FRAMES - _HITS
        return float(np.sqrt(track.covariance[0, 0])) <= _MERGE * self._lane_width * view.depth

    def _merged(self, tracks: list[Track], view: RoadView) -> list[Track]:
        """Returns the tracks without those that have converged on an older one, which keeps its identity."""
        kept: list[Track] = []
        limit = self._in_lane_widths(_MERGE, view)
        for track in sorted(tracks, key=lambda each: (not each.confirmed, each.born, each.track_id or 0)):
            if not any(bool((np.abs(track.columns - other.columns) < limit)[:2].all()) for other in kept):
                kept.append(track)
        return kept

    def _result(self, view: RoadView, rows: TrackedRows) -> FrameResult:
        reported = [track for track in self._tracks if track.confirmed and track.drift <= _MOST_DRIFT]
        tracks = sorted(reported, key=lambda each: float(each.columns[0]))
        if not tracks:
            return FrameResult((), EgoLane(), view.horizon)
        curves = rows.curves(np.stack([track.columns for track in tracks]))
        covariances = rows.covariances_of_curves(np.stack([track.covariance[:MEASURED, :MEASURED] for track in tracks]))
        columns = curves.x(np.array([view.bottom]))[:, 0].tolist()
        lane_width = self._lane_width * view.depth
        changes = [lane_change(track, x, view.middle, lane_width) for track, x in zip(tracks, columns, strict=True)]
        positions = lane_positions(tracks, columns, view.middle, lane_width)
        spans = visible_spans(curves, view)
        lanes = [
            LaneBoundary(
                track_id=track.track_id or 0,
                position=positions[i],
                state="detected" if track.detected else "predicted",
                probability=track.probability * self._fading(track),
                curve=curves[i],
                covariance=covariances[i],
                top=max(float(spans.top[i]), track.top),
                bottom=float(spans.bottom[i]),
                age_s=self._clock - track.born,
            )
            for i, track in enumerate(tracks)
            if spans.visible[i]
        ]
        events = tuple(change for change in changes if isinstance(change, LaneChange))
        return FrameResult(tuple(lanes), self._ego_lane(tracks, columns, positions, view), view.horizon, events)

    def _fading(self, track: Track) -> float:
        """Returns the factor of a track's probability, which falls with the time since its last detection."""
        return 1.0 - 0.5 * min(1.0, (self._clock - track.last_hit) / _COAST_S)

    def _ego_lane(
        self, tracks: Sequence[Track], columns: Sequence[float], positions: Sequence[int], view: RoadView
    ) -> EgoLane:
        at = {position: index for index, position in enumerate(positions)}
        left, right = at.get(-1), at.get(1)
        offset = None
        if left is not None and right is not None:
            width = columns[right] - columns[left]
            self._lane_width = learned_width(self._lane_width, width / view.depth)
            if width > 0.0:
                offset = (view.middle - 0.5 * (columns[left] + columns[right])) / width
        return EgoLane(
            None if left is None else tracks[left].track_id, None if right is None else tracks[right].track_id, offset
        )
