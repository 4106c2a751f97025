"""Exporting the classifier: patches in, calibrated probabilities out."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score
from torch import Tensor, nn

from lanestream import __version__
from lanestream.detection import Prepared, answered
from lanestream.detection.candidate_detector import TRUE_LANE, CandidateDetector
from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.detection.patches import PatchCutter, PatchGeometry
from lanestream.images.decoding import ImageLimits, decode
from lanestream.inference import ClassifierInfo, PatchInfo
from lanestream.road.view import Image
from lanestream_exporter.alexnet import FULL, AlexNet
from lanestream_exporter.exporting.calibration import Calibration, calibrated
from lanestream_exporter.exporting.compression import in_batches, truncated
from lanestream_exporter.exporting.frames import FrameSource, LabelledJpeg, Part
from lanestream_exporter.exporting.normalisation import NORMALISATIONS
from lanestream_exporter.exporting.subject import Check, Description, Figures
from lanestream_exporter.exporting.versions import exporter
from lanestream_exporter.samples.patches import FALSE, TRUE, TruthRule

_MOST_RANGING: Final = 1024


class ServedClassifier(nn.Module):
    """The graph: uint8 RGB patches (N, H, W, 3) in, calibrated probabilities (N, 2) out, the lane's second."""

    def __init__(self, network: AlexNet, normalisation: str, calibration: Calibration, half: bool = False) -> None:
        super().__init__()
        self.network = copy.deepcopy(network).half() if half else network
        self.normalise = NORMALISATIONS[normalisation]
        self.dtype = torch.float16 if half else torch.float32
        self.temperature = calibration.temperature

    def forward(self, patches: Tensor) -> Tensor:
        """Only the network itself is ever in half precision."""
        logits = self.network(self.normalise(patches).to(self.dtype)).float()
        return torch.softmax(logits / self.temperature, dim=1)


@dataclass(frozen=True)
class ClassifierSubject:
    """A plain AlexNet with two `classes`, the lane second, and how its patches were cut and normalised.

    It is calibrated and proved on candidates as they are proposed after a `glance`, where there is one.
    """

    network: AlexNet
    classes: tuple[str, str] = ("false", "lane")
    strip: PatchGeometry = PatchGeometry(FULL.size)
    normalisation: str = "contrast"
    calibration: Calibration = Calibration()
    glance: EgoPriorEstimator | None = None

    name = "lanestream-alexnet"
    input_name = "patches"
    output_name = "probabilities"
    exact = ("network.classifier.6.",)
    rank_energy = 0.998
    headline = ("accuracy",)

    @property
    def detector(self) -> CandidateDetector:
        """The detector that will ask the file."""
        return CandidateDetector(self.calibration.threshold, cutter=PatchCutter(self.strip))

    def ranging(self, source: FrameSource) -> NDArray[np.uint8]:
        """Patches (N, size, size, 3) of candidates of training frames. Raises LabelError."""
        patches = np.concatenate([prepared.inputs for prepared, _ in self._prepared(source, "train")])
        chosen = np.random.default_rng(0).permutation(len(patches))[:_MOST_RANGING]
        return np.asarray(patches[chosen])

    def check(self, source: FrameSource) -> Check:
        """All candidates of validation frames, judged by the rule that training judges by. Raises LabelError."""
        pairs = list(self._prepared(source, "val"))
        verdicts = [TruthRule().judge(prepared.candidates, frame.labels, prepared.view) for prepared, frame in pairs]
        return Check(len(pairs), tuple(prepared for prepared, _ in pairs), {"verdict": np.concatenate(verdicts)})

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> ClassifierSubject:
        """With thinner hidden layers."""
        small = copy.deepcopy(self.network)
        normalise = NORMALISATIONS[self.normalisation]
        seen = in_batches(lambda part: torch.flatten(small.features(normalise(part)), 1), inputs)
        small.classifier = truncated(small.classifier, seen, energy)
        return replace(self, network=small)

    def calibrated(self, check: Check) -> ClassifierSubject:
        """With a temperature and a threshold from the candidates that are clearly true or false."""
        normalise = NORMALISATIONS[self.normalisation]
        clear, labels = _clear(check)
        logits = in_batches(lambda part: self.network(normalise(part)), check.inputs[clear])
        return replace(self, calibration=calibrated(logits.numpy(), labels))

    def under(self, calibration: Calibration) -> ClassifierSubject:
        """With a temperature and a threshold."""
        return replace(self, calibration=calibration)

    def served(self, half: bool = False) -> ServedClassifier:
        """The graph; `half`: its network in float16."""
        return ServedClassifier(self.network, self.normalisation, self.calibration, half).eval()

    def figures(self, outputs: NDArray[np.float32], check: Check) -> Figures:
        """Accuracy and average precision on the candidates that are clearly true or false."""
        clear, labels = _clear(check)
        probability = outputs[clear, TRUE_LANE]
        accuracy = float(((probability >= self.calibration.threshold) == (labels == 1)).mean())
        both = len(np.unique(labels)) == 2
        precision = float(average_precision_score(labels, probability)) if both else float("nan")
        return {"accuracy": accuracy, "average_precision": precision}

    def info(self, description: Description) -> ClassifierInfo:
        """What the file says of itself."""
        strip = PatchInfo(
            size=self.strip.size,
            half_width=self.strip.half_width,
            min_half_width=self.strip.min_half_width,
            lean=self.strip.lean,
        )
        return ClassifierInfo(
            kind="classifier",
            name=description.name,
            version=__version__,
            classes=self.classes,
            strip=strip,
            temperature=self.calibration.temperature,
            threshold=self.calibration.threshold,
            precision=description.precision,
            training={**description.training, "normalisation": self.normalisation},
            metrics=description.metrics,
            exporter=exporter(),
        )

    def _prepared(self, source: FrameSource, part: Part) -> list[tuple[Prepared, LabelledJpeg]]:
        return [(self._prepare(decode(frame.jpeg, ImageLimits())), frame) for frame in source.jpegs(part)]

    def _prepare(self, image: Image) -> Prepared:
        prior = None if self.glance is None else answered(self.glance.look(image))
        return replace(self.detector.prepare(image, prior=prior), prior=prior)


def _clear(check: Check) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which inputs are clearly true or false (N,), and the labels of those."""
    verdict = check.truth["verdict"]
    clear = (verdict == FALSE) | (verdict == TRUE)
    return clear, (verdict[clear] == TRUE).astype(np.int64)
