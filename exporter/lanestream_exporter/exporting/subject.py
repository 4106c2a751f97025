"""What the two networks have in common for an export: something to compress, to calibrate, to write and to prove."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from torch import nn

from lanestream.detection import Detector, Prepared
from lanestream.inference import ModelInfo
from lanestream_exporter.exporting.calibration import Calibration
from lanestream_exporter.exporting.frames import FrameSource

Precision = Literal["fp32", "fp16", "int8"]
Figures = dict[str, float]


@dataclass(frozen=True)
class Check:
    """Frames that prove a file, on their way from JPEG bytes through the detector, and what is true of their inputs.

    Of `frames` frames; one that is looked at in different ways is prepared more than once. `truth` has an entry for
    each row of `inputs`, or for each of `prepared`, as the network's figures need it.
    """

    frames: int
    prepared: tuple[Prepared, ...]
    truth: dict[str, NDArray[Any]]

    @cached_property
    def inputs(self) -> NDArray[np.uint8]:
        """The inputs (N, H, W, 3) of all frames."""
        return np.concatenate([prepared.inputs for prepared in self.prepared])

    def by_frame(self, outputs: NDArray[np.float32]) -> Sequence[NDArray[np.float32]]:
        """The network's outputs (N, ...) for `inputs`, frame by frame."""
        return np.split(outputs, np.cumsum([len(prepared.inputs) for prepared in self.prepared])[:-1])


@dataclass(frozen=True)
class Description:
    """What every file says of itself, whatever its network."""

    name: str
    precision: Precision
    training: dict[str, Any]
    metrics: dict[str, Any]


class Subject(Protocol):
    """A network on its way into a file."""

    @property
    def input_name(self) -> str:
        """What the graph calls its input."""

    @property
    def output_name(self) -> str:
        """What the graph calls its output."""

    @property
    def exact(self) -> tuple[str, ...]:
        """The layers, by the beginning of their weights' names, that int8 leaves in fp32."""

    @property
    def rank_energy(self) -> float:
        """The share of the hidden layers' variance that is enough for what the network answers."""

    @property
    def headline(self) -> Sequence[str]:
        """The figures, in shares, of which an export may lose little."""

    @property
    def name(self) -> str:
        """What the file's model is called where nobody says otherwise."""

    @property
    def calibration(self) -> Calibration:
        """The temperature and the threshold."""

    @property
    def detector(self) -> Detector:
        """The detector that will ask the file."""

    def ranging(self, source: FrameSource) -> NDArray[np.uint8]:
        """Inputs (N, H, W, 3) of training frames, which set ranks and ranges. Raises LabelError."""

    def check(self, source: FrameSource) -> Check:
        """Validation frames, from JPEG files through the detector. Raises LabelError."""

    def compressed(self, energy: float, inputs: NDArray[np.uint8]) -> Self:
        """With thinner hidden layers."""

    def calibrated(self, check: Check) -> Self:
        """With the temperature and the threshold that `check` asks for."""

    def under(self, calibration: Calibration) -> Self:
        """With a temperature and a threshold."""

    def served(self, half: bool = False) -> nn.Module:
        """The graph: uint8 inputs (N, H, W, 3) to what the service is told; `half`: the network in float16."""

    def figures(self, outputs: NDArray[np.float32], check: Check) -> Figures:
        """How good outputs for the inputs of `check` are."""

    def info(self, description: Description) -> ModelInfo:
        """What the file says of itself."""
