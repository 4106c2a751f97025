"""The horizon that labels tell: the row below which all boundaries of a flat road keep to one perspective."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabelledFrame

# How far a frame's horizon is usually from its drive's, as a share of the height: cameras nod, and roads rise and fall.
_NOD: Final = 0.007

# Points of a label share their errors: so many of a lane's are worth one each, and none is exact to less than a pixel.
_WORTH: Final = 4.0


def shared_horizon(lanes: Sequence[FloatArray], height: int, expected: float | None) -> float | None:
    """The row under which all boundaries keep to one vanishing point and one bend; None where that can't be told.

    `lanes` are polylines (N, 2). The model is x = v + b (y - h) + k / (y - h) with v, h and k shared; `expected` is
    about h, where it is known. A road that the model describes badly, because its bend changes or because it is a hill,
    says little of h: its points count for as much less as they are off.
    """
    lowest = min((float(lane[:, 1].min()) for lane in lanes), default=0.0)
    rows = np.arange(0.15 * height, min(lowest, 0.8 * height) - 1.0, 0.5)
    if expected is not None:
        rows = rows[np.abs(rows - expected) <= 0.08 * height]
    if not lanes or (len(lanes) < 2 and expected is None) or not len(rows):
        return expected
    costs = np.array([_misfit(lanes, row) for row in rows])
    if expected is not None:
        costs = costs / max(1.0, costs.min() / (_WORTH * len(lanes))) + ((rows - expected) / (_NOD * height)) ** 2
    return float(rows[int(np.argmin(costs))])


def drive_horizons(frames: Sequence[LabelledFrame]) -> list[float | None]:
    """The horizon of each frame of one drive: what a frame tells too little of is near the drive's usual one."""
    lanes = [[lane.points for lane in frame.lanes if len(lane.points) >= 3] for frame in frames]
    alone = [shared_horizon(of, frame.height, None) for of, frame in zip(lanes, frames, strict=True)]
    shares = [row / frame.height for row, frame in zip(alone, frames, strict=True) if row is not None]
    if not shares:
        return alone
    usual = float(np.median(shares))
    return [shared_horizon(of, frame.height, usual * frame.height) for of, frame in zip(lanes, frames, strict=True)]


def _misfit(lanes: Sequence[FloatArray], horizon: float) -> float:
    """Squared residuals of all lanes under the shared model, in pixels."""
    blocks, targets = [], []
    for index, lane in enumerate(lanes):
        u = lane[:, 1] - horizon
        own = np.zeros((len(u), len(lanes)))
        own[:, index] = u
        weight = np.sqrt(_WORTH / len(u))
        blocks.append(weight * np.hstack([np.ones((len(u), 1)), 100.0 / u[:, None], own]))
        targets.append(weight * lane[:, 0])
    design, target = np.concatenate(blocks), np.concatenate(targets)
    solution = np.linalg.lstsq(design, target, rcond=None)[0]
    return float(((design @ solution - target) ** 2).sum())
