"""The export: compress, calibrate, write, verify against PyTorch, and publish only a file within the tolerance."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ExportError
from lanestream.inference.onnx_model import load
from lanestream_exporter.exporting.compression import quantize, run_in_pytorch
from lanestream_exporter.exporting.exportable import ExportableNetwork, ExportDescription, Precision, ValidationSet
from lanestream_exporter.exporting.frames import ExportFrames
from lanestream_exporter.exporting.graph import describe, publish, write_graph
from lanestream_exporter.exporting.proof import (
    BoundaryComparison,
    ModelMeasurement,
    compare_boundaries,
    differences,
    time_files,
)

# The allowed (mean, largest) difference of any output from PyTorch. int8 rounds in every layer, so only its mean is
# limited, besides the loss of accuracy.
_MAX_DIFFERENCES: Final[dict[Precision, tuple[float, float]]] = {
    "fp32": (1e-4, 1e-3),
    "fp16": (5e-3, 5e-2),
    "int8": (3e-2, np.inf),
}

# How many of the training inputs set the ranges of int8.
_RANGE_INPUTS: Final = 256


@dataclass(frozen=True)
class ExportSettings:
    """What to write: the model's `name` and `version`, the `rank_energy` of the hidden layers to keep, the `precision`.

    `tolerance` is how many points of accuracy the file may lose against the checkpoint.
    """

    name: str
    version: str
    rank_energy: float
    precision: Precision = "int8"
    tolerance: float = 0.5


@dataclass(frozen=True)
class ExportReport:
    """The measurements on the same validation inputs: the checkpoint in PyTorch, the fp32 file, the written file.

    `fp32` is the file of the same compressed network, and is the written file itself if the precision is fp32.
    `timing_provider` is the execution provider that ran the timed files.
    """

    network: ExportableNetwork
    frames: int
    inputs: int
    checkpoint: ModelMeasurement
    fp32: ModelMeasurement
    written: ModelMeasurement
    boundaries: BoundaryComparison
    timing_provider: str

    @property
    def lost(self) -> dict[str, float]:
        """Returns the points of accuracy that the written file loses, by reference; negative if it gains."""
        return {
            reference.name: max(
                100.0 * (reference.metrics[key] - self.written.metrics[key]) for key in self.network.guarded_metrics
            )
            for reference in (self.checkpoint, self.fp32)
            if reference is not self.written
        }

    @property
    def time_ratio(self) -> float | None:
        """Returns the written file's time per input over the fp32 file's; None if they are the same file."""
        if self.written is self.fp32 or not self.written.milliseconds or not self.fp32.milliseconds:
            return None
        return self.written.milliseconds / self.fp32.milliseconds


@dataclass(frozen=True)
class Provenance:
    """The training record of a network and the frames of its export, for the file's metadata."""

    training: dict[str, Any]
    frames: ExportFrames


def export_network(
    network: ExportableNetwork,
    out: Path,
    settings: ExportSettings,
    provenance: Provenance,
    progress: Callable[[str], None],
) -> ExportReport:
    """Writes `network` to `out` (.onnx) and returns the measurements; calls `progress` with a line for each step.

    Training frames determine the truncation of the hidden layers and the ranges of int8; validation frames determine
    temperature and threshold and verify the file. Raises LabelError for unusable frames, and ExportError, without
    writing anything, if the file misses the tolerance.
    """
    frames = provenance.frames
    progress(f"preparing {frames.origin}")
    training_inputs = network.training_inputs(frames)
    validation = network.validation_set(frames)
    progress(
        f"compressing and calibrating with {len(training_inputs)} inputs from training frames and "
        f"{len(validation.inputs)} from validation frames"
    )
    original = network
    network = network.compressed(settings.rank_energy, training_inputs).calibrated(validation)
    training = {**provenance.training, "rank_energy": settings.rank_energy, "export_frames": frames.origin}
    with tempfile.TemporaryDirectory() as folder:
        progress(f"writing {settings.precision}")
        files = _write_files(network, settings.precision, training_inputs[:_RANGE_INPUTS], Path(folder))
        for path in files.values():
            describe(path, network.info(_description(settings, training, {})))
        progress("verifying")
        report = _measure(original, network, validation, files, settings.precision)
        _check_tolerance(report, settings)
        metrics = _metadata_metrics(report, frames)
        finished = files[settings.precision]
        describe(finished, network.info(_description(settings, training, metrics)))
        publish(finished, out)
    return report


def _description(settings: ExportSettings, training: dict[str, Any], metrics: dict[str, Any]) -> ExportDescription:
    return ExportDescription(settings.name, settings.version, settings.precision, training, metrics)


def _write_files(
    network: ExportableNetwork, precision: Precision, inputs: NDArray[np.uint8], folder: Path
) -> dict[Precision, Path]:
    """Writes the fp32 file, the reference for the others, and the file of `precision`."""
    files: dict[Precision, Path] = {name: folder / f"{name}.onnx" for name in ("fp32", precision)}
    names = network.input_name, network.output_name
    write_graph(network.serving_module(), inputs, files["fp32"], names)
    if precision == "fp16":
        write_graph(network.serving_module(half=True), inputs, files["fp16"], names)
    if precision == "int8":
        quantize(files["fp32"], files["int8"], inputs, network.fp32_layers)
    return files


def _measure(
    original: ExportableNetwork,
    network: ExportableNetwork,
    validation: ValidationSet,
    files: dict[Precision, Path],
    precision: Precision,
) -> ExportReport:
    reference = run_in_pytorch(network.serving_module())
    expected = reference(validation.inputs)
    # The uncompressed checkpoint gets the same temperature and threshold, which belong to the file.
    checkpoint = run_in_pytorch(original.with_calibration(network.calibration).serving_module())
    times = time_files({str(name): path for name, path in files.items()}, validation.inputs)
    models = {name: load(path) for name, path in files.items()}
    measured: dict[Precision, ModelMeasurement] = {}
    for name, model in models.items():
        mean, largest = differences(model, validation, expected)
        metrics = network.metrics(model.run, validation)
        size, milliseconds = files[name].stat().st_size, times.milliseconds[name]
        measured[name] = ModelMeasurement(name, metrics, mean, largest, size, milliseconds)
    return ExportReport(
        network,
        validation.frames,
        len(validation.inputs),
        ModelMeasurement("checkpoint", network.metrics(checkpoint, validation)),
        measured["fp32"],
        measured[precision],
        compare_boundaries(
            network.detector, validation, network.infer(reference), network.infer(models[precision].run)
        ),
        times.provider,
    )


def _check_tolerance(report: ExportReport, settings: ExportSettings) -> None:
    """Raises ExportError if the file differs too much from PyTorch or loses too much accuracy."""
    hint = _hint(settings)
    written = report.written
    mean, largest = _MAX_DIFFERENCES[settings.precision]
    # The negated comparisons also refuse NaN.
    if not (written.mean_difference <= mean and written.largest_difference <= largest):
        raise ExportError(
            f"the {settings.precision} file differs from PyTorch by {written.mean_difference:.5f} on average and "
            f"{written.largest_difference:.5f} at most; {mean:g} and {largest:g} are allowed",
            hint,
        )
    for name, lost in report.lost.items():
        if not lost <= settings.tolerance:
            raise ExportError(
                f"the {settings.precision} file loses {lost:.2f} points of accuracy against {name}; "
                f"{settings.tolerance:g} are allowed",
                hint,
            )


def _hint(settings: ExportSettings) -> str:
    options = [] if settings.rank_energy >= 1.0 else ["a --rank-energy closer to 1"]
    options += [] if settings.precision == "fp32" else ["--precision fp16 or fp32"]
    return f"try {' or '.join(options)}, or allow more with --tolerance" if options else "allow more with --tolerance"


def _metadata_metrics(report: ExportReport, frames: ExportFrames) -> dict[str, Any]:
    metrics = {name: round(value, 4) for name, value in report.written.metrics.items() if np.isfinite(value)}
    return {"frames": f"validation: {frames.origin}", "frame_count": report.frames, "inputs": report.inputs, **metrics}
