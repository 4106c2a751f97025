"""Lateral error of the ego boundaries about 10 m and 30 m ahead, compared with a constant prediction.

The cameras of the labeled frames are not known well enough for meters. The rows are those at which a typical dash
camera, 1.45 m high with a horizontal field of view of 65 degrees, sees the road 10 m and 30 m ahead. The constant is
the mean column of each side at the row over the evaluated labels; no other constant has a smaller squared error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.evaluation.bootstrap import intervals, point_estimates, ratio
from lanestream_exporter.evaluation.boundaries import ego_sides
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.samples.truth import columns_at

METERS: Final = (10.0, 30.0)
_HEIGHT: Final = 1.45
_FOCAL: Final = 0.5 / math.tan(math.radians(65.0 / 2.0))  # in image widths


class LateralValue(IntEnum):
    """The values recorded for an ego side at a distance.

    LABEL, REPORT and STRAIGHT are columns in image widths from the center: of the label, of the report's curve, and of
    the report extrapolated along a straight line above its top. ROW is the row, TOP the report's top row.
    """

    LABEL, REPORT, STRAIGHT, ROW, TOP = range(5)


def lateral_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns the errors at both distances; see docs/evaluation.md."""
    values = np.array([_lateral_values(outcome) for outcome in outcomes]).reshape(-1, len(METERS), 2, len(LateralValue))
    frames = [outcome.frame for outcome in outcomes]
    return {f"{meters:.0f}m": _figures(values[:, i], frames, meters) for i, meters in enumerate(METERS)}


def _figures(values: FloatArray, frames: Sequence[LabeledFrame], meters: float) -> dict[str, Any]:
    label, report, straight, row, top = np.moveaxis(values, 2, 0)
    both = ~np.isnan(label) & ~np.isnan(report)
    constant = np.nanmean(np.where(both, label, np.nan), axis=0) if both.any(axis=0).all() else np.full(2, np.nan)
    errors = [np.where(both, np.abs(predicted - label), 0.0).sum(axis=1) for predicted in (report, straight, constant)]
    counts = np.stack([*errors, both.sum(axis=1)], axis=1)

    def rates(sums: FloatArray) -> dict[str, FloatArray]:
        ours, ours_straight, constants, sides = sums.T
        return {
            "mean_px_640": 640.0 * ratio(ours, sides),
            "mean_m": meters / _FOCAL * ratio(ours, sides),
            "constant_px_640": 640.0 * ratio(constants, sides),
            "ratio": ratio(ours, constants),
            "straight_px_640": 640.0 * ratio(ours_straight, sides),
            "straight_ratio": ratio(ours_straight, constants),
        }

    return {
        "labeled": int((~np.isnan(label)).sum()),
        "reported": int(both.sum()),
        "reached": int((both & (top <= row)).sum()),
        **point_estimates(counts, frames, rates),
        "intervals": intervals(counts, frames, rates),
    }


def _lateral_values(outcome: FrameEvaluation) -> FloatArray:
    """Returns an array (2 distances, 2 sides, 5) indexed by `LateralValue`; NaN where unknown."""
    frame = outcome.frame
    values = np.full((len(METERS), 2, len(LateralValue)), np.nan)
    horizon = shared_horizon([lane.points for lane in frame.lanes if len(lane.points) >= 3], frame.height, None)
    if horizon is None:
        return values
    rows = horizon + _FOCAL * frame.width * _HEIGHT / np.array(METERS)
    center = (frame.width - 1) / 2.0
    for side, position in enumerate((-1, 1)):
        lane = ego_sides(frame)[side]
        if lane is not None:
            values[:, side, LateralValue.LABEL] = (columns_at(lane, rows) - center) / frame.width
        for report in outcome.reports:
            if report.position == position:
                values[:, side, LateralValue.REPORT] = (report.curve.x(rows) - center) / frame.width
                values[:, side, LateralValue.STRAIGHT] = (report.straight_columns(rows) - center) / frame.width
                values[:, side, LateralValue.ROW], values[:, side, LateralValue.TOP] = rows, report.top
    return values
