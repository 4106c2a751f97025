"""What the classifier and the regressor have in common for an export: the interface, validation data, calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax
from torch import nn

from lanestream.detection.interface import Detector, FrameContext, Infer
from lanestream.inference.model_info import ModelInfo
from lanestream.road.view import Image
from lanestream_exporter.exporting.frames import ExportFrames

Precision = Literal["fp32", "fp16", "int8"]
MetricValues = dict[str, float]

# Returns the outputs (N, outputs) of a network, in PyTorch or from a file, for its inputs (N, H, W, 3) uint8 RGB.
RunNetwork = Callable[[NDArray[np.uint8]], NDArray[np.float32]]


@dataclass(frozen=True)
class Calibration:
    """The `temperature` that logits are divided by, and the probability `threshold` for accepting a boundary.

    The logits of types and colors of markings have their own temperatures.
    """

    temperature: float = 1.0
    threshold: float = 0.5
    type_temperature: float = 1.0
    color_temperature: float = 1.0


@dataclass(frozen=True)
class ValidationSet:
    """Validation frames, decoded from JPEG, with the ground truth of what is measured on them.

    A detector gets each of the `images` (BGR) with its context, and the network gets `inputs` (N, H, W, 3) for them.
    `frames` is the number of frames; one may be in `images` more than once, in different contexts. Each array of
    `truth` has one entry per image or per input, whichever the network's metrics need.
    """

    frames: int
    images: tuple[Image, ...]
    contexts: tuple[FrameContext, ...]
    inputs: NDArray[np.uint8]
    truth: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class ExportDescription:
    """The part of a file's metadata that does not depend on the kind of network."""

    name: str
    version: str
    precision: Precision
    training: dict[str, Any]
    metrics: dict[str, Any]


class ExportableNetwork(Protocol):
    """A network that can be exported."""

    @property
    def input_name(self) -> str:
        """Returns the name of the graph's input."""

    @property
    def output_name(self) -> str:
        """Returns the name of the graph's output."""

    @property
    def fp32_layers(self) -> tuple[str, ...]:
        """Returns the name prefixes of the weights that stay in fp32 in an int8 file."""

    @property
    def default_rank_energy(self) -> float:
        """Returns the share of the hidden layers' variance that preserves the outputs."""

    @property
    def guarded_metrics(self) -> Sequence[str]:
        """Returns the names of the metrics, shares, that the tolerance of an export applies to."""

    @property
    def calibration(self) -> Calibration:
        """Returns the temperature and the threshold."""

    @property
    def detector(self) -> Detector:
        """Returns the detector that will run the file."""

    def infer(self, run: RunNetwork) -> Infer:
        """Returns what the detector calls for outputs: `run` for those of this network."""

    def training_inputs(self, frames: ExportFrames) -> NDArray[np.uint8]:
        """Returns inputs (N, H, W, 3) of training frames, for ranks and int8 ranges. Raises LabelError."""

    def validation_set(self, frames: ExportFrames) -> ValidationSet:
        """Returns validation frames with the inputs that the detector makes of them. Raises LabelError."""

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> Self:
        """Returns the network with truncated hidden layers."""

    def calibrated(self, validation: ValidationSet) -> Self:
        """Returns the network with temperature and threshold fitted to `validation`."""

    def with_calibration(self, calibration: Calibration) -> Self:
        """Returns the network with the given temperature and threshold."""

    def serving_module(self, half: bool = False) -> nn.Module:
        """Returns the module to export: uint8 inputs (N, H, W, 3) to served outputs; `half`: network in float16."""

    def metrics(self, run: RunNetwork, validation: ValidationSet) -> MetricValues:
        """Returns the metrics of the network that `run` runs on `validation`."""

    def info(self, description: ExportDescription) -> ModelInfo:
        """Returns the metadata of the file."""


def fit_calibration(logits: NDArray[np.float32], labels: NDArray[np.int64]) -> Calibration:
    """Returns the temperature of least log loss and the threshold for the best F1 of accepting all but class 0.

    `logits` are (N, classes), `labels` (N,). Returns the default if all labels are equal.
    """
    temperature = fit_temperature(logits, labels)
    if len(np.unique(labels)) < 2:
        return Calibration()
    probability = 1.0 - softmax(logits / temperature, axis=1)[:, 0]
    return Calibration(temperature, _threshold(probability, (labels > 0).astype(np.int64)))


def fit_temperature(logits: NDArray[np.float32], labels: NDArray[np.int64]) -> float:
    """Returns the temperature of least log loss for logits (N, classes) and labels (N,); 1 if all labels are equal.

    Source: C. Guo et al., "On calibration of modern neural networks", 2017.
    """
    if len(np.unique(labels)) < 2:
        return 1.0
    rows = np.arange(len(labels))

    def log_loss(log_temperature: float) -> float:
        return float(-log_softmax(logits / np.exp(log_temperature), axis=1)[rows, labels].mean())

    best = minimize_scalar(log_loss, bounds=(np.log(0.25), np.log(8.0)), method="bounded")
    return float(np.exp(best.x))


def _threshold(probability: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    """Returns the 75th percentile of the thresholds whose F1 is within half a point of the best.

    A plateau generalizes better than a peak. Its strict end is the better one: the tracker bridges a boundary that is
    missed in one frame, but follows a wrong one that is reported again in the next.
    """
    thresholds = np.linspace(0.05, 0.95, 91)
    scores = np.array([_f1(probability >= t, labels) for t in thresholds])
    return float(np.quantile(thresholds[scores >= scores.max() - 0.005], 0.75))


def _f1(accepted: NDArray[np.bool_], labels: NDArray[np.int64]) -> float:
    hits = float((accepted & (labels == 1)).sum())
    return 2.0 * hits / max(float(accepted.sum() + (labels == 1).sum()), 1.0)
