"""The tracker of one camera: follows its boundaries from frame to frame and gives them identities."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from lanestream.road.appearance import BOUNDARY_KINDS, BoundaryKind
from lanestream.road.curve import Curves, FloatArray
from lanestream.road.results import (
    Detection,
    EgoLane,
    Estimate,
    Event,
    FrameResult,
    LaneBoundary,
    LaneChange,
    SceneCut,
    Side,
)
from lanestream.road.view import USUAL_LANE_WIDTH, RoadView, visible_spans
from lanestream.tracking.association import associate, kind_costs
from lanestream.tracking.ego_lane import has_changed_sides, lane_positions, learned_width
from lanestream.tracking.frame_clock import FrameClock
from lanestream.tracking.kalman import costs
from lanestream.tracking.merging import SAME, merge
from lanestream.tracking.road_filter import ROWS, RoadFilter
from lanestream.tracking.state import TrackerState
from lanestream.tracking.tracks import ACTIVITIES, ACTIVITY_GAINS, HITS, MOST_SURPRISE, Track, adapted

# In lane widths: a detection farther from a track than the first never belongs to it, and a boundary is reported while
# the sigma of its place is at most the second.
_FARTHEST: Final = 0.3
_MOST_SIGMA: Final = 0.15
# More boundaries than this are not tracked.
_MOST_TRACKS: Final = 12
# How quickly the mean horizon follows that of a frame (seconds), and how far it may move, in depths, before the rows
# are chosen again.
_HORIZON_S: Final = 0.2
_HORIZON_MOVED: Final = 0.05


class LaneTracker:
    """Tracks the boundaries of one camera with one road filter.

    A boundary is reported from its third detection on. In the first frames of a stream, those that the ego-lane prior
    expects are reported at once, and in a `single_image` all: no other frame will follow. Boundaries that are not of
    the `kinds` are followed and not reported.
    """

    def __init__(self, single_image: bool = False, kinds: Collection[BoundaryKind] = BOUNDARY_KINDS) -> None:
        self._single_image = single_image
        self._kinds = kinds
        self._tracks: list[Track] = []
        self._road: RoadFilter | None = None
        self._mean_horizon = 0.0
        self._lane_width = USUAL_LANE_WIDTH
        self._next_id = 1
        self._clock = FrameClock()
        self._frames = 0
        self._activity = 1.0
        self._nis: FloatArray = np.zeros(0)

    @classmethod
    def restored(
        cls,
        state: TrackerState,
        ids_lost: int = 0,
        single_image: bool = False,
        kinds: Collection[BoundaryKind] = BOUNDARY_KINDS,
    ) -> LaneTracker:
        """Returns a tracker that continues where `state` was taken.

        `ids_lost` more ids count as assigned, because a tracker that continued after `state` was taken and is now lost
        may have assigned them.
        Raises ValueError for an invalid state.
        """
        tracker = cls(single_image, kinds)
        tracker._tracks, tracker._road = state.unpacked()
        tracker._mean_horizon = state.mean_horizon
        tracker._lane_width = state.lane_width
        tracker._next_id = state.next_id + ids_lost
        tracker._clock = state.clock
        tracker._frames = state.frames
        tracker._activity = state.activity
        return tracker

    @property
    def state(self) -> TrackerState:
        """Everything it remembers, to be restored later."""
        return TrackerState.packed(
            self._tracks,
            self._road,
            mean_horizon=self._mean_horizon,
            lane_width=self._lane_width,
            next_id=self._next_id,
            clock=self._clock,
            frames=self._frames,
            activity=self._activity,
        )

    @property
    def curves(self) -> Curves | None:
        """The boundaries in the last frame, confirmed or not; None before the first frame."""
        return None if self._road is None else self._road.curves()

    @property
    def confirmed_curves(self) -> Curves | None:
        """The confirmed boundaries in the last frame; None before the first frame."""
        if self._road is None:
            return None
        return self._road.curves().take(np.array([track.confirmed for track in self._tracks], bool))

    @property
    def nis(self) -> FloatArray:
        """The normalized innovations squared of the last frame's updates, per degree of freedom; 1 on average."""
        return self._nis

    def seconds_until(self, timestamp: float) -> float:
        """Returns the seconds from the last frame to one captured at `timestamp`."""
        return self._clock.advanced(timestamp)[0].now - self._clock.now

    def update(
        self,
        detections: Sequence[Detection],
        timestamp: float,
        view: RoadView,
        middle: float = 0.0,
        is_cut: bool = False,
    ) -> FrameResult:
        """Takes the `detections` of the frame captured at `timestamp` (seconds) in `view`, and returns its result.

        `middle` is the lateral place of the vehicle's middle, in columns per row offset. With `is_cut`, the frame shows
        another scene than the last one, and all boundaries are new.
        """
        earlier = self._clock.now
        self._clock, warnings = self._clock.advanced(timestamp)
        events: list[Event] = []
        road = self._predicted_road(view, self._clock.now - earlier)
        values, noise = road.measure(detections)
        apart = self._apart(road, values)
        road_edges = np.array([detection.appearance.road_edge for detection in detections])
        pairs = self._associate(road, values, noise, apart, road_edges)
        if is_cut or (not pairs and self._is_elsewhere(apart)):
            events.append(SceneCut(timestamp))
            self._tracks, self._frames, self._activity, pairs = [], 0, 1.0, []
            self._lane_width, self._mean_horizon = USUAL_LANE_WIDTH, view.horizon
            road = RoadFilter.started(view)
            values, noise = road.measure(detections)
        road, pairs = self._with_new_tracks(road, pairs, detections, middle)
        self._road = self._updated(road, pairs, detections, values, noise)
        self._frames += 1
        if not self._road.is_sound:
            self._tracks, self._road, self._mean_horizon = [], RoadFilter.started(view), view.horizon
        if not self._single_image:
            self._keep_only([i for i, track in enumerate(self._tracks) if self._is_alive(i, track)])
            self._merge_and_confirm()
        events += self._lane_changes(earlier, middle)
        for track in self._tracks:
            track.round()
        result = self._result(detections, view, middle)
        self._learn_lane_width(middle)
        return replace(result, events=tuple(events), warnings=warnings)

    def _predicted_road(self, view: RoadView, seconds: float) -> RoadFilter:
        """Returns the road at this frame's time, and drops the tracks that are too old after a gap in the stream."""
        self._keep_only(
            [i for i, track in enumerate(self._tracks) if track.is_alive(self._clock.now, self._clock.step)]
        )
        if self._road is None or not self._tracks:
            # The stream counts as new.
            self._frames, self._activity, self._mean_horizon = 0, 1.0, view.horizon
            return RoadFilter.started(view)
        gain = 1.0 - float(np.exp(-seconds / _HORIZON_S))
        self._mean_horizon += max(gain, 1.0 / (self._frames + 1.0)) * (view.horizon - self._mean_horizon)
        road = self._road.resting_at(self._mean_horizon)
        if abs(road.rest) > _HORIZON_MOVED:
            road = road.below(view.with_horizon(self._mean_horizon))
        coasting = np.array([not track.hits[-1] for track in self._tracks], bool)
        scales = np.array([track.scale for track in self._tracks])
        return road.predicted(seconds, self._activity, scales, coasting)

    def _apart(self, road: RoadFilter, values: FloatArray) -> FloatArray:
        """Returns how far each of M detections is to the right of each of N tracks, in lane widths (N, M)."""
        # At the middle row, which both know well.
        expected = road.curves().x(road.rows[1:2]) / road.depth
        return np.asarray((values[:, 1] - expected) / (ROWS[1] * self._lane_width))

    def _associate(
        self, road: RoadFilter, values: FloatArray, noise: FloatArray, apart: FloatArray, road_edges: FloatArray
    ) -> list[tuple[int, int]]:
        """Returns (track, detection) pairs; `road_edges` (M,) are the detections' probabilities of that kind."""
        if not apart.size:
            return []
        expected, covariances = road.expected()
        places = expected[:, 1] / (ROWS[1] * self._lane_width)
        kinds = kind_costs(np.array([track.appearance.road_edge for track in self._tracks]), road_edges)
        return associate(places, costs(expected, covariances, values, noise) + kinds, apart, _FARTHEST)

    def _is_elsewhere(self, apart: FloatArray) -> bool:
        """Returns whether nothing is near several boundaries that were found a frame ago."""
        seen = apart[[track.confirmed and track.hits[-1] for track in self._tracks]]
        return min(seen.shape) >= 2 and bool((np.abs(seen) > _FARTHEST).all())

    def _with_new_tracks(
        self, road: RoadFilter, pairs: list[tuple[int, int]], detections: Sequence[Detection], middle: float
    ) -> tuple[RoadFilter, list[tuple[int, int]]]:
        """Begins a track for each unmatched detection; returns the road with them, and all pairs."""
        taken = {j for _, j in pairs}
        new = [j for j in range(len(detections)) if j not in taken][: max(0, _MOST_TRACKS - len(self._tracks))]
        if not new:
            return road, pairs
        pairs = [*pairs, *((len(self._tracks) + number, j) for number, j in enumerate(new))]
        road = road.with_boundaries(Curves.of([detections[j].curve for j in new]))
        now, known = self._clock.now, len(self._tracks)
        for place, j in zip(road.places[known:].tolist(), new, strict=True):
            self._tracks.append(Track.begun(detections[j], place - middle, now))
        if self._frames < HITS:
            at_once = [known + n for n, j in enumerate(new) if self._single_image or detections[j].expected]
            self._confirm(at_once)
        return road, pairs

    def _updated(
        self,
        road: RoadFilter,
        pairs: Sequence[tuple[int, int]],
        detections: Sequence[Detection],
        values: FloatArray,
        noise: FloatArray,
    ) -> RoadFilter:
        matched = dict(pairs)
        surprises = np.zeros(0)
        if pairs:
            mine, theirs = np.array(pairs, np.intp).T
            scales = np.array([self._tracks[i].noise_scale(detections[j]) for i, j in pairs])
            scaled = noise[theirs] * scales[:, None, None]
            road = road.loosened([i for i in mine.tolist() if self._tracks[i].is_elsewhere])
            road, distances = road.updated(mine, values[theirs], scaled)
            surprises = distances / 3.0
        self._nis = surprises[[i for i, (track, _) in enumerate(pairs) if self._tracks[track].hits]]
        self._adapt_activity(road, matched)
        by_track = dict(zip([i for i, _ in pairs], surprises.tolist(), strict=True))
        for i, track in enumerate(self._tracks):
            if i in matched:
                track.hit(detections[matched[i]], by_track[i], self._clock.now)
            else:
                track.miss()
        return road.rounded()

    def _adapt_activity(self, road: RoadFilter, matched: Mapping[int, int]) -> None:
        """Lets the activity of the road follow the innovations of known tracks.

        A track that was not matched although a new one begins near it is as surprising as can be.
        """
        known = [i for i, track in enumerate(self._tracks) if track.hits]
        new = road.places[len(known) :]
        nis = self._nis.tolist()
        for i in known:
            missed = i not in matched and self._tracks[i].confirmed and self._tracks[i].hits[-1]
            if missed and (np.abs(new - road.places[i]) < SAME * self._lane_width).any():
                nis.append(MOST_SURPRISE)
        if nis:
            self._activity = adapted(self._activity, float(np.mean(nis)), ACTIVITY_GAINS, ACTIVITIES)

    def _confirm(self, indices: Sequence[int]) -> None:
        """Gives an identity to those of the tracks at `indices` that have none."""
        for i in indices:
            if not self._tracks[i].confirmed:
                self._tracks[i].track_id = self._next_id
                self._next_id += 1

    @property
    def _places(self) -> FloatArray:
        return np.zeros(0) if self._road is None else self._road.places

    def _keep_only(self, kept: list[int]) -> None:
        if len(kept) < len(self._tracks) and self._road is not None:
            self._tracks = [self._tracks[i] for i in kept]
            self._road = self._road.with_only(kept)

    def _is_alive(self, index: int, track: Track) -> bool:
        if self._road is None or not track.is_alive(self._clock.now, self._clock.step):
            return False
        return not track.confirmed or self._road.place_sigmas[index] <= SAME * self._lane_width

    def _merge_and_confirm(self) -> None:
        """Merges the tracks that follow one boundary, and confirms those with enough hits."""
        if self._road is None:
            return
        curves = self._road.curves()
        positions = curves.x(self._road.rows[:2]) / (self._road.depth * ROWS[:2])
        survivors = merge(self._tracks, positions, self._lane_width)
        self._road = self._road.with_only([survivor.slot for survivor in survivors])
        self._tracks = [self._tracks[survivor.track] for survivor in survivors]
        certain = [i for i, survivor in enumerate(survivors) if not survivor.contested]
        self._confirm([i for i in certain if self._tracks[i].has_enough_hits])

    def _lane_changes(self, earlier: float, middle: float) -> list[LaneChange]:
        """Records where the boundaries are; returns the lane changes of boundaries that have just changed sides."""
        if self._road is None:
            return []
        sideways, now = self._road.sideways.value, self._clock.now
        changes = []
        for track, place in zip(self._tracks, (self._places - middle).tolist(), strict=True):
            changed = has_changed_sides(track, place, sideways, self._lane_width, earlier, now)
            if changed and track.track_id is not None and track.appearance.kind in self._kinds:
                # A boundary that is now on the left shows that the vehicle moved to the right.
                side: Side = "right" if track.side < 0 else "left"
                changes.append(LaneChange(track.track_id, side, self._clock.timestamp_at(track.crossed)))
        return changes

    def _known(self, road: RoadFilter) -> list[int]:
        """Returns the indices of the boundaries that are certain enough to be reported, from left to right."""
        left_to_right: list[int] = np.argsort(road.places, kind="stable").tolist()
        if self._single_image:
            return left_to_right
        sigmas = road.place_sigmas
        return [i for i in left_to_right if self._tracks[i].confirmed and sigmas[i] <= _MOST_SIGMA * self._lane_width]

    def _learn_lane_width(self, middle: float) -> None:
        """Learns the lane width from the nearest boundaries, of any kind: what is reported does not change tracking."""
        road = self._road
        if road is None:
            return
        known = self._known(road)
        tracks = [self._tracks[i] for i in known]
        at = dict(
            zip(lane_positions(tracks, (road.places[known] - middle).tolist(), self._lane_width), known, strict=True)
        )
        left, right = at.get(-1), at.get(1)
        if left is not None and right is not None and self._tracks[left].hits[-1] and self._tracks[right].hits[-1]:
            self._lane_width = learned_width(self._lane_width, float(road.places[right] - road.places[left]))

    def _result(self, detections: Sequence[Detection], view: RoadView, middle: float) -> FrameResult:
        road = self._road
        if road is None or not self._tracks:
            return FrameResult((), EgoLane(), view.horizon)
        reported = [i for i in self._known(road) if self._tracks[i].appearance.kind in self._kinds]
        if not reported:
            return FrameResult((), EgoLane(), road.pitched_horizon)
        if self._single_image:
            # With one frame there is nothing to filter.
            found = [detections[i] for i in reported]
            curves = Curves.of([detection.curve for detection in found])
            covariances = np.stack([detection.covariance for detection in found])
        else:
            scales = np.array([track.bias_scale for track in self._tracks])
            curves, covariances = road.curves().take(reported), road.covariances(scales)[reported]
        horizon = curves.horizon
        tracks = [self._tracks[i] for i in reported]
        positions = lane_positions(tracks, (self._places[reported] - middle).tolist(), self._lane_width)
        spans = visible_spans(curves, view.with_horizon(horizon))
        lanes = tuple(
            LaneBoundary(
                track_id=track.track_id or 0,
                position=positions[i],
                state=track.state,
                probability=track.probability * track.fading(self._clock.now),
                curve=curves[i],
                covariance=covariances[i],
                top=max(float(spans.top[i]), track.top),
                bottom=float(spans.bottom[i]),
                age_s=self._clock.now - track.born,
                appearance=track.appearance_at(self._clock.now),
            )
            for i, track in enumerate(tracks)
            if spans.visible[i]
        )
        at = dict(zip(positions, reported, strict=True))
        return FrameResult(lanes, self._ego_lane(road, at.get(-1), at.get(1), view), horizon, road=road.estimate)

    def _ego_lane(self, road: RoadFilter, left: int | None, right: int | None, view: RoadView) -> EgoLane:
        """Returns the ego lane between the tracks at the indices `left` and `right`."""
        bounds = [None if i is None else self._tracks[i] for i in (left, right)]
        ids = [None if track is None else track.track_id for track in bounds]
        kinds = [None if track is None else track.appearance.kind for track in bounds]
        ego = EgoLane(left=ids[0], right=ids[1], left_kind=kinds[0], right_kind=kinds[1])
        if left is None or right is None:
            return ego
        width = float(road.places[right] - road.places[left])
        if width <= 0.0:
            return ego
        center, sideways = road.lane_center(left, right), road.sideways
        return replace(
            ego,
            offset=Estimate((view.middle / road.depth - center.value) / width, center.sigma / width),
            lateral_speed=Estimate(sideways.value / width, sideways.sigma / width),
        )
