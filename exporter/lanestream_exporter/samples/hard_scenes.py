"""Hard scenes: those on which the two detectors disagree, so that at least one of them is wrong.

Training on more of these teaches more than training on more scenes that both detectors already know. Source of the
idea: query by committee, H. Seung, M. Opper and H. Sompolinsky, 1992.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.interface import Detections, FrameContext, ModelRole
from lanestream.detection.regression_detector import RegressionDetector
from lanestream.errors import ModelError
from lanestream.images.resizing import working_image
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import ClassifierInfo
from lanestream.inference.providers import RuntimeOptions
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView
from lanestream_exporter.samples.prior_regressor import PriorRegressor, load_prior_regressor

# Boundaries farther apart than this, in row offsets, at one of these shares of the depth are different.
_FARTHEST: Final = 0.15
_COMPARED: Final = np.array([0.4, 0.9])


@dataclass(frozen=True)
class Committee:
    """The files of a classifier and of the regressor that gives it its prior: both detectors use them."""

    classifier: Path
    regressor: Path

    @property
    def digest(self) -> str:
        """A hash of both files."""
        digest = hashlib.sha256(self.classifier.read_bytes() + self.regressor.read_bytes())
        return digest.hexdigest()[:8]

    def load(self) -> Disagreement:
        """Loads both files on one CPU thread. Raises ModelError for other files."""
        model = load_model(self.classifier, "cpu", RuntimeOptions(threads=1))
        if not isinstance(model.info, ClassifierInfo):
            raise ModelError(f"{self.classifier} is not a classifier", "give a classifier's ONNX file")
        prior = load_prior_regressor(self.regressor)
        candidates = CandidateDetector(model.info.threshold, model.info.patch, prior.regressor)
        return Disagreement(candidates, RegressionDetector(prior.regressor), model, prior)


@dataclass(frozen=True)
class Disagreement:
    """Finds images on which the detectors `candidates` and `regression` report different ego lanes."""

    candidates: CandidateDetector
    regression: RegressionDetector
    classifier: LoadedModel
    prior: PriorRegressor

    def about(self, image: Image) -> bool:
        """Returns whether the detectors disagree about a BGR image (H, W, 3)."""
        working, _ = working_image(image)
        one, other = (
            detector.detect(working, FrameContext(), self._infer) for detector in (self.candidates, self.regression)
        )
        pairs = zip(ego_boundaries(one), ego_boundaries(other), strict=True)
        return any(_differ(mine, theirs, one.view) for mine, theirs in pairs)

    def _infer(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self.classifier.run(inputs) if role == "classifier" else self.prior.infer(role, inputs)


def ego_boundaries(found: Detections) -> tuple[Detection | None, Detection | None]:
    """Returns the nearest boundaries left and right of the middle of the lowest row."""
    view = found.view
    left: Sequence[Detection] = [each for each in found.boundaries if float(each.curve.x(view.bottom)) < view.middle]
    right = found.boundaries[len(left) :]
    return left[-1] if left else None, right[0] if right else None


def _differ(first: Detection | None, second: Detection | None, view: RoadView) -> bool:
    """Returns whether two detections of one side are different boundaries, or of different kinds."""
    if first is None or second is None:
        return first is not second
    below = _COMPARED * view.depth
    apart = np.abs(first.curve.x(view.horizon + below) - second.curve.x(view.horizon + below)) / below
    return bool((apart > _FARTHEST).any()) or first.appearance.kind != second.appearance.kind
