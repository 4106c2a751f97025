"""Points of a lane boundary: read from whatever a label file holds, checked, put in order from below, and fitted."""

from __future__ import annotations

from typing import Final

import numpy as np

from lanestream.road.curve import Curve, FloatArray, curve_basis
from lanestream.road.view import RoadView

# A hand that places points may slip by this much, in pixels, beyond the picture's edge or back down the boundary.
SLACK: Final = 1.0


def points_of(value: object) -> FloatArray:
    """`value`, pairs of x and y, as (N, 2) floats. Raises ValueError where it is something else."""
    try:
        points: FloatArray = np.asarray(value, dtype=float)
    except (ValueError, TypeError, OverflowError):
        raise ValueError("its points are not pairs of numbers") from None
    if points.size == 0:
        return np.empty((0, 2))
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError("its points are not pairs of numbers")
    return points


def within(points: FloatArray, width: int, height: int) -> FloatArray:
    """The points inside a picture: some formats draw boundaries on beyond it. What is no number stays, to be told."""
    x, y = points.T
    inside: FloatArray = points[~((x < 0) | (x > width - 1) | (y < 0) | (y > height - 1))]
    return inside


def sound(points: FloatArray, width: int, height: int) -> FloatArray:
    """`points` (N, 2) of a picture's pixels from the lowest row upwards, each row passed once.

    A step of up to `SLACK` back down is a labeller's hand: its point is left out. Raises ValueError that says what is
    wrong: no points or one, what is no number, what lies outside the picture, rows that turn back.
    """
    if len(points) < 2:
        raise ValueError("it has one point; at least two are needed" if len(points) else "it has no points")
    if not np.isfinite(points).all():
        raise ValueError("one of its points is not a number")
    outside = ((points < -SLACK) | (points > (width - 1 + SLACK, height - 1 + SLACK))).any(axis=1)
    if outside.any():
        raise ValueError(f"{_place(points[outside][0])} is outside the picture of {width} x {height}")
    if points[0, 1] < points[-1, 1]:
        points = points[::-1].copy()
    reached = np.minimum.accumulate(points[:, 1])
    back = points[:, 1] - reached
    if back.max() > SLACK:
        turn = points[back > SLACK][0]
        raise ValueError(f"its rows turn back at {_place(turn)}; a lane boundary crosses each row once")
    climbs = np.concatenate([[True], points[1:, 1] < reached[:-1]])
    if climbs.sum() < 2:
        raise ValueError(f"its points all lie on row {points[0, 1]:g}")
    kept: FloatArray = points[climbs]
    return kept


def fitted_curve(points: FloatArray, view: RoadView) -> Curve:
    """The curve under the view's horizon that is nearest to three or more `points` (N, 2) below it, by columns."""
    scale = np.array([1.0, view.depth, 1.0 / view.depth])
    basis = curve_basis(view.horizon, points[:, 1]) / scale
    v, b, k = (np.linalg.lstsq(basis, points[:, 0], rcond=None)[0] / scale).tolist()
    return Curve(view.horizon, (v, b, k))


def _place(point: FloatArray) -> str:
    return f"({point[0]:g}, {point[1]:g})"
