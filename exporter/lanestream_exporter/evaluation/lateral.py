"""Lateral error of the ego boundaries about 10 m and 30 m ahead, against a constant answer.

No camera of the labelled frames is known well enough for metres. The rows are those at which a usual dash camera sees
the road 10 m and 30 m ahead: 1.45 m high, its picture 65 degrees wide. The constant is the mean place of each side at
the row, taken from the very labels that are measured: no other constant has a smaller squared error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.horizons import shared_horizon
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.bootstrap import intervals, measured, ratio
from lanestream_exporter.evaluation.boundaries import ego_sides
from lanestream_exporter.evaluation.outcomes import Outcome
from lanestream_exporter.samples.patches import columns_at

METRES: Final = (10.0, 30.0)
_HEIGHT: Final = 1.45
_FOCAL: Final = 0.5 / math.tan(math.radians(65.0 / 2.0))  # in image widths


class Place(IntEnum):
    """What is kept of an ego side at a distance.

    Columns in image widths from the middle: of the label, of the report's curve, and of the report where it goes on
    straight above its top. The row, and the report's top row.
    """

    LABEL, REPORT, STRAIGHT, ROW, TOP = range(5)


def lateral_figures(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Errors at both distances; see docs/evaluation.md."""
    places = np.array([_places(outcome) for outcome in outcomes]).reshape(-1, len(METRES), 2, len(Place))
    frames = [outcome.frame for outcome in outcomes]
    return {f"{metres:.0f}m": _figures(places[:, i], frames, metres) for i, metres in enumerate(METRES)}


def _figures(places: FloatArray, frames: Sequence[LabelledFrame], metres: float) -> dict[str, Any]:
    label, report, straight, row, top = np.moveaxis(places, 2, 0)
    both = ~np.isnan(label) & ~np.isnan(report)
    constant = np.nanmean(np.where(both, label, np.nan), axis=0) if both.any(axis=0).all() else np.full(2, np.nan)
    errors = [np.where(both, np.abs(said - label), 0.0).sum(axis=1) for said in (report, straight, constant)]
    counts = np.stack([*errors, both.sum(axis=1)], axis=1)

    def rates(sums: FloatArray) -> dict[str, FloatArray]:
        ours, ours_straight, constants, sides = sums.T
        return {
            "mean_px_640": 640.0 * ratio(ours, sides),
            "mean_m": metres / _FOCAL * ratio(ours, sides),
            "constant_px_640": 640.0 * ratio(constants, sides),
            "ratio": ratio(ours, constants),
            "straight_px_640": 640.0 * ratio(ours_straight, sides),
            "straight_ratio": ratio(ours_straight, constants),
        }

    return {
        "labelled": int((~np.isnan(label)).sum()),
        "told": int(both.sum()),
        "reached": int((both & (top <= row)).sum()),
        **measured(counts, frames, rates),
        "intervals": intervals(counts, frames, rates),
    }


def _places(outcome: Outcome) -> FloatArray:
    """What `Place` names (2 distances, 2 sides, 5); not a number where unknown."""
    frame = outcome.frame
    places = np.full((len(METRES), 2, len(Place)), np.nan)
    horizon = shared_horizon([lane.points for lane in frame.lanes if len(lane.points) >= 3], frame.height, None)
    if horizon is None:
        return places
    rows = horizon + _FOCAL * frame.width * _HEIGHT / np.array(METRES)
    middle = (frame.width - 1) / 2.0
    for side, position in enumerate((-1, 1)):
        lane = ego_sides(frame)[side]
        if lane is not None:
            places[:, side, Place.LABEL] = (columns_at(lane, rows) - middle) / frame.width
        for found in outcome.found:
            if found.position == position:
                places[:, side, Place.REPORT] = (found.curve.x(rows) - middle) / frame.width
                places[:, side, Place.STRAIGHT] = (found.straight_on(rows) - middle) / frame.width
                places[:, side, Place.ROW], places[:, side, Place.TOP] = rows, found.top
    return places
