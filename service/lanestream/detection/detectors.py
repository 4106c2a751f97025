"""The table of detectors. To add one, write its module, add a row here and its name to `lanestream.protocol`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from lanestream.detection.acceptance import SHIPPED
from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.ego_prior import RoadRegressor
from lanestream.detection.interface import Detector, ModelRole
from lanestream.detection.regression_detector import RegressionDetector
from lanestream.road.crops import PatchGeometry, RoadCropGeometry


class ClassifierDescription(Protocol):
    """The part of a classifier's description that its detector needs."""

    @property
    def threshold(self) -> float:
        """The probability from which a candidate is accepted."""

    @property
    def patch(self) -> PatchGeometry:
        """The patches that it was trained on."""


class RegressorDescription(Protocol):
    """The part of a regressor's description that its detector needs."""

    @property
    def threshold(self) -> float:
        """The presence from which a boundary is reported."""

    @property
    def road_crop(self) -> RoadCropGeometry:
        """The road crops that it was trained on."""


@dataclass(frozen=True)
class ModelDescriptions:
    """The descriptions of the loaded models by their roles; None for those that are not loaded."""

    classifier: ClassifierDescription | None = None
    regressor: RegressorDescription | None = None


@dataclass(frozen=True)
class DetectorSpec:
    """A detector: the name by which users request it, the model that it requires, and how to build it.

    `build` returns None if that model is not loaded.
    """

    name: str
    model: ModelRole
    build: Callable[[ModelDescriptions], Detector | None]


def _candidates(models: ModelDescriptions) -> Detector | None:
    classifier, regressor = models.classifier, models.regressor
    if classifier is None:
        return None
    prior = None if regressor is None else RoadRegressor(regressor.threshold, regressor.road_crop)
    return CandidateDetector(classifier.threshold, classifier.patch, prior, SHIPPED)


def _regression(models: ModelDescriptions) -> Detector | None:
    regressor = models.regressor
    return None if regressor is None else RegressionDetector(RoadRegressor(regressor.threshold, regressor.road_crop))


# The first one whose model is loaded is the default.
DETECTORS: Final = (
    DetectorSpec("candidates", "classifier", _candidates),
    DetectorSpec("regression", "regressor", _regression),
)
