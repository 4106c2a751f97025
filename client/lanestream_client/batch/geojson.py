"""What was seen along a GPS track, as GeoJSON (RFC 7946): line strings with the boundaries of the ego lane."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import fmean, median
from typing import TYPE_CHECKING, Any

from lanestream_client.batch.gpx import iso_time

if TYPE_CHECKING:
    from lanestream.protocol import LanesMessage, Side
    from lanestream_client.batch.gpx import Position, Track

# The kind of a boundary, its marking type and its marking color; None where it is unknown or has none.
Look = tuple[str | None, str | None, str | None]


@dataclass
class _Second:
    """What the frames of one second showed."""

    frames: int = 0
    both: int = 0
    left: Counter[Look] = field(default_factory=Counter)
    right: Counter[Look] = field(default_factory=Counter)
    widths_m: list[float] = field(default_factory=list)

    @property
    def looks(self) -> tuple[Look, Look]:
        """How most frames saw the left and the right boundary."""
        return self.left.most_common(1)[0][0], self.right.most_common(1)[0][0]


class SegmentLog:
    """Collects what the frames of a video show, second by second."""

    def __init__(self) -> None:
        self._seconds: defaultdict[int, _Second] = defaultdict(_Second)
        self._last = 0.0

    def add(self, lanes: LanesMessage) -> None:
        """Adds a frame."""
        second = self._seconds[int(lanes.timestamp // 1)]
        second.frames += 1
        second.both += lanes.ego.left is not None and lanes.ego.right is not None
        second.left[_look(lanes, "left")] += 1
        second.right[_look(lanes, "right")] += 1
        if lanes.ego.lane_width_m is not None:
            second.widths_m.append(lanes.ego.lane_width_m)
        self._last = max(self._last, lanes.timestamp)

    def feature_collection(self, path: str, track: Track, start: float) -> dict[str, Any]:
        """Returns a FeatureCollection for the video at `path`, whose time 0 is `start` on the track's clock.

        Seconds without a position are left out.
        """
        features = [
            self._feature(path, seconds, positions, start) for seconds, positions in self._segments(track, start)
        ]
        return {"type": "FeatureCollection", "features": features}

    def _segments(self, track: Track, start: float) -> Iterator[tuple[list[int], list[Position]]]:
        """Yields runs of seconds that look the same, with the positions at their beginnings and at the end."""
        seconds: list[int] = []
        positions: list[Position] = []
        for second in sorted(self._seconds):
            first = track.position(start + second)
            last = track.position(start + min(second + 1.0, max(self._last, second)))
            if first is None or last is None:
                continue
            follows = seconds and second == seconds[-1] + 1
            if not follows or self._seconds[second].looks != self._seconds[seconds[-1]].looks:
                if seconds:
                    yield seconds, positions
                seconds, positions = [], [first]
            seconds.append(second)
            positions.append(last)
        if seconds:
            yield seconds, positions

    def _feature(self, path: str, seconds: list[int], positions: list[Position], start: float) -> dict[str, Any]:
        seen = [self._seconds[second] for second in seconds]
        end = min(seconds[-1] + 1.0, self._last)
        widths = [median(second.widths_m) for second in seen if second.widths_m]
        frames = sum(second.frames for second in seen)
        properties: dict[str, Any] = {
            "file": path,
            "start": iso_time(start + seconds[0]),
            "end": iso_time(start + end),
            "video_start_s": float(seconds[0]),
            "video_end_s": round(end, 3),
            "frames": frames,
            "both_ego_boundaries": round(sum(second.both for second in seen) / frames, 3),
            "lane_width_m": round(fmean(widths), 2) if widths else None,
        }
        for side, look in zip(("left", "right"), seen[0].looks, strict=True):
            names = (f"{side}_kind", f"{side}_marking_type", f"{side}_marking_color")
            properties |= dict(zip(names, look, strict=True))
        geometry = {"type": "LineString", "coordinates": [list(position) for position in positions]}
        return {"type": "Feature", "geometry": geometry, "properties": properties}


def _look(lanes: LanesMessage, side: Side) -> Look:
    track_id = lanes.ego.left if side == "left" else lanes.ego.right
    lane = next((lane for lane in lanes.lanes if lane.track_id == track_id), None)
    if lane is None:
        return None, None, None
    if lane.marking is None:
        return lane.kind, None, None
    return lane.kind, lane.marking.type, lane.marking.color
