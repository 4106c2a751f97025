"""The metrics of the TuSimple and CULane benchmarks.

TuSimple's published rule (github.com/TuSimple/tusimple-benchmark, lane.py): lanes are columns at fixed rows of a
1280 x 720 image, negative where absent. A row is right if the columns are less than 20 px / cos(angle of the label)
apart, or if both are absent. The accuracy of a label is the share of right rows of the report that fits it best, so one
report may match two labels. A label counts as found from an accuracy of 0.85.

CULane's rule (X. Pan et al., "Spatial as deep: spatial CNN for traffic scene understanding", AAAI 2018): lanes are
drawn as stripes 30 pixels wide on an image of 1640, here scaled with the image width. Reports are matched one to one to
labels and are right above an IoU of 0.5; precision, recall and F1 are over the whole set.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from lanestream.road.curve import FloatArray
from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.samples.truth import columns_at

# The benchmarks ask for the ego lane and the adjacent lane on either side.
_MAX_POSITION: Final = 2

# How close to the horizon a boundary is submitted, as a share of the row offset at the bottom; above its `top` the
# curve is extrapolated. Chosen on the training split.
_MIN_ROW_OFFSET: Final = 0.05

TUSIMPLE_SIZE: Final = (1280, 720)
TUSIMPLE_ROWS: Final = np.arange(240.0, 711.0, 10.0)
TUSIMPLE_ABSENT: Final = -2.0
_TUSIMPLE_PIXELS: Final = 20.0
_TUSIMPLE_MATCHED: Final = 0.85
_TUSIMPLE_MAX_LABELS: Final = 4  # with more labels, the worst one is forgiven
_TUSIMPLE_MAX_EXTRA: Final = 2  # more extra reports than this void the frame
_TUSIMPLE_FAR_AWAY: Final = -100.0

CULANE_STRIPE: Final = 30.0 / 1640.0  # share of the image width
CULANE_MIN_IOU: Final = 0.5
_CULANE_ROWS: Final = 72


def submitted_columns(reports: Sequence[ReportedBoundary], rows: FloatArray, frame: LabeledFrame) -> list[FloatArray]:
    """Returns the columns (R,) at `rows` that a user would submit for each reported boundary, NaN where absent.

    Only the boundaries of the ego lane and of the adjacent lanes are submitted. Each extends from the image border,
    which may lie below its own `bottom`, to its `farthest` row or close to its horizon. In pixels of the image;
    boundaries outside the image are omitted.
    """
    lanes = []
    for report in reports:
        if abs(report.position) > _MAX_POSITION:
            continue
        horizon = report.curve.horizon
        nearly_horizon = horizon + _MIN_ROW_OFFSET * (frame.height - 1.0 - horizon)
        highest = nearly_horizon if report.farthest is None else report.farthest
        x = report.curve.x(rows)
        present = (rows >= highest) & (x >= 0.0) & (x <= frame.width - 1.0)
        if present.sum() >= 2:
            lanes.append(np.where(present, x, np.nan))
    return lanes


@dataclass(frozen=True)
class TuSimpleScore:
    """One frame by TuSimple's rule: accuracy, share of false reports, share of missed labels."""

    accuracy: float
    fp: float
    fn: float


def tusimple_frame(reports: Sequence[ReportedBoundary], frame: LabeledFrame) -> TuSimpleScore:
    """Scores a frame of any size, with its labels and reports scaled to 1280 x 720."""
    scale = np.array([TUSIMPLE_SIZE[0] / frame.width, TUSIMPLE_SIZE[1] / frame.height])
    rows = TUSIMPLE_ROWS / scale[1]
    labels = [np.nan_to_num(columns_at(lane, rows) * scale[0], nan=TUSIMPLE_ABSENT) for lane in frame.lanes]
    reported = [np.nan_to_num(x * scale[0], nan=TUSIMPLE_ABSENT) for x in submitted_columns(reports, rows, frame)]
    return tusimple_score(reported, labels, TUSIMPLE_ROWS)


def tusimple_score(reported: Sequence[FloatArray], labels: Sequence[FloatArray], rows: FloatArray) -> TuSimpleScore:
    """Scores one frame: columns of the reported lanes and of the labels at `rows` (R,), negative where absent.

    The rule's limit of 200 ms per frame is left out, so that the same file gives the same score on any machine.
    """
    if len(reported) > len(labels) + _TUSIMPLE_MAX_EXTRA:
        return TuSimpleScore(0.0, 0.0, 1.0)
    best = []
    for label in labels:
        threshold = _TUSIMPLE_PIXELS / np.cos(_angle(label, rows))
        best.append(max((_row_accuracy(lane, label, threshold) for lane in reported), default=0.0))
    matched = sum(accuracy >= _TUSIMPLE_MATCHED for accuracy in best)
    missed = len(labels) - matched
    total = sum(best)
    if len(labels) > _TUSIMPLE_MAX_LABELS:
        missed -= missed > 0
        total -= min(best)
    counted = max(min(_TUSIMPLE_MAX_LABELS, len(labels)), 1)
    fp = (len(reported) - matched) / len(reported) if reported else 0.0
    return TuSimpleScore(total / counted, fp, missed / counted)


def _angle(label: FloatArray, rows: FloatArray) -> float:
    """Returns the label's angle from the vertical, by a regression of its columns on its rows."""
    present = label >= 0.0
    if present.sum() < 2:
        return 0.0
    return float(np.arctan(np.polyfit(rows[present], label[present], 1)[0]))


def _row_accuracy(reported: FloatArray, label: FloatArray, threshold: float) -> float:
    """Returns the share of right rows; a row where both lanes are absent is right."""
    ours = np.where(reported >= 0.0, reported, _TUSIMPLE_FAR_AWAY)
    expected = np.where(label >= 0.0, label, _TUSIMPLE_FAR_AWAY)
    return float((np.abs(ours - expected) < threshold).mean())


@dataclass(frozen=True)
class CULaneCounts:
    """One frame by CULane's rule: right reports, wrong reports, missed labels."""

    tp: int
    fp: int
    fn: int


def culane_frame(reports: Sequence[ReportedBoundary], frame: LabeledFrame) -> CULaneCounts:
    """Counts the reported boundaries of a frame against its labels, drawn as stripes."""
    rows = np.linspace(0.0, frame.height - 1.0, _CULANE_ROWS + 1)
    columns = submitted_columns(reports, rows, frame)
    reported = [np.stack([x, rows], axis=1)[~np.isnan(x)] for x in columns]
    return culane_counts(reported, [lane.points for lane in frame.lanes], (frame.width, frame.height))


def culane_counts(reported: Sequence[FloatArray], labels: Sequence[FloatArray], size: tuple[int, int]) -> CULaneCounts:
    """Counts lanes given as points (N, 2) of an image of `size` (width, height), matched for the largest total IoU."""
    ours, theirs = [_stripe(lane, size) for lane in reported], [_stripe(lane, size) for lane in labels]
    ious = np.array([[_iou(stripe, label) for label in theirs] for stripe in ours])
    right = 0
    if ious.size:
        pairs = linear_sum_assignment(-ious)
        right = int((ious[pairs] > CULANE_MIN_IOU).sum())
    return CULaneCounts(right, len(reported) - right, len(labels) - right)


def _stripe(points: FloatArray, size: tuple[int, int]) -> Image:
    """Returns a mask (H, W) that is 1 on the stripe along the points."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    # Columns far outside the image would exceed the coordinate range of OpenCV's drawing.
    path = np.clip(points[np.argsort(points[:, 1])], -8.0 * width, 8.0 * width)
    thickness = max(1, round(CULANE_STRIPE * width))
    cv2.polylines(mask, [np.round(path).astype(np.int32)], isClosed=False, color=(1,), thickness=thickness)
    return mask


def _iou(one: Image, other: Image) -> float:
    union = int(cv2.countNonZero(one | other))
    return cv2.countNonZero(one & other) / union if union else 0.0
