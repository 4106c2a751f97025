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

from lanestream.lanes import Curve
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.patches import columns_at

_MEAN, _MEDIAN, _OVERLAP = 15.0, 20.0, 0.5


@dataclass(frozen=True)
class Found:
    """A boundary that was reported: its curve, the rows it was reported for, and its position."""

    curve: Curve
    top: float
    bottom: float
    position: int


@dataclass
class Tally:
    """Counts over frames, and the errors in pixels of a 640 pixel wide image of all right boundaries."""

    right: int = 0
    wrong: int = 0
    missed: int = 0
    errors: list[float] = field(default_factory=list)

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

    def summary(self) -> dict[str, float | int]:
        """All figures with their counts."""
        return {
            "right": self.right,
            "wrong": self.wrong,
            "missed": self.missed,
            "precision": round(self.precision, 4),
            "recall": round(self.recall, 4),
            "mean_error_px_640": round(self.mean_error, 3),
        }


def count(tally: Tally, found: Sequence[Found], labels: Sequence[LabelledLane], frame: LabelledFrame) -> None:
    """Adds one frame to `tally`: the reported boundaries against `labels`, each matched at most once.

    Where the frame is not exhaustively labelled, a report beyond its outermost labels is neither right nor wrong.
    """
    distances = np.array([[_distance(f, label, frame.width) for label in labels] for f in found])
    pairs = _pairs(distances)
    tally.right += len(pairs)
    tally.missed += len(labels) - len(pairs)
    tally.errors += [float(distances[pair]) for pair in pairs]
    matched = {i for i, _ in pairs}
    tally.wrong += sum(1 for i, f in enumerate(found) if i not in matched and not _beyond_labels(f, frame))


def ego_labels(frame: LabelledFrame) -> list[LabelledLane]:
    """The labels of the ego lane's two boundaries: those named so, else the nearest ones beside the camera.

    Without names a label is extended to the row at 97 % of the height by a line through its lower half.
    """
    if any(lane.position is not None for lane in frame.lanes):
        return [lane for lane in frame.lanes if lane.position in (-1, 1)]
    at_bottom = [(_extended(lane, 0.9722 * frame.height) - 0.5 * frame.width, lane) for lane in frame.lanes]
    left = max(((x, i) for i, (x, _) in enumerate(at_bottom) if x < 0.0), default=None)
    right = min(((x, i) for i, (x, _) in enumerate(at_bottom) if x >= 0.0), default=None)
    return [frame.lanes[side[1]] for side in (left, right) if side is not None]


def _extended(lane: LabelledLane, row: float) -> float:
    points = lane.points[np.argsort(-lane.points[:, 1])]
    lower = points[: max(4, len(points) // 2)]
    return float(np.polyval(np.polyfit(lower[:, 1], lower[:, 0], 1), row))


def _distance(found: Found, label: LabelledLane, width: int) -> float:
    """Mean distance in pixels at 640 wide; infinite where the rule is not kept."""
    rows = np.linspace(label.points[:, 1].min(), label.points[:, 1].max(), 64)
    rows = rows[(rows >= found.top) & (rows <= found.bottom)]
    if len(rows) < _OVERLAP * 64:
        return np.inf
    across = np.abs(found.curve.x(rows) - columns_at(label, rows)) / np.hypot(1.0, found.curve.slope(rows))
    distance = across * 640.0 / width
    keeps = distance.mean() <= _MEAN and np.median(distance) <= _MEDIAN
    return float(distance.mean()) if keeps else np.inf


def _pairs(distances: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> list[tuple[int, int]]:
    if not distances.size:
        return []
    finite = np.isfinite(distances)
    rows, columns = linear_sum_assignment(np.where(finite, distances, 1e6))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if finite[i, j]]


def _beyond_labels(found: Found, frame: LabelledFrame) -> bool:
    if frame.exhaustive or not frame.lanes:
        return False
    rows = np.linspace(found.top, found.bottom, 16)
    columns = found.curve.x(rows)
    labelled = np.stack([columns_at(lane, rows) for lane in frame.lanes])
    known = ~np.isnan(labelled).all(axis=0)
    if not known.any():
        return True
    left, right = np.nanmin(labelled[:, known], axis=0), np.nanmax(labelled[:, known], axis=0)
    inside = (columns[known] > left) & (columns[known] < right)
    return bool(inside.mean() <= 0.5)
