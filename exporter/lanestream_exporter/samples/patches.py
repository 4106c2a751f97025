"""Candidates to labelled patches: what the classifier is trained and measured on.

Candidates and strips come from the service's own code. A candidate is true where it follows a label over most of it,
false where it is far from every label, and left out of training in between, where nobody could say.
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
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.datasets.polylines import fitted_curve

FALSE, TRUE, UNSURE, UNKNOWN = 0, 1, 2, 3


@dataclass(frozen=True)
class TruthRule:
    """When a candidate is true: distances across the line, in pixels of a 1280 pixel wide image.

    True up to `near` on average over at least `overlap` of a label's rows, false beyond `far` from every label, unsure
    in between. Beyond the outermost label, on a side where not all is labelled, it is unknown.
    """

    near: float = 12.0
    far: float = 30.0
    overlap: float = 0.6

    def judge(self, candidates: Sequence[Candidate], frame: LabelledFrame, view: RoadView) -> NDArray[np.int64]:
        """FALSE, TRUE, UNSURE or UNKNOWN for each candidate (N,)."""
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
        """Whether half of the candidate lies beside the outermost label of a side that is open."""
        rows = np.linspace(candidate.top, candidate.bottom, 16)
        columns = candidate.curve.x(rows)
        left, right = np.full(len(rows), np.inf), np.full(len(rows), -np.inf)
        for lane in frame.lanes:
            x = columns_at(lane, rows)
            left, right = np.fmin(left, x), np.fmax(right, x)
        # Rows without any label count for both sides.
        return any(
            frame.open_to(side) and beside.mean() >= 0.5
            for side, beside in ((-1, columns <= left), (1, columns >= right))
        )


def columns_at(lane: LabelledLane, rows: FloatArray) -> FloatArray:
    """Columns of a label at `rows`, NaN outside its extent."""
    order = np.argsort(lane.points[:, 1], kind="stable")
    y, x = lane.points[order, 1], lane.points[order, 0]
    return np.asarray(np.interp(rows, y, x, left=np.nan, right=np.nan))


def distance_along(candidate: Candidate, lane: LabelledLane, view: RoadView) -> tuple[float, float]:
    """(mean distance across the line in pixels, share of the label's rows that the candidate covers)."""
    top, bottom = float(lane.points[:, 1].min()), float(lane.points[:, 1].max())
    # Labels that reach to the horizon and above do so by guess; a candidate can't follow them there.
    top = max(top, view.row_at(0.08))
    rows = np.linspace(top, bottom, 48) if bottom > top else np.zeros(0)
    covered = rows[(rows >= candidate.top - 1.0) & (rows <= candidate.bottom + 1.0)]
    if not len(covered):
        return np.inf, 0.0
    across = np.abs(candidate.curve.x(covered) - columns_at(lane, covered))
    return float(np.mean(across / np.hypot(1.0, candidate.curve.slope(covered)))), len(covered) / len(rows)


def fitted_candidate(lane: LabelledLane, view: RoadView) -> Candidate | None:
    """A label as a candidate: the best curve under the view's horizon; None where too little of it is in view."""
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
    """Frames to patches and their labels; candidates are proposed with a `glance` at the frame, where there is one."""

    search: CandidateSearch = CandidateSearch()
    cutter: PatchCutter = PatchCutter()
    rule: TruthRule = TruthRule()
    glance: EgoPriorEstimator | None = None

    def propose(self, image: Image) -> Proposals:
        """The candidates of a BGR image (H, W, 3) of which nothing is known."""
        prior = None if self.glance is None else answered(self.glance.look(image))
        return self.search.propose(image, prior=prior)

    def proposed(
        self, image: Image, frame: LabelledFrame, proposals: Proposals
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Patches (N, size, size, 3) of the frame's own candidates, and what each is (N,)."""
        verdicts = self.rule.judge(proposals.candidates, frame, proposals.view)
        return self.cutter.cut(image, proposals.candidates, proposals.view), verdicts

    def jittered(
        self, image: Image, frame: LabelledFrame, view: RoadView, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Patches beside each label: as a candidate would err, and as far off as a candidate must not be."""
        candidates: list[Candidate] = []
        for lane in frame.lanes:
            fitted = fitted_candidate(lane, view)
            if fitted is not None:
                candidates += [_moved(fitted, view, shift) for shift in _shifts(rng)]
        verdicts = self.rule.judge(candidates, frame, view)
        return self.cutter.cut(image, candidates, view), verdicts

    def all_of(
        self, image: Image, frame: LabelledFrame, view: RoadView, rng: np.random.Generator
    ) -> Iterator[tuple[NDArray[np.uint8], int]]:
        """Trainable patches of a frame one by one: proposed and jittered ones that are clearly true or false."""
        proposed = self.proposed(image, frame, self.propose(image))
        for patches, verdicts in (proposed, self.jittered(image, frame, view, rng)):
            for patch, verdict in zip(patches, verdicts, strict=True):
                if verdict in (FALSE, TRUE):
                    yield patch, int(verdict)


@dataclass(frozen=True)
class _Shift:
    """How a candidate errs: sideways in rows below the horizon at the bottom and half way up, and in its bend."""

    near: float
    far: float
    bend: float


def _shifts(rng: np.random.Generator) -> list[_Shift]:
    """One small as a candidate's error, one beyond the true marking."""
    near, far = rng.normal(0.0, 0.02, 2)
    beyond = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.45)
    return [_Shift(near, far, rng.normal(0.0, 0.003)), _Shift(beyond + near, beyond + far, rng.normal(0.0, 0.003))]


def _moved(candidate: Candidate, view: RoadView, shift: _Shift) -> Candidate:
    """The candidate moved by `shift`, a leaning one farther, as its strip is wider and its error counts less."""
    v, b, k = candidate.curve.coefficients
    leaning = float(np.hypot(1.0, b))
    near, far = leaning * shift.near * view.depth, leaning * shift.far * 0.5 * view.depth
    tilt = (near - far) / (0.5 * view.depth)
    bend = shift.bend * view.depth**2
    curve = Curve(candidate.curve.horizon, (v + near - tilt * view.depth, b + tilt, k + bend))
    rows = visible_rows(curve, view, 0.1)
    top, bottom = rows if rows is not None else (candidate.top, candidate.bottom)
    return Candidate(curve, top, bottom, candidate.strength)
