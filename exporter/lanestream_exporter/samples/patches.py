"""Turns candidates into labeled patches, which the classifier is trained and evaluated on.

Candidates and patches come from the service's own code, and are in pixels of working images. A candidate is true if it
follows a label over most of its rows, false if it is far from every label, and left out of training in between.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.features import paint_gray
from lanestream.detection.interface import FrameContext
from lanestream.detection.patches import cut_patches
from lanestream.detection.proposals import MOST_CANDIDATES, Proposals
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curve, Curves, FloatArray
from lanestream.road.view import Image, RoadView, Spans, visible_rows, visible_spans
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledLane, fitted_curve
from lanestream_exporter.samples.prior_regressor import PriorRegressor, no_regressor

FALSE, TRUE, UNSURE, UNKNOWN = 0, 1, 2, 3

# Labels closer to the horizon than this share of the depth are guesses, and a candidate cannot follow them there.
_FARTHEST_LABEL = 0.08

Patches = tuple[NDArray[np.uint8], NDArray[np.int64]]


@dataclass(frozen=True)
class TruthRule:
    """Decides whether a candidate is true. Distances are across the line, in pixels of a 1280 pixel wide image.

    A candidate is true if its mean distance is at most `near` over at least `overlap` of a label's rows, false if it is
    farther than `far` from every label, and unsure in between. Beyond the outermost label, on a side that is not fully
    labeled, it is unknown.
    """

    near: float = 12.0
    far: float = 30.0
    overlap: float = 0.6

    def judge(self, curves: Curves, spans: Spans, view: RoadView, frame: LabeledFrame) -> NDArray[np.int64]:
        """Returns FALSE, TRUE, UNSURE or UNKNOWN for each candidate (N,), given in pixels of `frame`."""
        verdicts = np.where(_beyond_labels(curves, spans, frame), UNKNOWN, FALSE)
        measured = [_distances(curves, spans, view, lane, frame.width) for lane in frame.lanes]
        for distance, covered in measured:
            verdicts[(distance <= self.far) & (covered > 0.0)] = UNSURE
        for distance, covered in measured:
            verdicts[(distance <= self.near) & (covered >= self.overlap)] = TRUE
        return verdicts

    def follows(self, curves: Curves, spans: Spans, view: RoadView, lane: LabeledLane, width: int) -> NDArray[np.bool_]:
        """Returns which candidates (N,) are true to the label `lane` of a frame `width` pixels wide."""
        distance, covered = _distances(curves, spans, view, lane, width)
        return (distance <= self.near) & (covered >= self.overlap)


def columns_at(lane: LabeledLane, rows: FloatArray) -> FloatArray:
    """Returns the columns of a label at `rows`, in their shape; NaN outside its extent."""
    order = np.argsort(lane.points[:, 1], kind="stable")
    y, x = lane.points[order, 1], lane.points[order, 0]
    return np.asarray(np.interp(rows, y, x, left=np.nan, right=np.nan))


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


def _beyond_labels(curves: Curves, spans: Spans, frame: LabeledFrame) -> NDArray[np.bool_]:
    """Returns whether half of each candidate (N,) lies outside the outermost label on an open side."""
    rows = spans.top[:, None] + (spans.bottom - spans.top)[:, None] * np.linspace(0.0, 1.0, 16)
    columns = curves.x(rows)
    left, right = np.full(rows.shape, np.inf), np.full(rows.shape, -np.inf)
    for lane in frame.lanes:
        x = columns_at(lane, rows)
        left, right = np.fmin(left, x), np.fmax(right, x)
    beyond = np.zeros(len(curves), bool)
    # Rows without any label count as outside on both sides.
    for side, outside in ((-1, columns <= left), (1, columns >= right)):
        if frame.open_to(side):
            beyond |= outside.mean(axis=1) >= 0.5
    return beyond


def fitted_candidate(lane: LabeledLane, view: RoadView) -> Curve | None:
    """Returns the best curve through a label under the view's horizon; None if too little of it is in view."""
    points = lane.points[lane.points[:, 1] > view.row_at(_FARTHEST_LABEL)]
    if len(points) < 3:
        return None
    curve = fitted_curve(points, view)
    rows = visible_rows(curve, view)
    return None if rows is None or rows[1] - rows[0] < 0.15 * view.depth else curve


class PatchMaker:
    """Cuts labeled patches from working images, at most `limit` of a frame's candidates.

    Candidates are proposed with the ego-lane prior of `prior`, if given.
    """

    def __init__(
        self, geometry: PatchGeometry, prior: PriorRegressor | None = None, limit: int = MOST_CANDIDATES
    ) -> None:
        # The threshold decides nothing here: patches of all candidates are cut.
        self._detector = CandidateDetector(0.5, geometry, None if prior is None else prior.regressor)
        self._infer = no_regressor if prior is None else prior.infer
        self._limit = limit

    def propose(self, image: Image) -> Proposals:
        """Returns the candidates of a BGR working image with an unknown horizon, as of a stream's first frame."""
        return self._detector.propose(image, paint_gray(image), FrameContext(), self._infer, self._limit)

    def proposed(self, image: Image, frame: LabeledFrame, proposals: Proposals) -> Patches:
        """Returns patches (N, size, size, 3) of the proposed candidates, and the verdict on each (N,)."""
        return self._labeled(image, frame, proposals.curves, proposals.spans, proposals.view)

    def jittered(self, image: Image, frame: LabeledFrame, view: RoadView, rng: np.random.Generator) -> Patches:
        """Returns patches near each label, as close as good candidates and too far off, and the verdict on each."""
        curves = [
            _shifted(fitted, view, shift)
            for lane in frame.lanes
            if (fitted := fitted_candidate(lane, view)) is not None
            for shift in _shifts(rng)
        ]
        batch = Curves.of(curves) if curves else Curves.none(view.horizon)
        spans = visible_spans(batch, view)
        return self._labeled(image, frame, batch.take(spans.visible), spans.take(spans.visible), view)

    def all_of(
        self, image: Image, frame: LabeledFrame, view: RoadView, rng: np.random.Generator
    ) -> Iterator[tuple[NDArray[np.uint8], int]]:
        """Yields the patches of a frame, proposed and jittered, that are clearly true or false."""
        proposed = self.proposed(image, frame, self.propose(image))
        for patches, verdicts in (proposed, self.jittered(image, frame, view, rng)):
            for patch, verdict in zip(patches, verdicts, strict=True):
                if verdict in (FALSE, TRUE):
                    yield patch, int(verdict)

    def _labeled(self, image: Image, frame: LabeledFrame, curves: Curves, spans: Spans, view: RoadView) -> Patches:
        verdicts = TruthRule().judge(curves, spans, view, frame)
        return cut_patches(image, curves, spans, view, self._detector.patch), verdicts


@dataclass(frozen=True)
class _Shift:
    """A candidate's error, as shares of the rows below the horizon; `near` and `far` are sideways, `far` halfway up."""

    near: float
    far: float
    curvature: float


def _shifts(rng: np.random.Generator) -> list[_Shift]:
    """Returns a shift of the size of a good candidate's error, and one that leaves the marking."""
    near, far = rng.normal(0.0, 0.02, 2)
    beyond = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.45)
    return [_Shift(near, far, rng.normal(0.0, 0.003)), _Shift(beyond + near, beyond + far, rng.normal(0.0, 0.003))]


def _shifted(curve: Curve, view: RoadView, shift: _Shift) -> Curve:
    """Returns the curve moved by `shift`. An oblique one moves farther, because its patch is wider."""
    v, b, k = curve.coefficients
    obliquity = float(np.hypot(1.0, b))
    near, far = obliquity * shift.near * view.depth, obliquity * shift.far * 0.5 * view.depth
    tilt = (near - far) / (0.5 * view.depth)
    curvature = shift.curvature * view.depth**2
    return Curve(curve.horizon, (v + near - tilt * view.depth, b + tilt, k + curvature))
