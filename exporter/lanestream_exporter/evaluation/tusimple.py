"""TuSimple's metric, as the benchmark's published rule computes it (github.com/TuSimple/tusimple-benchmark, lane.py).

Lanes are columns at fixed rows of a 1280 x 720 image, negative where they are absent. A row is right where the columns
are less than 20 px / cos(the label's angle) apart, or where both are absent; a label's accuracy is the share of right
rows of whichever report suits it best, so that one report may serve two labels. From 0.85 on the label counts as found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.boundaries import Found
from lanestream_exporter.evaluation.reported import reported_columns
from lanestream_exporter.samples.patches import columns_at

SIZE: Final = (1280, 720)
ROWS: Final = np.arange(240.0, 711.0, 10.0)
ABSENT: Final = -2.0

_PIXELS, _SHARE = 20.0, 0.85
_COUNTED = 4  # labels beyond so many don't count
_TOO_MANY = 2  # reports beyond the number of labels that void the frame
_NOWHERE = -100.0


@dataclass(frozen=True)
class FrameScore:
    """One frame by the official rule: accuracy, share of false reports, share of missed labels."""

    accuracy: float
    fp: float
    fn: float


def score(reported: Sequence[FloatArray], labels: Sequence[FloatArray], rows: FloatArray) -> FrameScore:
    """One frame: columns of the reported lanes and of the labels at `rows` (R,), negative where absent.

    The rule's limit of 200 ms a frame is left out: the same file must give the same figure on any machine.
    """
    if len(reported) > len(labels) + _TOO_MANY:
        return FrameScore(0.0, 0.0, 1.0)
    best = [
        max((_accuracy(lane, label, _PIXELS / np.cos(_angle(label, rows))) for lane in reported), default=0.0)
        for label in labels
    ]
    matched = sum(accuracy >= _SHARE for accuracy in best)
    missed = len(labels) - matched
    total = sum(best)
    if len(labels) > _COUNTED:
        missed -= missed > 0
        total -= min(best)
    counted = max(min(_COUNTED, len(labels)), 1)
    fp = (len(reported) - matched) / len(reported) if reported else 0.0
    return FrameScore(total / counted, fp, missed / counted)


def score_frame(found: Sequence[Found], frame: LabelledFrame) -> FrameScore:
    """A frame of any size, its labels and reports scaled to 1280 x 720."""
    scale = np.array([SIZE[0] / frame.width, SIZE[1] / frame.height])
    rows = ROWS / scale[1]
    labels = [np.nan_to_num(columns_at(lane, rows) * scale[0], nan=ABSENT) for lane in frame.lanes]
    reported = [np.nan_to_num(x * scale[0], nan=ABSENT) for x in reported_columns(found, rows, frame)]
    return score(reported, labels, ROWS)


def _angle(label: FloatArray, rows: FloatArray) -> float:
    """The label's angle from the vertical, by a regression of its columns on its rows."""
    present = label >= 0.0
    if present.sum() < 2:
        return 0.0
    return float(np.arctan(np.polyfit(rows[present], label[present], 1)[0]))


def _accuracy(reported: FloatArray, label: FloatArray, threshold: float) -> float:
    there = np.where(reported >= 0.0, reported, _NOWHERE)
    wanted = np.where(label >= 0.0, label, _NOWHERE)
    return float((np.abs(there - wanted) < threshold).mean())
