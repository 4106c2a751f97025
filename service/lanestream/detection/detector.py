"""The default detector: candidates, a patch for each, the classifier's word, refinement of what it accepts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Prepared
from lanestream.detection.candidates import TOP_SHARE, CandidateSearch
from lanestream.detection.refinement import Refinement
from lanestream.detection.strips import StripCutter
from lanestream.geometry import RoadView, visible_rows
from lanestream.lanes import Curve, Detection, Image

TRUE_LANE = 1


@dataclass(frozen=True)
class CandidateDetector:
    """Finds boundaries by proposing many and letting the classifier choose.

    A candidate is accepted from the probability `threshold` on. Two accepted boundaries nearer than `separation` times
    the rows below the horizon, at either of two rows, are one marking, or cross: the more probable one stays.
    """

    threshold: float = 0.5
    search: CandidateSearch = CandidateSearch()
    cutter: StripCutter = StripCutter()
    refinement: Refinement = Refinement()
    separation: float = 0.8

    def prepare(self, image: Image, horizon: float | None = None, expected: Sequence[Curve] = ()) -> Prepared:
        """Patches of the candidates of a BGR image (H, W, 3) uint8; `horizon` is about its row, where known."""
        proposals = self.search.propose(image, horizon, expected)
        patches = self.cutter.cut(image, proposals.candidates, proposals.view)
        return Prepared(image, patches, proposals.view, proposals.candidates, proposals.weight)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> list[Detection]:
        """Detections from the classifier's probabilities (N, 2) for the patches of `prepare`, left to right."""
        probability = outputs[:, TRUE_LANE]
        order = [int(i) for i in np.argsort(-probability, kind="stable") if probability[i] >= self.threshold]
        chosen = [prepared.candidates[i] for i in order]
        fits = self.refinement.refine(prepared.image, chosen, prepared.view)
        detections = []
        for index, fit in zip(order, fits, strict=True):
            rows = visible_rows(fit.curve, prepared.view, TOP_SHARE)
            if rows is not None:
                detections.append(Detection(fit.curve, fit.covariance, *rows, float(probability[index])))
        return sorted(self._apart(detections, prepared.view), key=lambda d: float(d.curve.x(prepared.view.bottom)))

    def _apart(self, detections: Sequence[Detection], view: RoadView) -> list[Detection]:
        """The detections, most probable first, that keep their distance from all better ones."""
        kept: list[Detection] = []
        for detection in detections:
            if all(self._distance(detection, other, view) > self.separation for other in kept):
                kept.append(detection)
        return kept

    def _distance(self, one: Detection, other: Detection, view: RoadView) -> float:
        """How far apart two boundaries are where they are nearest, over the rows below the horizon; 0 if they cross."""
        rows = np.array([view.row_at(0.25), view.row_at(0.5), view.row_at(1.0)])
        gap = (one.curve.x(rows) - other.curve.x(rows)) / (rows - view.horizon)
        return 0.0 if gap.min() < 0.0 < gap.max() else float(np.abs(gap).min())
