"""Lateral error of the ego boundaries about 10 m and 30 m ahead, against a constant answer.

No camera of the labelled frames is known well enough for metres. The rows are those at which a usual dash camera sees
the road 10 m and 30 m ahead: 1.45 m high, its picture 65 degrees wide. The constant is the mean place of each side at
the row, taken from the very labels that are measured: no other constant has a smaller squared error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from lanestream.lanes import FloatArray
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.bootstrap import intervals, measured, ratio
from lanestream_exporter.evaluation.boundaries import ego_sides
from lanestream_exporter.evaluation.outcomes import Outcome
from lanestream_exporter.patches import columns_at

METRES: Final = (10.0, 30.0)
_HEIGHT: Final = 1.45
_FOCAL: Final = 0.5 / math.tan(math.radians(65.0 / 2.0))  # in image widths


def lateral_figures(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Errors at both distances; see docs/evaluation.md."""
    places = [_places(outcome) for outcome in outcomes]  # each (distances, sides, label and report), in image widths
    frames = [outcome.frame for outcome in outcomes]
    return {f"{metres:.0f}m": _figures([p[i] for p in places], frames, metres) for i, metres in enumerate(METRES)}


def _figures(places: Sequence[FloatArray], frames: Sequence[LabelledFrame], metres: float) -> dict[str, Any]:
    label, report = np.moveaxis(np.array(places).reshape(-1, 2, 2), 2, 0)
    both = ~np.isnan(label) & ~np.isnan(report)
    constant = np.nanmean(np.where(both, label, np.nan), axis=0) if both.any(axis=0).all() else np.full(2, np.nan)
    error = np.where(both, np.abs(report - label), 0.0).sum(axis=1)
    error_of_constant = np.where(both, np.abs(constant - label), 0.0).sum(axis=1)
    counts = np.stack([error, error_of_constant, both.sum(axis=1)], axis=1)

    def rates(sums: FloatArray) -> dict[str, FloatArray]:
        ours, constants, sides = sums.T
        return {
            "mean_px_640": 640.0 * ratio(ours, sides),
            "mean_m": metres / _FOCAL * ratio(ours, sides),
            "constant_px_640": 640.0 * ratio(constants, sides),
            "ratio": ratio(ours, constants),
        }

    return {
        "labelled": int((~np.isnan(label)).sum()),
        "told": int(both.sum()),
        **measured(counts, frames, rates),
        "intervals": intervals(counts, frames, rates),
    }


def _places(outcome: Outcome) -> FloatArray:
    """Columns (2 distances, 2 sides, label and report) in image widths from the middle; not a number where unknown."""
    frame = outcome.frame
    places = np.full((len(METRES), 2, 2), np.nan)
    horizon = shared_horizon([lane.points for lane in frame.lanes if len(lane.points) >= 3], frame.height, None)
    if horizon is None:
        return places
    rows = horizon + _FOCAL * frame.width * _HEIGHT / np.array(METRES)
    middle = (frame.width - 1) / 2.0
    for side, position in enumerate((-1, 1)):
        lane = ego_sides(frame)[side]
        if lane is not None:
            places[:, side, 0] = (columns_at(lane, rows) - middle) / frame.width
        for found in outcome.found:
            if found.position == position:
                places[:, side, 1] = (found.curve.x(rows) - middle) / frame.width
    return places
