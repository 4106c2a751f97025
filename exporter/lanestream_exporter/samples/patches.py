"""Turns candidates into labeled patches, which the classifier is trained and evaluated on.

Candidates and patches come from the service's own code. A candidate is true if it follows a label over most of its
rows, false if it is far from every label, and left out of training in between.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import answered
from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.detection.patches import PatchCutter
from lanestream.detection.proposals import CandidateSearch, Proposals
from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import Candidate
from lanestream.road.view import Image, RoadView, visible_rows
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane, fitted_curve

FALSE, TRUE, UNSURE, UNKNOWN = 0, 1, 2, 3


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

    def judge(self, candidates: Sequence[Candidate], frame: LabelledFrame, view: RoadView) -> NDArray[np.int64]:
        """Returns FALSE, TRUE, UNSURE or UNKNOWN for each candidate (N,)."""
        return np.array([self._judge(candidate, frame, view) for candidate in candidates], dtype=np.int64)

    def _judge(self, candidate: Candidate, frame: LabelledFrame, view: RoadView) -> int:
        scale = 1280.0 / frame.width
        measured = [distance_along(candidate, lane, view) for lane in frame.lanes]
        if any(distance * scale <= self.near and overlap >= self.overlap for distance, overlap in measured):
            return TRUE
        if any(distance * scale <= self.far and overlap > 0.0 for distance, overlap in measured):
            return UNSURE
        return UNKNOWN if self._beyond(candidate, frame) else FALSE

    def _beyond(self, candidate: Candidate, frame: LabelledFrame) -> bool:
        """Whether half of the candidate lies outside the outermost label on an open side."""
        rows = np.linspace(candidate.top, candidate.bottom, 16)
        columns = candidate.curve.x(rows)
        left, right = np.full(len(rows), np.inf), np.full(len(rows), -np.inf)
        for lane in frame.lanes:
            x = columns_at(lane, rows)
            left, right = np.fmin(left, x), np.fmax(right, x)
        # Rows without any label count as outside on both sides.
        return any(
            frame.open_to(side) and outside.mean() >= 0.5
            for side, outside in ((-1, columns <= left), (1, columns >= right))
        )


def columns_at(lane: LabelledLane, rows: FloatArray) -> FloatArray:
    """Returns the columns of a label at `rows`, NaN outside its extent."""
    order = np.argsort(lane.points[:, 1], kind="stable")
    y, x = lane.points[order, 1], lane.points[order, 0]
    return np.asarray(np.interp(rows, y, x, left=np.nan, right=np.nan))


def distance_along(candidate: Candidate, lane: LabelledLane, view: RoadView) -> tuple[float, float]:
    """Returns (mean distance across the line in pixels, share of the label's rows that the candidate covers)."""
    top, bottom = float(lane.points[:, 1].min()), float(lane.points[:, 1].max())
    # Labels near or above the horizon are guesses, and a candidate can't follow them there.
    top = max(top, view.row_at(0.08))
    rows = np.linspace(top, bottom, 48) if bottom > top else np.zeros(0)
    covered = rows[(rows >= candidate.top - 1.0) & (rows <= candidate.bottom + 1.0)]
    if not len(covered):
        return np.inf, 0.0
    across = np.abs(candidate.curve.x(covered) - columns_at(lane, covered))
    return float(np.mean(across / np.hypot(1.0, candidate.curve.slope(covered)))), len(covered) / len(rows)


def fitted_candidate(lane: LabelledLane, view: RoadView) -> Candidate | None:
    """Returns the best curve through a label under the view's horizon; None if too little of it is in view."""
    points = lane.points[lane.points[:, 1] > view.row_at(0.08)]
    if len(points) < 3:
        return None
    curve = fitted_curve(points, view)
    rows = visible_rows(curve, view, 0.1)
    if rows is None or rows[1] - rows[0] < 0.15 * view.depth:
        return None
    return Candidate(curve, rows[0], rows[1], 1.0)


@dataclass(frozen=True)
class PatchMaker:
    """Cuts labeled patches from frames; candidates are proposed with the ego-lane prior, if there is an estimator."""

    search: CandidateSearch = CandidateSearch()
    cutter: PatchCutter = PatchCutter()
    rule: TruthRule = TruthRule()
    prior_estimator: EgoPriorEstimator | None = None

    def propose(self, image: Image) -> Proposals:
        """Returns the candidates of a BGR image (H, W, 3) with an unknown horizon."""
        prior = None if self.prior_estimator is None else answered(self.prior_estimator.look(image))
        return self.search.propose(image, prior=prior)

    def proposed(
        self, image: Image, frame: LabelledFrame, proposals: Proposals
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Returns patches (N, size, size, 3) of the proposed candidates, and the verdict on each (N,)."""
        verdicts = self.rule.judge(proposals.candidates, frame, proposals.view)
        return self.cutter.cut(image, proposals.candidates, proposals.view), verdicts

    def jittered(
        self, image: Image, frame: LabelledFrame, view: RoadView, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Returns patches near each label, as close as good candidates and too far off, and the verdict on each."""
        candidates: list[Candidate] = []
        for lane in frame.lanes:
            fitted = fitted_candidate(lane, view)
            if fitted is not None:
                candidates += [_shifted(fitted, view, shift) for shift in _shifts(rng)]
        verdicts = self.rule.judge(candidates, frame, view)
        return self.cutter.cut(image, candidates, view), verdicts

    def all_of(
        self, image: Image, frame: LabelledFrame, view: RoadView, rng: np.random.Generator
    ) -> Iterator[tuple[NDArray[np.uint8], int]]:
        """Yields the patches of a frame, proposed and jittered, that are clearly true or false."""
        proposed = self.proposed(image, frame, self.propose(image))
        for patches, verdicts in (proposed, self.jittered(image, frame, view, rng)):
            for patch, verdict in zip(patches, verdicts, strict=True):
                if verdict in (FALSE, TRUE):
                    yield patch, int(verdict)


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


def _shifted(candidate: Candidate, view: RoadView, shift: _Shift) -> Candidate:
    """Returns the candidate moved by `shift`. An oblique one moves farther, because its patch is wider."""
    v, b, k = candidate.curve.coefficients
    obliquity = float(np.hypot(1.0, b))
    near, far = obliquity * shift.near * view.depth, obliquity * shift.far * 0.5 * view.depth
    tilt = (near - far) / (0.5 * view.depth)
    curvature = shift.curvature * view.depth**2
    curve = Curve(candidate.curve.horizon, (v + near - tilt * view.depth, b + tilt, k + curvature))
    rows = visible_rows(curve, view, 0.1)
    top, bottom = rows if rows is not None else (candidate.top, candidate.bottom)
    return Candidate(curve, top, bottom, candidate.strength)
