"""Matching of reported boundaries to labels, frame by frame.

A report is right if, over at least half of a label's rows, its distance across the line is at most 15 pixels on average
and 20 pixels in the median, at 640 pixels of image width; each label matches at most one report. The distances are
those of M. Aly, "Real time detection of lane markers in urban streets", 2008; one-to-one matching and the overlap make
the rule stricter. Whether it has the kind of its label, a marking or an edge of the road, is a figure of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES, Appearance, BoundaryKind
from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import LaneBoundary
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledLane
from lanestream_exporter.samples.truth import columns_at

_MAX_MEAN, _MAX_MEDIAN, _MIN_OVERLAP = 15.0, 20.0, 0.5
_SAMPLES = 64  # rows of a label at which distances are measured
# Added to the distance if the kinds differ: more than any sum of distances, so that equal kinds are matched first.
_OTHER_KIND, _NO_MATCH = 1e4, 1e8
_SIDE_ROW = 0.9722  # the row, as a share of the height, that decides left or right: row 700 of 720


@dataclass(frozen=True)
class ReportedBoundary:
    """A boundary as a method reports it: its curve, the rows that it spans, its position and its track id, if any.

    `farthest` is the highest row that it may be extrapolated to; None allows extrapolation close to its horizon. `type`
    and `color` are those of a marking; None for an edge of the road, and from a method that does not classify markings.
    `probability` is that of being a boundary; None from a method without probabilities.
    """

    curve: Curve
    top: float
    bottom: float
    position: int
    track_id: int | None = None
    farthest: float | None = None
    kind: BoundaryKind = "marking"
    type: str | None = None
    color: str | None = None
    probability: float | None = None

    @classmethod
    def from_lane(cls, lane: LaneBoundary) -> ReportedBoundary:
        """Returns the report of a boundary in a frame's result."""
        kind = lane.appearance.kind
        marking_type, color = _painted(lane.appearance) if kind == "marking" else (None, None)
        return cls(
            lane.curve,
            lane.top,
            lane.bottom,
            lane.position,
            lane.track_id,
            kind=kind,
            type=marking_type,
            color=color,
            probability=lane.probability,
        )

    def straight_columns(self, rows: FloatArray) -> FloatArray:
        """Returns the columns at `rows`, extrapolated along a straight line above `top`."""
        above = np.minimum(rows - self.top, 0.0)
        return np.asarray(self.curve.x(np.maximum(rows, self.top)) + self.curve.slope(self.top) * above)


@dataclass(frozen=True)
class BoundaryMatch:
    """A right report: its index among the reports, its label, and their mean distance in pixels at 640 wide."""

    index: int
    label: LabeledLane
    error: float


@dataclass(frozen=True)
class FrameMatches:
    """The right reports of a frame, the indices of the wrong ones, and the labels that were missed.

    For the ego lane, `empty` is the number of sides that have no boundary by the labels, and `absent` that of those
    without a report.
    """

    matches: tuple[BoundaryMatch, ...]
    wrong_reports: tuple[int, ...]
    missed_labels: tuple[LabeledLane, ...]
    absent: int = 0
    empty: int = 0

    @property
    def wrong(self) -> int:
        """The number of wrong reports."""
        return len(self.wrong_reports)

    @property
    def missed(self) -> int:
        """The number of missed labels."""
        return len(self.missed_labels)


def match(reports: Sequence[ReportedBoundary], labels: Sequence[LabeledLane], frame: LabeledFrame) -> FrameMatches:
    """Matches reports to `labels` one to one.

    A report that may be right, but is not labeled, is neither right nor wrong unless it duplicates a label; see
    `_may_be_unlabeled`.
    """
    distances = np.array([[_distance(report, label, frame.width) for label in labels] for report in reports])
    pairs = _assign(distances, reports, labels)
    found, matched = {j for _, j in pairs}, {i for i, _ in pairs}
    duplicates = np.isfinite(distances).any(axis=1) if distances.size else np.zeros(len(reports), bool)
    wrong = [
        i
        for i, report in enumerate(reports)
        if i not in matched and not _may_be_unlabeled(report, frame, bool(duplicates[i]))
    ]
    matches = tuple(BoundaryMatch(i, labels[j], float(distances[i, j])) for i, j in pairs)
    return FrameMatches(matches, tuple(wrong), tuple(label for j, label in enumerate(labels) if j not in found))


def match_ego(reports: Sequence[ReportedBoundary], frame: LabeledFrame) -> FrameMatches:
    """Matches the reported ego boundaries to the labeled ones, separately for each side and whatever their kind.

    A report for a side that has a label is right or wrong wherever it lies. A side without label and report is rightly
    absent if the ego lane is completely labeled.
    """
    matches: list[BoundaryMatch] = []
    wrong: list[int] = []
    missed: list[LabeledLane] = []
    absent = empty = 0
    for side, label in zip((-1, 1), ego_sides(frame), strict=True):
        reported = [i for i, report in enumerate(reports) if report.position == side]
        if label is None:
            wrong += [i for i in reported if not _may_be_unlabeled(reports[i], frame)]
            absent += frame.coverage.ego and not reported
            empty += frame.coverage.ego
            continue
        error, index = min(((_distance(reports[i], label, frame.width), i) for i in reported), default=(np.inf, -1))
        if np.isfinite(error):
            matches.append(BoundaryMatch(index, label, float(error)))
            reported.remove(index)
        else:
            missed.append(label)
        wrong += reported
    return FrameMatches(tuple(matches), tuple(wrong), tuple(missed), absent, empty)


def ego_labels(frame: LabeledFrame) -> list[LabeledLane]:
    """Returns the labels of the ego lane's boundaries, left before right, without missing ones; see `ego_sides`."""
    return [label for label in ego_sides(frame) if label is not None]


def ego_sides(frame: LabeledFrame) -> tuple[LabeledLane | None, LabeledLane | None]:
    """Returns the labels of the ego lane's (left, right) boundary: by position, or else the nearest to the camera.

    A label without position is extrapolated to the row at 97 % of the height by a line through its lower half.
    """
    if any(lane.position is not None for lane in frame.lanes):
        by_position = {lane.position: lane for lane in frame.lanes}
        return by_position.get(-1), by_position.get(1)
    at_bottom = [_extrapolated(lane, _SIDE_ROW * frame.height) - 0.5 * frame.width for lane in frame.lanes]
    left = max(((x, i) for i, x in enumerate(at_bottom) if x < 0.0), default=None)
    right = min(((x, i) for i, x in enumerate(at_bottom) if x >= 0.0), default=None)
    return None if left is None else frame.lanes[left[1]], None if right is None else frame.lanes[right[1]]


def errors_along(report: ReportedBoundary, label: LabeledLane, width: int) -> tuple[FloatArray, FloatArray]:
    """Returns (rows, distances) where both exist: up to 64 rows, distances across the line in pixels at 640 wide."""
    rows = np.linspace(label.points[:, 1].min(), label.points[:, 1].max(), _SAMPLES)
    rows = rows[(rows >= report.top) & (rows <= report.bottom)]
    across = np.abs(report.curve.x(rows) - columns_at(label, rows)) / np.hypot(1.0, report.curve.slope(rows))
    return rows, across * 640.0 / width


def _extrapolated(lane: LabeledLane, row: float) -> float:
    points = lane.points[np.argsort(-lane.points[:, 1])]
    lower = points[: max(4, len(points) // 2)]
    return float(np.polyval(np.polyfit(lower[:, 1], lower[:, 0], 1), row))


def _distance(report: ReportedBoundary, label: LabeledLane, width: int) -> float:
    """Returns the mean distance in pixels at 640 wide; infinity if the report does not match the label."""
    _, distance = errors_along(report, label, width)
    if len(distance) < _MIN_OVERLAP * _SAMPLES:
        return np.inf
    matches = distance.mean() <= _MAX_MEAN and np.median(distance) <= _MAX_MEDIAN
    return float(distance.mean()) if matches else np.inf


def _assign(
    distances: FloatArray, reports: Sequence[ReportedBoundary], labels: Sequence[LabeledLane]
) -> list[tuple[int, int]]:
    """Returns the pairs of report and label: as many as possible, of equal kind if possible, with small distances."""
    if not distances.size:
        return []
    finite = np.isfinite(distances)
    other_kind = np.array([[label.kind not in (report.kind, None) for label in labels] for report in reports])
    costs = np.where(finite, distances + _OTHER_KIND * other_kind, _NO_MATCH)
    rows, columns = linear_sum_assignment(costs)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if finite[i, j]]


def _may_be_unlabeled(report: ReportedBoundary, frame: LabeledFrame, duplicate: bool = False) -> bool:
    """Returns whether a report that matches no label may be a boundary that the labels leave out.

    It may if it lies beyond the outermost label of a side that is not completely labeled, unless it is a `duplicate` of
    a label. If edges of the road are not labeled, an edge beyond the outermost label may be one on any side. A marking
    is wrong in a frame without markings or without labels.
    """
    sides = _sides_beyond_labels(report, frame)
    if report.kind == "road_edge" and not frame.coverage.edges:
        return bool(sides)
    if duplicate or (report.kind == "marking" and not (frame.coverage.markings and frame.lanes)):
        return False
    return any(frame.open_to(side) for side in sides)


def _sides_beyond_labels(report: ReportedBoundary, frame: LabeledFrame) -> tuple[int, ...]:
    """Returns the sides (-1 left, 1 right) on which at least half of the report lies outside the outermost label.

    A report at whose rows nothing is labeled lies outside on both.
    """
    rows = np.linspace(report.top, report.bottom, 16)
    columns = report.curve.x(rows)
    labeled = np.array([columns_at(lane, rows) for lane in frame.lanes]).reshape(-1, len(rows))
    known = ~np.isnan(labeled).all(axis=0)
    if not known.any():
        return (-1, 1)
    left, right = np.nanmin(labeled[:, known], axis=0), np.nanmax(labeled[:, known], axis=0)
    outside = {-1: columns[known] <= left, 1: columns[known] >= right}
    return tuple(side for side, beyond in outside.items() if beyond.mean() >= 0.5)


def _painted(appearance: Appearance) -> tuple[str | None, str | None]:
    """Returns the most probable type and color of a marking; None if they are not classified."""
    if appearance.types is None or appearance.colors is None:
        return None, None
    types, colors = appearance.types, appearance.colors
    return MARKING_TYPES[types.index(max(types))], MARKING_COLORS[colors.index(max(colors))]
