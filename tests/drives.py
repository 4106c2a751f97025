"""Simulated drives: the detections on a road whose truth is known, as a detector reports them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lanestream.road.appearance import Appearance
from lanestream.road.curve import Curve
from lanestream.road.results import Detection, FrameResult
from lanestream.road.view import RoadView, visible_rows
from lanestream.tracking.tracker import LaneTracker

VIEW = RoadView(640, 360, 160.0)
LANE = 2.3  # the lane width in row offsets
DT = 0.04

Scene = Callable[[int], Sequence[Detection]]


def detection(
    b: float,
    k: float = 0.0,
    *,
    v: float = VIEW.middle,
    view: RoadView = VIEW,
    probability: float = 0.95,
    paint: float = 1.0,
    expected: bool = False,
    appearance: Appearance | None = None,
) -> Detection:
    """Returns a boundary at the lateral position `b`, in row offsets, with the vanishing column `v`."""
    curve = Curve(view.horizon, (v, b, k))
    rows = visible_rows(curve, view)
    assert rows is not None
    return Detection(curve, np.diag([1.0, 1e-4, 50.0]), *rows, probability, paint, expected, appearance or Appearance())


def road(
    offset: float, lanes: Sequence[int] = (-1, 0, 1, 2), noise: np.random.Generator | None = None
) -> list[Detection]:
    """Returns the boundaries of a road whose ego lane has its center `offset` lane widths right of the camera.

    Boundary 0 is its left and 1 its right one. With `noise`, the detections have errors of about 2 pixels.
    """
    places = [b for number in lanes if abs(b := (number - 0.5 + offset) * LANE) < 5.0]
    if noise is None:
        return [detection(b) for b in places]
    return [detection(b + noise.normal(0.0, 0.01), v=VIEW.middle + noise.normal(0.0, 1.0)) for b in places]


def drive(tracker: LaneTracker, frames: int | range, scene: Scene, dt: float = DT) -> list[FrameResult]:
    """Returns the results of `frames`, at `dt` seconds from each other, in which the tracker sees `scene(frame)`."""
    numbers = range(frames) if isinstance(frames, int) else frames
    return [tracker.update(scene(number), number * dt, VIEW) for number in numbers]


def ids(result: FrameResult) -> list[int]:
    """Returns the ids of the boundaries of a frame, from left to right."""
    return [lane.track_id for lane in result.lanes]


def bottom_columns(result: FrameResult) -> list[float]:
    """Returns the columns of the boundaries of a frame at the bottom row."""
    return [float(lane.curve.x(VIEW.bottom)) for lane in result.lanes]
