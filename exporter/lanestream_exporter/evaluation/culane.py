"""CULane's metric: lanes drawn as wide stripes, one report to one label, right from an overlap of one half on.

After X. Pan et al., "Spatial as deep: spatial CNN for traffic scene understanding", AAAI 2018: 30 pixels wide on an
image of 1640, here scaled with the width; precision, recall and F1 over the whole set.
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
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.boundaries import Found
from lanestream_exporter.evaluation.reported import reported_columns

STRIPE: Final = 30.0 / 1640.0
LEAST: Final = 0.5
_ROWS = 72


@dataclass(frozen=True)
class FrameCounts:
    """One frame: right reports, wrong reports, missed labels."""

    tp: int
    fp: int
    fn: int


def count_frame(found: Sequence[Found], frame: LabelledFrame) -> FrameCounts:
    """The reported boundaries of a frame against its labels, as stripes."""
    rows = np.linspace(0.0, frame.height - 1.0, _ROWS + 1)
    columns = reported_columns(found, rows, frame)
    reported = [np.stack([x, rows], axis=1)[~np.isnan(x)] for x in columns]
    return count(reported, [lane.points for lane in frame.lanes], (frame.width, frame.height))


def count(reported: Sequence[FloatArray], labels: Sequence[FloatArray], size: tuple[int, int]) -> FrameCounts:
    """Lanes as points (N, 2) of an image of `size` (width, height) pixels, matched so that the overlap is largest."""
    ours, theirs = [_stripe(lane, size) for lane in reported], [_stripe(lane, size) for lane in labels]
    overlaps = np.array([[_overlap(mine, label) for label in theirs] for mine in ours])
    right = 0
    if overlaps.size:
        pairs = linear_sum_assignment(-overlaps)
        right = int((overlaps[pairs] > LEAST).sum())
    return FrameCounts(right, len(reported) - right, len(labels) - right)


def _stripe(points: FloatArray, size: tuple[int, int]) -> Image:
    """A mask (H, W): 1 on the stripe along the points."""
    width, height = size
    mask = np.zeros((height, width), np.uint8)
    # Columns far outside would leave the range that lines are drawn in.
    path = np.clip(points[np.argsort(points[:, 1])], -8.0 * width, 8.0 * width)
    cv2.polylines(mask, [np.round(path).astype(np.int32)], isClosed=False, color=(1,), thickness=_thickness(width))
    return mask


def _thickness(width: int) -> int:
    return max(1, round(STRIPE * width))


def _overlap(one: Image, other: Image) -> float:
    union = int(cv2.countNonZero(one | other))
    return cv2.countNonZero(one & other) / union if union else 0.0
