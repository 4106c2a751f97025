"""Proving a file: the same JPEG files through PyTorch and through the file, by the service's own code."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Detector
from lanestream.inference import OnnxModel, load_model
from lanestream.inference.providers import offered, without_gpus
from lanestream.road.results import Detection
from lanestream.runtime import RuntimeOptions
from lanestream_exporter.exporting.subject import Check, Figures

BATCHES: Final = (1, 4, 16)

# Batches below the largest are tried with this many of the inputs, spread over all of them.
_FEW: Final = 64
_ROUNDS: Final = 15

# Boundaries of one frame that are farther apart, in pixels of a 640 pixel wide image, are not the same one.
_SAME: Final = 15.0
_WIDE: Final = 640.0


@dataclass(frozen=True)
class Measured:
    """A network on the check's inputs: how good it is, how far its outputs are from PyTorch's, its size and time.

    `size` in bytes and `milliseconds` an input, in batches of 16, are those of a file; None for PyTorch itself.
    """

    name: str
    figures: Figures
    mean_difference: float = 0.0
    largest_difference: float = 0.0
    size: int | None = None
    milliseconds: float | None = None


@dataclass(frozen=True)
class Boundaries:
    """Boundaries found by way of PyTorch and by way of the file in the same frames.

    `both` were found by both, their columns differing by `mean` and at most by `largest` pixels of a 640 pixel wide
    image; `alone` by one of them only.
    """

    both: int
    alone: int
    mean: float
    largest: float


def outputs_of(model: OnnxModel, inputs: NDArray[np.uint8], batch: int = BATCHES[-1]) -> NDArray[np.float32]:
    """What `model` answers (N, outputs) when it is asked about `batch` inputs at a time."""
    return np.concatenate([model.run(inputs[i : i + batch]) for i in range(0, len(inputs), batch)])


def differences(
    model: OnnxModel, check: Check, expected: NDArray[np.float32]
) -> tuple[NDArray[np.float32], float, float]:
    """The file's outputs (N, outputs), and their mean and largest difference from PyTorch's at all batch sizes."""
    outputs = outputs_of(model, check.inputs)
    few = np.unique(np.linspace(0, len(check.inputs) - 1, min(_FEW, len(check.inputs))).astype(int))
    by_batch = [np.abs(outputs_of(model, check.inputs[few], batch) - expected[few]) for batch in BATCHES[:-1]]
    all_at_most = np.abs(outputs - expected)
    return outputs, float(all_at_most.mean()), float(max(part.max() for part in (all_at_most, *by_batch)))


def boundaries(
    detector: Detector, check: Check, expected: NDArray[np.float32], outputs: NDArray[np.float32]
) -> Boundaries:
    """What two networks' outputs for the frames of `check` make of them, compared."""
    gaps: list[NDArray[np.float64]] = []
    alone = 0
    frames = zip(check.prepared, check.by_frame(expected), check.by_frame(outputs), strict=True)
    for prepared, one, other in frames:
        mine, theirs = (detector.finish(prepared, part).detections for part in (one, other))
        found = _paired(mine, theirs, _WIDE / prepared.view.width)
        gaps += found
        alone += len(mine) + len(theirs) - 2 * len(found)
    apart = np.concatenate(gaps) if gaps else np.zeros(1)
    return Boundaries(len(gaps), alone, float(apart.mean()), float(apart.max()))


def _paired(one: Sequence[Detection], other: Sequence[Detection], scale: float) -> list[NDArray[np.float64]]:
    """Columns' distances along each boundary of `one` that `other` has too, in pixels of a 640 pixel wide image."""
    pairs, left = [], list(other)
    for detection in one:
        rows = np.linspace(detection.top, detection.bottom, 16)
        gaps = [scale * np.abs(detection.curve.x(rows) - candidate.curve.x(rows)) for candidate in left]
        if gaps:
            nearest = min(range(len(gaps)), key=lambda i: float(gaps[i].mean()))
            if gaps[nearest].mean() <= _SAME:
                pairs.append(gaps[nearest])
                left.pop(nearest)
    return pairs


@dataclass(frozen=True)
class Times:
    """Milliseconds an input of each file, and the `provider` that they are of."""

    provider: str
    milliseconds: Mapping[str, float]


def timed(paths: Mapping[str, Path], inputs: NDArray[np.uint8]) -> Times:
    """The time of each file as the service runs it on the CPU: the median over batches of 16, the files taking turns.

    Whatever else the machine does slows all of them alike, so that their ratio holds where the numbers don't.
    """
    batch = np.resize(inputs[: BATCHES[-1]], (BATCHES[-1], *inputs.shape[1:]))
    options, offer = RuntimeOptions(threads=1), without_gpus(offered())
    models = {name: load_model(path, "auto", options, offer) for name, path in paths.items()}
    taken: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(_ROUNDS + 2):
        for name, model in models.items():
            started = time.perf_counter()
            model.run(batch)
            taken[name].append(1e3 * (time.perf_counter() - started) / len(batch))
    provider = next(iter(models.values())).provider
    return Times(provider, {name: float(np.median(times[2:])) for name, times in taken.items()})
