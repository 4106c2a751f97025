"""The truth of a rendered tracking clip, one record per delivered frame, as `scenes.tracking_clips` yields it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import ROAD_EDGE_TYPES

# Rows this far beyond the ends of a boundary's points still count as inside: ends are rounded to whole rows.
_SLACK = 1.0


@dataclass(frozen=True)
class TruthLane:
    """A true boundary: `points` (N, 2) in image pixels, and the number of this hidden frame in its gap (0 if visible).

    `gap_length` is the number of frames for which the boundary is hidden, 0 if it is visible. `type` and `color` are
    those of labels; None if unknown.
    """

    lane_id: int
    position: int
    points: FloatArray
    gap: int = 0
    gap_length: int = 0
    type: str | None = None
    color: str | None = None

    def columns(self, rows: FloatArray) -> FloatArray:
        """Returns the columns (R,) at `rows` (R,), NaN where the boundary is outside the image."""
        if len(self.points) < 2:
            return np.full(len(rows), np.nan)
        order = np.argsort(self.points[:, 1], kind="stable")
        y, x = self.points[order, 1], self.points[order, 0]
        columns: FloatArray = np.interp(rows, y, x)
        columns[(rows < y[0] - _SLACK) | (rows > y[-1] + _SLACK)] = np.nan
        return columns


@dataclass(frozen=True)
class TrueLaneChange:
    """The camera crosses the boundary `lane_id` towards `direction` at exactly `timestamp`."""

    lane_id: int
    direction: str
    timestamp: float


@dataclass(frozen=True)
class TrueEgo:
    """The vehicle in its lane, in meters, radians and 1/m, with the signs of `EgoMeters`; None where unknown."""

    offset: float | None = None
    heading: float | None = None
    curvature: float | None = None
    lane_width: float | None = None
    lateral_speed: float | None = None


@dataclass(frozen=True)
class TruthFrame:
    """The truth of one delivered frame, in pixels of its image.

    `scene` grows at a cut. `horizon` and `bottom` are the rows between which the road is compared. `camera` is the true
    camera as on the wire; `pitch` and `yaw` are its directions at rest in degrees, for clips whose truth has them.
    `edges` are the edges of the road, which are not among the `lanes`.
    """

    index: int
    timestamp: float
    width: int
    height: int
    scene: int
    horizon: float
    bottom: float
    camera: Mapping[str, Any]
    ego: TrueEgo
    lanes: tuple[TruthLane, ...]
    lane_changes: tuple[TrueLaneChange, ...] = ()
    pitch: float | None = None
    yaw: float | None = None
    edges: tuple[TruthLane, ...] = ()

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> TruthFrame:
        """Returns the truth in a record. Raises KeyError if a needed field is missing."""
        ego = record.get("ego") or {}
        boundaries = tuple(map(_lane, record["lanes"]))
        return cls(
            index=record["frame"],
            timestamp=record["timestamp"],
            width=record["width"],
            height=record["height"],
            scene=record["scene"],
            horizon=record["horizon"],
            bottom=record["height"] - 1.0,
            camera=record["camera"],
            ego=TrueEgo(
                ego.get("offset_m"),
                ego.get("heading"),
                ego.get("curvature"),
                ego.get("lane_width_m"),
                ego.get("lateral_speed"),
            ),
            lanes=tuple(lane for lane in boundaries if lane.type not in ROAD_EDGE_TYPES),
            lane_changes=tuple(
                TrueLaneChange(event["lane_id"], event["direction"], event["timestamp"])
                for event in record["events"]
                if event["type"] == "lane_change"
            ),
            pitch=record.get("truth_pitch"),
            yaw=record.get("truth_yaw"),
            edges=tuple(lane for lane in boundaries if lane.type in ROAD_EDGE_TYPES),
        )


def _lane(lane: Mapping[str, Any]) -> TruthLane:
    return TruthLane(
        lane["id"],
        lane["position"],
        np.asarray(lane["points"], dtype=float).reshape(-1, 2),
        int(lane.get("gap") or 0),
        int(lane.get("gap_length") or 0),
        lane.get("type"),
        lane.get("color"),
    )
