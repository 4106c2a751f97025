"""Answers of a system: its `lanes` messages as plain values. Fields that an old version does not send are None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lanestream.road.appearance import BoundaryKind
from lanestream.road.curve import Curve, FloatArray, curve_basis


@dataclass(frozen=True)
class AnsweredLane:
    """A reported boundary; its covariance (3, 3) belongs to the coefficients of `curve`, in image pixels.

    `type` and `color` are those of a marking; None of an edge of the road, and if they are not classified.
    """

    track_id: int
    position: int
    state: str
    curve: Curve
    covariance: FloatArray
    top: float
    bottom: float
    kind: BoundaryKind = "marking"
    type: str | None = None
    color: str | None = None

    def covariance_at(self, rows: FloatArray) -> FloatArray:
        """Returns the covariance (R, R) of the columns at `rows` (R,)."""
        basis = curve_basis(self.curve.horizon, rows)
        covariance: FloatArray = basis @ self.covariance @ basis.T
        return covariance

    def sigma(self, rows: FloatArray) -> FloatArray:
        """Returns the standard deviations (R,) of the columns at `rows` (R,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance_at(rows)), 0.0))


@dataclass(frozen=True)
class AnsweredLaneChange:
    """A reported lane change; `timestamp` is the event's own, or the frame's if the event has none."""

    direction: str
    timestamp: float


@dataclass(frozen=True)
class AnsweredEgo:
    """The reported ego lane: the tracks of its boundaries, and values in meters, radians and 1/m."""

    left: int | None = None
    right: int | None = None
    offset: float | None = None
    heading: float | None = None
    curvature: float | None = None
    lane_width: float | None = None


@dataclass(frozen=True)
class Answer:
    """The answer to one frame.

    `departure` is the state and the side, or None if the system does not watch for departures. `calibration` is the
    camera's estimated pitch and yaw in degrees. `nis` is per degree of freedom, of each update of the filter in this
    frame; it is not on the wire.
    """

    timestamp: float
    horizon: float
    lanes: tuple[AnsweredLane, ...]
    ego: AnsweredEgo
    lane_changes: tuple[AnsweredLaneChange, ...] = ()
    cut: bool = False
    departure: tuple[str, str | None] | None = None
    calibration: tuple[float, float] | None = None
    nis: tuple[float, ...] = ()

    @classmethod
    def from_message(cls, message: Mapping[str, Any]) -> Answer:
        """Returns the answer in a `lanes` message. Raises KeyError if a field of every version is missing."""
        ego, events, departure = message["ego"], message["events"], message.get("departure")
        return cls(
            timestamp=message["timestamp"],
            horizon=message["horizon"],
            lanes=tuple(map(_lane, message["lanes"])),
            ego=AnsweredEgo(
                ego["left"],
                ego["right"],
                ego.get("offset_m"),
                ego.get("heading"),
                ego.get("curvature"),
                ego.get("lane_width_m"),
            ),
            lane_changes=tuple(
                AnsweredLaneChange(event["direction"], event.get("timestamp", message["timestamp"]))
                for event in events
                if event["type"] == "lane_change"
            ),
            cut=any(event["type"] == "scene_cut" for event in events),
            departure=None if departure is None else (departure["state"], departure.get("side")),
            calibration=_calibration(message),
            nis=tuple(map(float, message.get("nis", ()))),
        )


def _lane(lane: Mapping[str, Any]) -> AnsweredLane:
    marking = lane.get("marking") or {}
    return AnsweredLane(
        track_id=lane["track_id"],
        position=lane["position"],
        state=lane["state"],
        curve=Curve(lane["horizon"], tuple(lane["coefficients"])),
        covariance=np.asarray(lane["covariance"], dtype=float),
        top=lane["line"]["top"][1],
        bottom=lane["line"]["bottom"][1],
        # A version that does not know kinds reports markings only.
        kind=lane.get("kind", "marking"),
        type=marking.get("type"),
        color=marking.get("color"),
    )


def _calibration(message: Mapping[str, Any]) -> tuple[float, float] | None:
    calibration = message.get("calibration")
    return None if calibration is None else (float(calibration["pitch"]), float(calibration["yaw"]))
