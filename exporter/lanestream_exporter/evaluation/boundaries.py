"""Boundaries against labels, frame by frame: who found what, and how exactly.

A boundary is right where it lies, over at least half of a label's rows, within 15 pixels on average and 20 pixels in
the median of it, at 640 pixels of width and measured across the line; each label counts once. The distances are those
of M. Aly, "Real time detection of lane markers in urban streets", 2008; one-to-one matching and the overlap are
stricter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import LaneBoundary
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.samples.patches import columns_at

_MEAN, _MEDIAN, _OVERLAP = 15.0, 20.0, 0.5
_BOTTOM = 0.9722  # the row, as a share of the height, at which sides are told: row 700 of 720


@dataclass(frozen=True)
class Found:
    """A boundary that was reported: its curve, the rows it was reported for, its position, its identity if any.

    `farthest` is the row that it may be continued up to, where that is not almost its horizon.
    """

    curve: Curve
    top: float
    bottom: float
    position: int
    track_id: int | None = None
    farthest: float | None = None

    @classmethod
    def of(cls, lane: LaneBoundary) -> Found:
        """What a frame's result says of one boundary."""
        return cls(lane.curve, lane.top, lane.bottom, lane.position, lane.track_id)

    def straight_on(self, rows: FloatArray) -> FloatArray:
        """Columns at `rows`; above its `top` it goes on straight as it ends."""
        beyond = np.minimum(rows - self.top, 0.0)
        return np.asarray(self.curve.x(np.maximum(rows, self.top)) + self.curve.slope(self.top) * beyond)


@dataclass(frozen=True)
class Pair:
    """A right boundary: its place among the found ones, its label, their mean distance in pixels at 640 wide."""

    found: int
    label: LabelledLane
    error: float


@dataclass(frozen=True)
class Verdict:
    """One frame: the right boundaries, how many were wrong and missed, and how many are absent and not reported."""

    pairs: tuple[Pair, ...]
    wrong: int
    missed: int
    absent: int = 0


@dataclass
class Tally:
    """Counts over frames, and the errors in pixels of a 640 pixel wide image of all right boundaries."""

    right: int = 0
    wrong: int = 0
    missed: int = 0
    errors: list[float] = field(default_factory=list)

    def add(self, verdict: Verdict) -> None:
        """Counts one frame."""
        self.right += len(verdict.pairs)
        self.wrong += verdict.wrong
        self.missed += verdict.missed
        self.errors += [pair.error for pair in verdict.pairs]

    @property
    def precision(self) -> float:
        """Right ones among the reported; not a number where nothing was reported."""
        return self.right / (self.right + self.wrong) if self.right + self.wrong else float("nan")

    @property
    def recall(self) -> float:
        """Found ones among the labelled; not a number where nothing was labelled."""
        return self.right / (self.right + self.missed) if self.right + self.missed else float("nan")

    @property
    def mean_error(self) -> float:
        """Mean distance of the right ones, in pixels at 640 wide."""
        return float(np.mean(self.errors)) if self.errors else float("nan")

    def summary(self) -> dict[str, float | int | None]:
        """All figures with their counts; null where there is nothing to divide by."""
        figures = {
            "precision": round(self.precision, 4),
            "recall": round(self.recall, 4),
            "mean_error_px_640": round(self.mean_error, 3),
        }
        counts = {"right": self.right, "wrong": self.wrong, "missed": self.missed}
        return {**counts, **{name: None if np.isnan(value) else value for name, value in figures.items()}}


def count(tally: Tally, found: Sequence[Found], labels: Sequence[LabelledLane], frame: LabelledFrame) -> None:
    """Adds one frame to `tally`: the reported boundaries against `labels`, see `match`."""
    tally.add(match(found, labels, frame))


def match(found: Sequence[Found], labels: Sequence[LabelledLane], frame: LabelledFrame) -> Verdict:
    """The reported boundaries against `labels`, each matched at most once.

    A report beyond the outermost label of a side that is not wholly labelled is neither right nor wrong, unless it
    repeats a label.
    """
    distances = np.array([[_distance(f, label, frame.width) for label in labels] for f in found])
    chosen = _pairs(distances)
    matched = {i for i, _ in chosen}
    repeats = np.isfinite(distances).any(axis=1) if distances.size else np.zeros(len(found), bool)
    unmatched = [i for i in range(len(found)) if i not in matched]
    wrong = sum(1 for i in unmatched if repeats[i] or not _beyond_labels(found[i], frame))
    pairs = tuple(Pair(i, labels[j], float(distances[i, j])) for i, j in chosen)
    return Verdict(pairs, wrong, len(labels) - len(pairs))


def match_ego(found: Sequence[Found], frame: LabelledFrame) -> Verdict:
    """The reported ego boundaries against the labelled ones, side by side.

    What is reported for a side that has a label is right or wrong, wherever it lies. A side without label and without
    report is rightly absent where the ego lane is wholly labelled.
    """
    pairs: list[Pair] = []
    wrong = missed = absent = 0
    for side, label in zip((-1, 1), ego_sides(frame), strict=True):
        reported = [i for i, f in enumerate(found) if f.position == side]
        if label is None:
            wrong += sum(1 for i in reported if not _beyond_labels(found[i], frame))
            absent += frame.coverage.ego and not reported
            continue
        best = min(((_distance(found[i], label, frame.width), i) for i in reported), default=(np.inf, -1))
        right = bool(np.isfinite(best[0]))
        pairs += [Pair(best[1], label, float(best[0]))] if right else []
        wrong += len(reported) - right
        missed += not right
    return Verdict(tuple(pairs), wrong, missed, absent)


def ego_labels(frame: LabelledFrame) -> list[LabelledLane]:
    """The labels of the ego lane's boundaries that are there, left before right; see `ego_sides`."""
    return [label for label in ego_sides(frame) if label is not None]


def ego_sides(frame: LabelledFrame) -> tuple[LabelledLane | None, LabelledLane | None]:
    """The labels of the ego lane's (left, right) boundary: those named so, else the nearest ones beside the camera.

    Without names a label is extended to the row at 97 % of the height by a line through its lower half.
    """
    if any(lane.position is not None for lane in frame.lanes):
        named = {lane.position: lane for lane in frame.lanes}
        return named.get(-1), named.get(1)
    at_bottom = [_extended(lane, _BOTTOM * frame.height) - 0.5 * frame.width for lane in frame.lanes]
    left = max(((x, i) for i, x in enumerate(at_bottom) if x < 0.0), default=None)
    right = min(((x, i) for i, x in enumerate(at_bottom) if x >= 0.0), default=None)
    return None if left is None else frame.lanes[left[1]], None if right is None else frame.lanes[right[1]]


def errors_along(found: Found, label: LabelledLane, width: int) -> tuple[FloatArray, FloatArray]:
    """(rows, distances) where both are: up to 64 rows, the distance across the line in pixels at 640 wide."""
    rows = np.linspace(label.points[:, 1].min(), label.points[:, 1].max(), 64)
    rows = rows[(rows >= found.top) & (rows <= found.bottom)]
    across = np.abs(found.curve.x(rows) - columns_at(label, rows)) / np.hypot(1.0, found.curve.slope(rows))
    return rows, across * 640.0 / width


def _extended(lane: LabelledLane, row: float) -> float:
    points = lane.points[np.argsort(-lane.points[:, 1])]
    lower = points[: max(4, len(points) // 2)]
    return float(np.polyval(np.polyfit(lower[:, 1], lower[:, 0], 1), row))


def _distance(found: Found, label: LabelledLane, width: int) -> float:
    """Mean distance in pixels at 640 wide; infinite where the rule is not kept."""
    _, distance = errors_along(found, label, width)
    if len(distance) < _OVERLAP * 64:
        return np.inf
    keeps = distance.mean() <= _MEAN and np.median(distance) <= _MEDIAN
    return float(distance.mean()) if keeps else np.inf


def _pairs(distances: FloatArray) -> list[tuple[int, int]]:
    if not distances.size:
        return []
    finite = np.isfinite(distances)
    rows, columns = linear_sum_assignment(np.where(finite, distances, 1e6))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if finite[i, j]]


def _beyond_labels(found: Found, frame: LabelledFrame) -> bool:
    """Whether half of it lies beside the outermost label of an open side, where there is a label to compare with."""
    if not frame.lanes:
        return False
    rows = np.linspace(found.top, found.bottom, 16)
    columns = found.curve.x(rows)
    labelled = np.stack([columns_at(lane, rows) for lane in frame.lanes])
    known = ~np.isnan(labelled).all(axis=0)
    if not known.any():
        return frame.open_to(-1) or frame.open_to(1)
    left, right = np.nanmin(labelled[:, known], axis=0), np.nanmax(labelled[:, known], axis=0)
    beside = {-1: columns[known] <= left, 1: columns[known] >= right}
    return any(frame.open_to(side) and share.mean() >= 0.5 for side, share in beside.items())
