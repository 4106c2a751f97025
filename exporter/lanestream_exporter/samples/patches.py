"""Turns candidates into labeled patches, which the classifier is trained and evaluated on.

Candidates and patches come from the service's own code, and are in pixels of working images.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.interface import FrameContext
from lanestream.detection.patches import cut_patches
from lanestream.detection.proposals import MOST_CANDIDATES, Proposals
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import Image, RoadView, Spans, visible_spans
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.samples.prior_regressor import PriorRegressor, no_regressor
from lanestream_exporter.samples.truth import UNKNOWN, UNSURE, TruthRule, fitted_candidate

# An unknown type or color in `Patches.targets`.
NOT_KNOWN: Final = -1
_TYPES: Final[dict[str | None, int]] = {name: index for index, name in enumerate(MARKING_TYPES)}
_COLORS: Final[dict[str | None, int]] = {name: index for index, name in enumerate(MARKING_COLORS)}


@dataclass(frozen=True)
class Patches:
    """Labeled patches: `pixels` (N, size, size, 3) uint8 in RGB, and `targets` (N, 3) int8.

    The targets are what a patch may show (bits of `truth`), the index of its marking's type in MARKING_TYPES and that
    of its color in MARKING_COLORS, or NOT_KNOWN.
    """

    pixels: NDArray[np.uint8]
    targets: NDArray[np.int8]

    @property
    def known(self) -> Patches:
        """Those that teach something: what they show is neither unsure nor entirely unknown."""
        kept = (self.targets[:, 0] != UNSURE) & (self.targets[:, 0] != UNKNOWN)
        return Patches(self.pixels[kept], self.targets[kept])


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
        return self._detector.propose(image, FrameContext(), self._infer, self._limit)

    def proposed(self, image: Image, frame: LabeledFrame, proposals: Proposals) -> Patches:
        """Returns patches of the proposed candidates."""
        return self._labeled(image, frame, proposals.curves, proposals.spans, proposals.view)

    def jittered(self, image: Image, frame: LabeledFrame, view: RoadView, rng: np.random.Generator) -> Patches:
        """Returns patches near each label, as close as good candidates and too far off."""
        curves = [
            _shifted(fitted, view, shift)
            for lane in frame.lanes
            if (fitted := fitted_candidate(lane, view)) is not None
            for shift in _shifts(rng)
        ]
        batch = Curves.of(curves) if curves else Curves.none(view.horizon)
        spans = visible_spans(batch, view)
        return self._labeled(image, frame, batch.take(spans.visible), spans.take(spans.visible), view)

    def all_of(self, image: Image, frame: LabeledFrame, view: RoadView, rng: np.random.Generator) -> Iterator[Patches]:
        """Yields the patches of a frame, proposed and jittered, that teach something."""
        yield self.proposed(image, frame, self.propose(image)).known
        yield self.jittered(image, frame, view, rng).known

    def _labeled(self, image: Image, frame: LabeledFrame, curves: Curves, spans: Spans, view: RoadView) -> Patches:
        verdicts = TruthRule().judge(curves, spans, view, frame)
        targets = np.full((len(curves), 3), NOT_KNOWN, np.int8)
        targets[:, 0] = verdicts.kinds
        for index in np.flatnonzero(verdicts.is_true).tolist():
            lane = frame.lanes[int(verdicts.labels[index])]
            targets[index, 1:] = _TYPES.get(lane.type, NOT_KNOWN), _COLORS.get(lane.color, NOT_KNOWN)
        return Patches(cut_patches(image, curves, spans, view, self._detector.patch), targets)


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
