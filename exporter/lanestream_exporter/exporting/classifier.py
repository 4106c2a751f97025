"""Export of the classifier: patches in, calibrated probabilities out."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score
from torch import Tensor, nn

from lanestream import __version__
from lanestream.detection.candidate_detector import BOUNDARY, CandidateDetector
from lanestream.detection.interface import FrameContext, Infer, ModelRole
from lanestream.images.decoding import ImageLimits, decode
from lanestream.inference.model_info import ClassifierInfo
from lanestream.road.crops import PatchGeometry
from lanestream.road.view import Image
from lanestream_exporter.alexnet import FULL, AlexNet
from lanestream_exporter.datasets.labels import to_working
from lanestream_exporter.exporting.compression import in_batches, truncate_layers
from lanestream_exporter.exporting.exportable import (
    Calibration,
    ExportDescription,
    MetricValues,
    RunNetwork,
    ValidationSet,
    fit_calibration,
)
from lanestream_exporter.exporting.frames import ExportFrames, Part
from lanestream_exporter.exporting.graph import NORMALIZATIONS, exporter_versions
from lanestream_exporter.samples.patches import FALSE, TRUE, PatchMaker
from lanestream_exporter.samples.prior_regressor import PriorRegressor, no_regressor

_MAX_TRAINING_INPUTS: Final = 1024


class ServedClassifier(nn.Module):
    """The module to export: uint8 RGB patches (N, H, W, 3) in, calibrated probabilities (N, 2) out, the lane second."""

    def __init__(self, network: AlexNet, normalization: str, calibration: Calibration, half: bool = False) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).half() if half else network
        self.normalize = NORMALIZATIONS[normalization]
        self.dtype = torch.float16 if half else torch.float32
        self.temperature = calibration.temperature

    def forward(self, patches: Tensor) -> Tensor:
        """Returns the probabilities; only the network itself may run in half precision."""
        logits = self.network(self.normalize(patches).to(self.dtype)).float()
        return torch.softmax(logits / self.temperature, dim=1)


@dataclass(frozen=True)
class ExportableClassifier:
    """A plain AlexNet with two `classes`, the lane second, and the geometry and normalization of its patches.

    It is calibrated and verified on candidates that are proposed with the ego-lane prior of `prior`, if set.
    """

    network: AlexNet
    classes: tuple[str, str] = ("false", "lane")
    patch_geometry: PatchGeometry = PatchGeometry(FULL.size)
    normalization: str = "contrast"
    calibration: Calibration = Calibration()
    prior: PriorRegressor | None = None

    default_name = "lanestream-alexnet"
    input_name = "patches"
    output_name = "probabilities"
    fp32_layers = ("network.classifier.6.",)
    default_rank_energy = 0.998
    guarded_metrics = ("accuracy",)

    @property
    def detector(self) -> CandidateDetector:
        """Returns the detector that will run the file."""
        regressor = None if self.prior is None else self.prior.regressor
        return CandidateDetector(self.calibration.threshold, self.patch_geometry, regressor)

    def infer(self, run: RunNetwork) -> Infer:
        """Returns what the detector calls for outputs: `run` for the classifier's, the prior's model for its own."""
        prior = no_regressor if self.prior is None else self.prior.infer

        def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
            return run(inputs) if role == "classifier" else prior(role, inputs)

        return infer

    def training_inputs(self, frames: ExportFrames) -> NDArray[np.uint8]:
        """Returns patches (N, size, size, 3) of candidates of training frames. Raises LabelError."""
        patches = np.concatenate([patches for _, patches, _ in self._candidates(frames, "train")])
        chosen = np.random.default_rng(0).permutation(len(patches))[:_MAX_TRAINING_INPUTS]
        return np.asarray(patches[chosen])

    def validation_set(self, frames: ExportFrames) -> ValidationSet:
        """Returns all candidates of validation frames, labeled by the same rule as in training. Raises LabelError."""
        images, patches, verdicts = zip(*self._candidates(frames, "val"), strict=True)
        return ValidationSet(
            frames=len(images),
            images=images,
            contexts=(FrameContext(),) * len(images),
            inputs=np.concatenate(patches),
            truth={"verdict": np.concatenate(verdicts)},
        )

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> ExportableClassifier:
        """Returns the network with truncated hidden layers."""
        small = copy.deepcopy(self.network)
        normalize = NORMALIZATIONS[self.normalization]
        features = in_batches(lambda part: torch.flatten(small.features(normalize(part)), 1), inputs)
        small.classifier = truncate_layers(small.classifier, features, energy)
        return replace(self, network=small)

    def calibrated(self, validation: ValidationSet) -> ExportableClassifier:
        """Returns the network with temperature and threshold fitted to the clearly true or false candidates."""
        normalize = NORMALIZATIONS[self.normalization]
        clear, labels = _clear_candidates(validation)
        logits = in_batches(lambda part: self.network(normalize(part)), validation.inputs[clear])
        return self.with_calibration(fit_calibration(logits.numpy(), labels))

    def with_calibration(self, calibration: Calibration) -> ExportableClassifier:
        """Returns the network with the given temperature and threshold."""
        return replace(self, calibration=calibration)

    def serving_module(self, half: bool = False) -> ServedClassifier:
        """Returns the module to export; `half`: its network in float16."""
        return ServedClassifier(self.network, self.normalization, self.calibration, half).eval()

    def metrics(self, run: RunNetwork, validation: ValidationSet) -> MetricValues:
        """Returns accuracy and average precision on the clearly true or false candidates."""
        clear, labels = _clear_candidates(validation)
        probability = run(validation.inputs[clear])[:, BOUNDARY]
        accuracy = float(((probability >= self.calibration.threshold) == (labels == 1)).mean())
        both = len(np.unique(labels)) == 2
        precision = float(average_precision_score(labels, probability)) if both else float("nan")
        return {"accuracy": accuracy, "average_precision": precision}

    def info(self, description: ExportDescription) -> ClassifierInfo:
        """Returns the metadata of the file."""
        return ClassifierInfo(
            kind="classifier",
            name=description.name,
            version=__version__,
            classes=self.classes,
            patch=self.patch_geometry,
            temperature=self.calibration.temperature,
            threshold=self.calibration.threshold,
            precision=description.precision,
            training={**description.training, "normalization": self.normalization},
            metrics=description.metrics,
            exporter=exporter_versions(),
        )

    def _candidates(
        self, frames: ExportFrames, part: Part
    ) -> Iterator[tuple[Image, NDArray[np.uint8], NDArray[np.int64]]]:
        """Yields the working images of `part`, each with the patches of its candidates and the verdicts on them."""
        maker = PatchMaker(self.patch_geometry, self.prior)
        for frame in frames.jpegs(part):
            labels, image = to_working(frame.labels, decode(frame.jpeg, ImageLimits()))
            yield image, *maker.proposed(image, labels, maker.propose(image))


def _clear_candidates(validation: ValidationSet) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Returns a mask (N,) of the inputs that are clearly true or false, and their labels."""
    verdict = validation.truth["verdict"]
    clear = (verdict == FALSE) | (verdict == TRUE)
    return clear, (verdict[clear] == TRUE).astype(np.int64)
