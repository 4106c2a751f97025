"""Synthetic clips for the figures of tracking: a straight road, exact truth and answers with known errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lanestream_exporter.evaluation.tracking.answers import Answer
from lanestream_exporter.evaluation.tracking.comparison import ClipRun, without_edges
from lanestream_exporter.evaluation.tracking.truth import TruthFrame

WIDTH, HEIGHT, HORIZON, FPS = 640, 360, 160.0, 25.0
CAMERA_HEIGHT, LANE_WIDTH = 1.4, 3.5
# Columns per row below the horizon.
LANE = LANE_WIDTH / CAMERA_HEIGHT
DEPTH = HEIGHT - 1.0 - HORIZON


@dataclass(frozen=True)
class TrueLane:
    """A true straight boundary at `place` lane widths right of the camera; of the type `kerb` or `edge` no marking."""

    lane_id: int
    place: float
    gap: int = 0
    gap_length: int = 0
    position: int | None = None
    type: str = "solid"


@dataclass(frozen=True)
class Reported:
    """A reported straight boundary at `place` lane widths right of the camera.

    `sigma` is in lane widths, and the error of the lateral position; the vanishing column is exact. Without a `type` it
    is reported as by a model that does not classify markings.
    """

    track_id: int
    place: float
    position: int = 0
    state: str = "detected"
    sigma: float = 0.02
    kind: str = "marking"
    type: str | None = None
    color: str = "white"


PAIR = (TrueLane(1, -0.5), TrueLane(2, 0.5))


def side(place: float) -> int:
    """The position of a boundary next to the camera."""
    return -1 if place < 0.0 else 1


def record(frame: int, lanes: Iterable[TrueLane] = PAIR, **fields: Any) -> dict[str, Any]:
    """Returns a truth record; `fields` replace or add to it."""
    ego = {"offset_m": 0.0, "heading": 0.0, "curvature": 0.0, "lane_width_m": LANE_WIDTH, "lateral_speed": 0.0}
    return {
        "clip": "synthetic",
        "frame": frame,
        "timestamp": frame / FPS,
        "width": WIDTH,
        "height": HEIGHT,
        "scene": 0,
        "horizon": HORIZON,
        "camera": {"height": CAMERA_HEIGHT, "field_of_view": 60.0},
        "ego": ego,
        "events": [],
        "lanes": [
            {
                "id": lane.lane_id,
                "position": side(lane.place) if lane.position is None else lane.position,
                "type": lane.type,
                "color": "white",
                "points": _points(lane.place),
                "paint": 0.0 if lane.gap else 1.0,
                "gap": lane.gap,
                "gap_length": lane.gap_length,
            }
            for lane in lanes
        ],
    } | fields


def message(frame: int, lanes: Iterable[Reported], **fields: Any) -> dict[str, Any]:
    """Returns a `lanes` message; `fields` replace or add to it."""
    reported = list(lanes)
    by_position = {lane.position or side(lane.place): lane.track_id for lane in reversed(reported)}
    return {
        "type": "lanes",
        "timestamp": frame / FPS,
        "horizon": HORIZON,
        "ego": {"left": by_position.get(-1), "right": by_position.get(1)},
        "events": [],
        "lanes": [
            {
                "track_id": lane.track_id,
                "position": lane.position or side(lane.place),
                "state": lane.state,
                "kind": lane.kind,
                "marking": None if lane.type is None else {"type": lane.type, "color": lane.color},
                "horizon": HORIZON,
                "coefficients": [320.0, lane.place * LANE, 0.0],
                "covariance": np.diag([0.0, (lane.sigma * LANE) ** 2, 0.0]).tolist(),
                "line": {"bottom": [320.0 + lane.place * LANE * DEPTH, HEIGHT - 1.0], "top": [320.0, HORIZON + 20.0]},
            }
            for lane in reported
        ],
    } | fields


def run(
    frames: int,
    answer: Callable[[int], Iterable[Reported]],
    truth: Callable[[int], Iterable[TrueLane]] = lambda _: PAIR,
    record_fields: Callable[[int], Mapping[str, Any]] = lambda _: {},
    message_fields: Callable[[int], Mapping[str, Any]] = lambda _: {},
    kind: str = "keeping",
) -> ClipRun:
    """Returns a run of `frames` frames; the functions give the boundaries and more fields of each by its number."""
    result = ClipRun(kind, "0")
    for number in range(frames):
        true = TruthFrame.from_record(record(number, truth(number), **record_fields(number)))
        found = Answer.from_message(message(number, answer(number), **message_fields(number)))
        result.add(true, without_edges(true, found))
    return result


def _points(place: float) -> list[list[float]]:
    rows = np.arange(HEIGHT - 1.0, HORIZON + 10.0, -1.0)
    columns = 320.0 + place * LANE * (rows - HORIZON)
    inside = (columns >= 0.0) & (columns <= WIDTH - 1.0)
    return np.stack([columns, rows], axis=1)[inside].tolist()
