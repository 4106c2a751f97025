"""What a candidate is by the labels of its frame: a marking, an edge of the road, nothing, or one of several.

Positions are in pixels of the labeled frame. A candidate follows a label if it is close to it over most of its rows. It
is nothing if it is far from every label, and left out of training in between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.proposals import is_long
from lanestream.road.appearance import BoundaryKind
from lanestream.road.curve import Curve, Curves, FloatArray
from lanestream.road.view import RoadView, Spans, visible_spans
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledLane, fitted_curve

# What a candidate may be, as bits: labels don't always decide. A candidate between a label and its surroundings is
# UNSURE: it is neither trained on nor counted.
NOTHING, MARKING, ROAD_EDGE = 1, 2, 4
UNSURE: Final = 0
UNKNOWN: Final = NOTHING | MARKING | ROAD_EDGE
_BITS: Final[dict[BoundaryKind | None, int]] = {"marking": MARKING, "road_edge": ROAD_EDGE, None: MARKING | ROAD_EDGE}

# Labels closer to the horizon than this share of the depth are guesses, and a candidate cannot follow them there.
_FARTHEST_LABEL: Final = 0.08


@dataclass(frozen=True)
class Verdicts:
    """What N candidates are: `kinds` (N,) has the bits of what each may be.

    `labels` (N,) are the indices of the labels that they follow, or -1.
    """

    kinds: NDArray[np.uint8]
    labels: NDArray[np.intp]

    @property
    def is_true(self) -> NDArray[np.bool_]:
        """Which candidates (N,) follow a label."""
        return self.labels >= 0

    @property
    def is_false(self) -> NDArray[np.bool_]:
        """Which candidates (N,) are certainly nothing."""
        return np.asarray(self.kinds == NOTHING)


@dataclass(frozen=True)
class TruthRule:
    """Decides what a candidate is. Distances are across the line, in pixels of a 1280 pixel wide image.

    A candidate follows a label if its mean distance is at most `near` over at least `overlap` of the label's rows. It
    is nothing if it is farther than `far` from every label, and unsure in between. Beyond the outermost label, on a
    side that is not fully labeled, it is unknown; it may be an edge of the road if edges are not labeled.
    """

    near: float = 12.0
    far: float = 30.0
    overlap: float = 0.6

    def judge(self, curves: Curves, spans: Spans, view: RoadView, frame: LabeledFrame) -> Verdicts:
        """Returns what each candidate (N,) is, given in pixels of `frame`."""
        kinds = _away_from_labels(curves, spans, frame)
        labels = np.full(len(curves), -1)
        nearest = np.full(len(curves), np.inf)
        measured = [_distances(curves, spans, view, lane, frame.width) for lane in frame.lanes]
        for distance, covered in measured:
            kinds[(distance <= self.far) & (covered > 0.0)] = UNSURE
        for index, (distance, covered) in enumerate(measured):
            follows = (distance <= self.near) & (covered >= self.overlap) & (distance < nearest)
            kinds[follows] = _BITS[frame.lanes[index].kind]
            labels[follows], nearest[follows] = index, distance[follows]
        return Verdicts(kinds, labels)

    def follows(self, curves: Curves, spans: Spans, view: RoadView, lane: LabeledLane, width: int) -> NDArray[np.bool_]:
        """Returns which candidates (N,) follow the label `lane` of a frame `width` pixels wide."""
        distance, covered = _distances(curves, spans, view, lane, width)
        return (distance <= self.near) & (covered >= self.overlap)


def columns_at(lane: LabeledLane, rows: FloatArray) -> FloatArray:
    """Returns the columns of a label at `rows`, in their shape; NaN outside its extent."""
    order = np.argsort(lane.points[:, 1], kind="stable")
    y, x = lane.points[order, 1], lane.points[order, 0]
    return np.asarray(np.interp(rows, y, x, left=np.nan, right=np.nan))


def fitted_candidate(lane: LabeledLane, view: RoadView) -> Curve | None:
    """Returns the best curve through a label under the view's horizon; None if too little of it is in view."""
    points = lane.points[lane.points[:, 1] > view.row_at(_FARTHEST_LABEL)]
    if len(points) < 3:
        return None
    curves = Curves.of([fitted_curve(points, view)])
    return curves[0] if is_long(curves, visible_spans(curves, view), view)[0] else None


def _distances(
    curves: Curves, spans: Spans, view: RoadView, lane: LabeledLane, width: int
) -> tuple[FloatArray, FloatArray]:
    """Returns the mean distances (N,) of candidates from a label, and the shares (N,) of its rows that they cover.

    Distances are across the line in pixels of a 1280 pixel wide image, infinite where no row is covered.
    """
    bottom = float(lane.points[:, 1].max())
    top = max(float(lane.points[:, 1].min()), view.row_at(_FARTHEST_LABEL))
    if bottom <= top:
        return np.full(len(curves), np.inf), np.zeros(len(curves))
    rows = np.linspace(top, bottom, 48)
    covered = (rows >= spans.top[:, None] - 1.0) & (rows <= spans.bottom[:, None] + 1.0)
    across = np.abs(curves.x(rows) - columns_at(lane, rows)) / np.hypot(1.0, curves.slope(rows))
    number = covered.sum(axis=1)
    mean = np.where(covered, across, 0.0).sum(axis=1) / np.maximum(number, 1)
    return np.where(number > 0, mean * 1280.0 / width, np.inf), number / len(rows)


def _away_from_labels(curves: Curves, spans: Spans, frame: LabeledFrame) -> NDArray[np.uint8]:
    """Returns what each candidate (N,) may be if it is far from every label.

    Between labels it is nothing. It is beyond the outermost label on a side if half of it is.
    """
    rows = spans.top[:, None] + (spans.bottom - spans.top)[:, None] * np.linspace(0.0, 1.0, 16)
    columns = curves.x(rows)
    left, right = np.full(rows.shape, np.inf), np.full(rows.shape, -np.inf)
    for lane in frame.lanes:
        x = columns_at(lane, rows)
        left, right = np.fmin(left, x), np.fmax(right, x)
    kinds = np.full(len(curves), NOTHING, np.uint8)
    # Rows without any label count as outside on both sides.
    for side, outside in ((-1, columns <= left), (1, columns >= right)):
        beyond = UNKNOWN if frame.open_to(side) else NOTHING if frame.coverage.edges else NOTHING | ROAD_EDGE
        kinds[outside.mean(axis=1) >= 0.5] |= beyond
    return kinds if frame.coverage.markings else np.asarray(kinds & ~np.uint8(MARKING), np.uint8)
