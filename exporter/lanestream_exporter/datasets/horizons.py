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
    rows = np.arange(0.15 * height, min(lowest, 0.8 * height) - 1.0, 0.5)
    if expected is not None:
        rows = rows[np.abs(rows - expected) <= 0.08 * height]
    if not lanes or (len(lanes) < 2 and expected is None) or not len(rows):
        return expected
    costs = np.array([_misfit(lanes, row) for row in rows])
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


def _misfit(lanes: Sequence[FloatArray], horizon: float) -> float:
    """Returns the weighted squared residuals of all lanes under the shared model, in pixels."""
    blocks, targets = [], []
    for index, lane in enumerate(lanes):
        u = lane[:, 1] - horizon
        slopes = np.zeros((len(u), len(lanes)))
        slopes[:, index] = u
        weight = np.sqrt(_POINTS_WORTH / len(u))
        blocks.append(weight * np.hstack([np.ones((len(u), 1)), 100.0 / u[:, None], slopes]))
        targets.append(weight * lane[:, 0])
    design, target = np.concatenate(blocks), np.concatenate(targets)
    solution = np.linalg.lstsq(design, target, rcond=None)[0]
    return float(((design @ solution - target) ** 2).sum())
