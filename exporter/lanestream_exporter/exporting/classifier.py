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

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.classification import Classification
from lanestream.detection.interface import FrameContext, Infer, ModelRole
from lanestream.images.decoding import ImageLimits, decode
from lanestream.inference.model_info import ClassifierInfo
from lanestream.road.appearance import BOUNDARY_KINDS, MARKING_COLORS, MARKING_TYPES
from lanestream.road.crops import PatchGeometry
from lanestream.road.view import Image
from lanestream_exporter.alexnet import FULL, KINDS, OUTPUTS, AlexNet, ClassifierLogits
from lanestream_exporter.datasets.labels import to_working
from lanestream_exporter.exporting.compression import in_batches, truncate_layers
from lanestream_exporter.exporting.exportable import (
    Calibration,
    ExportDescription,
    MetricValues,
    RunNetwork,
    ValidationSet,
    fit_calibration,
    fit_temperature,
)
from lanestream_exporter.exporting.frames import ExportFrames, Part
from lanestream_exporter.exporting.graph import NORMALIZATIONS, exporter_versions
from lanestream_exporter.samples.patches import PatchMaker
from lanestream_exporter.samples.prior_regressor import PriorRegressor, no_regressor
from lanestream_exporter.samples.truth import MARKING, NOTHING, ROAD_EDGE, UNSURE

_MAX_TRAINING_INPUTS: Final = 1024


class ServedClassifier(nn.Module):
    """The module to export: uint8 RGB patches (N, H, W, 3) in, calibrated probabilities (N, outputs) out.

    They are those of the classes, then of the types and the colors of a marking if the network has these outputs.
    """

    def __init__(self, network: AlexNet, normalization: str, calibration: Calibration, half: bool = False) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).half() if half else network
        self.normalize = NORMALIZATIONS[normalization]
        self.dtype = torch.float16 if half else torch.float32
        self.calibration = calibration
        self.classifies_markings = network.outputs == OUTPUTS

    def forward(self, patches: Tensor) -> Tensor:
        """Returns the probabilities; only the network itself may run in half precision."""
        raw = self.network(self.normalize(patches).to(self.dtype)).float()
        calibration = self.calibration
        if not self.classifies_markings:
            return torch.softmax(raw / calibration.temperature, dim=1)
        logits = ClassifierLogits.of(raw)
        return torch.cat(
            [
                torch.softmax(logits.kinds / calibration.temperature, dim=1),
                torch.softmax(logits.types / calibration.type_temperature, dim=1),
                torch.softmax(logits.colors / calibration.color_temperature, dim=1),
            ],
            dim=1,
        )


@dataclass(frozen=True)
class ExportableClassifier:
    """A plain AlexNet, its `classes` in order, and the geometry and normalization of its patches.

    A network with two classes has that of the lane second. It is calibrated and verified on candidates that are
    proposed with the ego-lane prior of `prior`, if set.
    """

    network: AlexNet
    classes: tuple[str, ...] = ("nothing", *BOUNDARY_KINDS)
    patch_geometry: PatchGeometry = PatchGeometry(FULL.size)
    normalization: str = "contrast"
    calibration: Calibration = Calibration()
    prior: PriorRegressor | None = None

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
        images, patches, targets = zip(*self._candidates(frames, "val"), strict=True)
        return ValidationSet(
            frames=len(images),
            images=images,
            contexts=(FrameContext(),) * len(images),
            inputs=np.concatenate(patches),
            truth={"targets": np.concatenate(targets)},
        )

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> ExportableClassifier:
        """Returns the network with truncated hidden layers."""
        small = copy.deepcopy(self.network)
        normalize = NORMALIZATIONS[self.normalization]
        features = in_batches(lambda part: torch.flatten(small.features(normalize(part)), 1), inputs)
        small.classifier = truncate_layers(small.classifier, features, energy)
        return replace(self, network=small)

    def calibrated(self, validation: ValidationSet) -> ExportableClassifier:
        """Returns the network with temperatures and threshold fitted to the candidates whose labels are clear."""
        normalize = NORMALIZATIONS[self.normalization]
        truth = _Truth.of(validation)
        logits = in_batches(lambda part: self.network(normalize(part)), validation.inputs).numpy()
        if not self._classifies_markings:
            return self.with_calibration(fit_calibration(logits[truth.clear], truth.is_boundary[truth.clear]))
        kinds, types, colors = np.split(logits, np.cumsum([KINDS, len(MARKING_TYPES)]), axis=1)
        temperatures = {
            name: fit_temperature(values[known >= 0], known[known >= 0])
            for name, values, known in (
                ("type_temperature", types, truth.types),
                ("color_temperature", colors, truth.colors),
            )
        }
        known = truth.kinds >= 0
        calibration = fit_calibration(kinds[known], truth.kinds[known])
        return self.with_calibration(replace(calibration, **temperatures))

    def with_calibration(self, calibration: Calibration) -> ExportableClassifier:
        """Returns the network with the given temperature and threshold."""
        return replace(self, calibration=calibration)

    def serving_module(self, half: bool = False) -> ServedClassifier:
        """Returns the module to export; `half`: its network in float16."""
        return ServedClassifier(self.network, self.normalization, self.calibration, half).eval()

    def metrics(self, run: RunNetwork, validation: ValidationSet) -> MetricValues:
        """Returns accuracies and the average precision of boundaries, on the candidates whose labels are clear.

        A candidate counts as right if it is accepted or not as it should be, and if its kind is right, where known.
        """
        truth = _Truth.of(validation)
        outputs = run(validation.inputs)
        found = Classification.of(outputs)
        clear, is_boundary = truth.clear, truth.is_boundary
        right = (found.boundary >= self.calibration.threshold) == (is_boundary == 1)
        known = (truth.kinds > 0) & self._classifies_markings
        right[known] &= found.kinds[known].argmax(axis=1) == truth.kinds[known] - 1
        both = len(np.unique(is_boundary[clear])) == 2
        values = {
            "accuracy": float(right[clear].mean()),
            "average_precision": float(average_precision_score(is_boundary[clear], found.boundary[clear]))
            if both
            else float("nan"),
        }
        for name, answers, labels in (("type", found.types, truth.types), ("color", found.colors, truth.colors)):
            if answers is not None and (labels >= 0).any():
                chosen = labels >= 0
                values[f"{name}_accuracy"] = float((answers[chosen].argmax(axis=1) == labels[chosen]).mean())
        return values

    def info(self, description: ExportDescription) -> ClassifierInfo:
        """Returns the metadata of the file."""
        return ClassifierInfo(
            kind="classifier",
            name=description.name,
            version=description.version,
            classes=self.classes,
            types=MARKING_TYPES if self._classifies_markings else (),
            colors=MARKING_COLORS if self._classifies_markings else (),
            patch=self.patch_geometry,
            temperature=self.calibration.temperature,
            type_temperature=self.calibration.type_temperature,
            color_temperature=self.calibration.color_temperature,
            threshold=self.calibration.threshold,
            precision=description.precision,
            training={**description.training, "normalization": self.normalization},
            metrics=description.metrics,
            exporter=exporter_versions(),
        )

    @property
    def _classifies_markings(self) -> bool:
        return self.network.outputs == OUTPUTS

    def _candidates(
        self, frames: ExportFrames, part: Part
    ) -> Iterator[tuple[Image, NDArray[np.uint8], NDArray[np.int8]]]:
        """Yields the working images of `part`, each with the patches of its candidates and their targets."""
        maker = PatchMaker(self.patch_geometry, self.prior)
        for frame in frames.jpegs(part):
            labels, image = to_working(frame.labels, decode(frame.jpeg, ImageLimits()))
            patches = maker.proposed(image, labels, maker.propose(image))
            yield image, patches.pixels, patches.targets


@dataclass(frozen=True)
class _Truth:
    """What N candidates are by their labels.

    `clear` (N,): they certainly are boundaries or not, by `is_boundary` (N,), 1 or 0. `kinds` (N,) are indices into the
    network's classes, `types` and `colors` (N,) into those of markings; each is -1 if unknown.
    """

    clear: NDArray[np.bool_]
    is_boundary: NDArray[np.int64]
    kinds: NDArray[np.int64]
    types: NDArray[np.int64]
    colors: NDArray[np.int64]

    @classmethod
    def of(cls, validation: ValidationSet) -> _Truth:
        allowed, types, colors = validation.truth["targets"].astype(np.int64).T
        is_boundary = (allowed != UNSURE) & (allowed & NOTHING == 0)
        kinds = np.full(len(allowed), -1)
        for index, bit in enumerate((NOTHING, MARKING, ROAD_EDGE)):
            kinds[allowed == bit] = index
        return cls(is_boundary | (allowed == NOTHING), is_boundary.astype(np.int64), kinds, types, colors)
