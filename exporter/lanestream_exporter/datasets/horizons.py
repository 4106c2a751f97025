"""Horizons from labels: the row at which all boundaries of a flat road meet under one perspective."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabeledFrame

# The standard deviation of a frame's horizon within its drive, as a share of the height: cameras pitch, roads rise and
# fall.
_PITCH_SIGMA: Final = 0.007

# Horizons are searched for from this share of the height: those of cameras that look down are above the image.
_HIGHEST: Final = -0.6

# The points of one label share their errors: together they weigh as much as this many independent points. No residual
# is taken to be below one pixel.
_POINTS_WORTH: Final = 4.0


def shared_horizon(lanes: Sequence[FloatArray], height: int, expected: float | None) -> float | None:
    """Returns the row below which all boundaries share one vanishing point and one curvature; None if undetermined.

    `lanes` are polylines (N, 2). The model is x = v + b (y - h) + k / (y - h) with v, h and k shared; `expected` is the
    approximate h, if known. A road that the model describes badly, because its curvature changes or because of a hill,
    says little about h: its points are weighted down by their residuals.
    """
    lowest = min((float(lane[:, 1].min()) for lane in lanes), default=0.0)
    rows = np.arange(_HIGHEST * height, min(lowest, 0.8 * height) - 1.0, 0.5)
    if expected is not None:
        rows = rows[np.abs(rows - expected) <= 0.08 * height]
    if not lanes or (len(lanes) < 2 and expected is None) or not len(rows):
        return expected
    costs = _misfits(lanes, rows)
    if expected is not None:
        scale = max(1.0, costs.min() / (_POINTS_WORTH * len(lanes)))
        costs = costs / scale + ((rows - expected) / (_PITCH_SIGMA * height)) ** 2
    return float(rows[int(np.argmin(costs))])


def drive_horizons(frames: Sequence[LabeledFrame]) -> list[float | None]:
    """Returns the horizon of each frame of one drive; frames with too few labels get about the drive's median."""
    lanes = [[lane.points for lane in frame.lanes if len(lane.points) >= 3] for frame in frames]
    alone = [shared_horizon(points, frame.height, None) for points, frame in zip(lanes, frames, strict=True)]
    shares = [row / frame.height for row, frame in zip(alone, frames, strict=True) if row is not None]
    if not shares:
        return alone
    median = float(np.median(shares))
    return [
        shared_horizon(points, frame.height, median * frame.height) for points, frame in zip(lanes, frames, strict=True)
    ]


def _misfits(lanes: Sequence[FloatArray], horizons: FloatArray) -> FloatArray:
    """Returns the weighted squared residuals (R,) of all lanes under the shared model below each horizon, in pixels.

    This is least squares by modified Gram-Schmidt, for all `horizons` (R,) at once. Each lane's slope appears in its
    own points only, so it is eliminated lane by lane; v and k of the road remain.
    """
    first = np.cumsum([0, *(len(lane) for lane in lanes[:-1])])
    lengths = np.array([len(lane) for lane in lanes])
    weight = np.repeat(np.sqrt(_POINTS_WORTH / lengths), lengths)
    points = np.concatenate(lanes)
    u = points[:, 1] - horizons[:, None]
    slope = weight * u
    slope /= np.repeat(np.sqrt(np.add.reduceat(slope**2, first, axis=1)), lengths, axis=1)

    def without_slope(values: FloatArray) -> FloatArray:
        along = np.add.reduceat(values * slope, first, axis=1)
        return np.asarray(values - slope * np.repeat(along, lengths, axis=1))

    residual = without_slope(weight * points[:, 0] + np.zeros_like(u))
    constant = without_slope(weight + np.zeros_like(u))
    curvature = _without(without_slope(weight / u), constant)
    residual = _without(_without(residual, constant), curvature)
    return np.asarray((residual**2).sum(axis=1))


def _without(values: FloatArray, direction: FloatArray) -> FloatArray:
    """Returns the rows of `values` (R, N) without their components along the rows of `direction` (R, N)."""
    squared = np.maximum((direction**2).sum(axis=1, keepdims=True), 1e-24)
    return np.asarray(values - direction * ((values * direction).sum(axis=1, keepdims=True) / squared))
