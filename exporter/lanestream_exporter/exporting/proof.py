"""Verification of an exported file: the same JPEG frames through PyTorch and through the file, by the service code."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Detector, Infer
from lanestream.inference.loaded_model import LoadedModel
from lanestream.inference.loading import load_model
from lanestream.inference.providers import AUTO, Installed, RuntimeOptions
from lanestream.road.results import Detection
from lanestream.road.view import WORKING_WIDTH
from lanestream_exporter.exporting.exportable import MetricValues, ValidationSet

BATCH_SIZES: Final = (1, 4, 16)

# The smaller batch sizes are tested with this many inputs, evenly spaced among all.
_SUBSET: Final = 64
_WARMUP_ROUNDS: Final = 2
_ROUNDS: Final = 15

# Detections farther apart than this, in pixels of a 640 pixel wide image, are different boundaries.
_MAX_MATCH_DISTANCE: Final = 15.0


@dataclass(frozen=True)
class ModelMeasurement:
    """A model on the validation inputs: its metrics, the differences of its outputs from PyTorch's, its size and time.

    `size` in bytes and `milliseconds` per input, in batches of 16, belong to a file; both are None for PyTorch itself.
    """

    name: str
    metrics: MetricValues
    mean_difference: float = 0.0
    largest_difference: float = 0.0
    size: int | None = None
    milliseconds: float | None = None


@dataclass(frozen=True)
class BoundaryComparison:
    """The boundaries detected with PyTorch's outputs compared with those detected with the file's.

    `matched` is the number found with both, whose columns differ by `mean` on average and `largest` at most, in pixels
    of a 640 pixel wide image; `unmatched` is the number found with only one of them.
    """

    matched: int
    unmatched: int
    mean: float
    largest: float


def run_in_batches(model: LoadedModel, inputs: NDArray[np.uint8], batch: int = BATCH_SIZES[-1]) -> NDArray[np.float32]:
    """Runs `model` on `inputs` with the given batch size and returns its outputs (N, outputs)."""
    return np.concatenate([model.run(inputs[i : i + batch]) for i in range(0, len(inputs), batch)])


def differences(model: LoadedModel, validation: ValidationSet, expected: NDArray[np.float32]) -> tuple[float, float]:
    """Returns the mean and the largest difference of the model's outputs from `expected` (N, outputs).

    The largest difference is over all batch sizes.
    """
    inputs = validation.inputs
    subset = np.unique(np.linspace(0, len(inputs) - 1, min(_SUBSET, len(inputs))).astype(int))
    smaller = [np.abs(run_in_batches(model, inputs[subset], batch) - expected[subset]) for batch in BATCH_SIZES[:-1]]
    difference = np.abs(run_in_batches(model, inputs) - expected)
    return float(difference.mean()), float(max(part.max() for part in (difference, *smaller)))


def compare_boundaries(
    detector: Detector, validation: ValidationSet, first: Infer, second: Infer
) -> BoundaryComparison:
    """Compares the boundaries that `detector` finds on the validation frames with two networks' outputs."""
    distances: list[NDArray[np.float64]] = []
    unmatched = 0
    for image, context in zip(validation.images, validation.contexts, strict=True):
        ours, theirs = (detector.detect(image, context, infer).boundaries for infer in (first, second))
        matched = _match(ours, theirs, WORKING_WIDTH / image.shape[1])
        distances += matched
        unmatched += len(ours) + len(theirs) - 2 * len(matched)
    values = np.concatenate(distances) if distances else np.zeros(1)
    return BoundaryComparison(len(distances), unmatched, float(values.mean()), float(values.max()))


def _match(first: Sequence[Detection], second: Sequence[Detection], scale: float) -> list[NDArray[np.float64]]:
    """Matches each detection of `first` to the nearest remaining one of `second`; returns the distances along each.

    `scale` converts pixels to those of a 640 pixel wide image.
    """
    matched, remaining = [], list(second)
    for detection in first:
        rows = np.linspace(detection.top, detection.bottom, 16)
        distances = [scale * np.abs(detection.curve.x(rows) - other.curve.x(rows)) for other in remaining]
        if distances:
            nearest = min(range(len(distances)), key=lambda i: float(distances[i].mean()))
            if distances[nearest].mean() <= _MAX_MATCH_DISTANCE:
                matched.append(distances[nearest])
                remaining.pop(nearest)
    return matched


@dataclass(frozen=True)
class InferenceTimes:
    """Milliseconds per input of each file, and the `provider` that ran them."""

    provider: str
    milliseconds: Mapping[str, float]


def time_files(paths: Mapping[str, Path], inputs: NDArray[np.uint8]) -> InferenceTimes:
    """Times each file as the service runs it on the CPU: the median over batches of 16, the files interleaved.

    Other load on the machine slows all files equally, so that their ratio holds even if the times do not.
    """
    batch = np.resize(inputs[: BATCH_SIZES[-1]], (BATCH_SIZES[-1], *inputs.shape[1:]))
    options, installed = RuntimeOptions(threads=1), Installed.here().without_gpus()
    models = {name: load_model(path, AUTO, options, installed) for name, path in paths.items()}
    times: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(_WARMUP_ROUNDS + _ROUNDS):
        for name, model in models.items():
            started = time.perf_counter()
            model.run(batch)
            times[name].append(1e3 * (time.perf_counter() - started) / len(batch))
    provider = next(iter(models.values())).placement.provider
    return InferenceTimes(provider, {name: float(np.median(t[_WARMUP_ROUNDS:])) for name, t in times.items()})
