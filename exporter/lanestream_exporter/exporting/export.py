"""From a checkpoint to an ONNX file that describes itself and has proved itself."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ExportError
from lanestream.inference import OnnxModel
from lanestream_exporter.exporting.compression import in_batches
from lanestream_exporter.exporting.frames import FrameSource
from lanestream_exporter.exporting.graph import describe, publish, write_graph
from lanestream_exporter.exporting.proof import Boundaries, Measured, boundaries, differences, timed
from lanestream_exporter.exporting.quantization import quantized
from lanestream_exporter.exporting.subject import Check, Description, Precision, Subject

# The largest differences from PyTorch, (mean, largest), that a file may show in any output. int8 rounds every layer,
# so there only the mean counts, and the accuracy it costs.
_TOLERANCES: Final[dict[Precision, tuple[float, float]]] = {
    "fp32": (1e-4, 1e-3),
    "fp16": (5e-3, 5e-2),
    "int8": (3e-2, np.inf),
}

# So many of the inputs that set ranks set int8's ranges, too.
_RANGES: Final = 256


@dataclass(frozen=True)
class ExportSettings:
    """What to write: its `name`, the share of the hidden layers' `rank_energy` to keep, its `precision`.

    `tolerance` is how many points of accuracy the file may lose against the checkpoint.
    """

    name: str
    rank_energy: float
    precision: Precision = "int8"
    tolerance: float = 0.5


@dataclass(frozen=True)
class ExportReport:
    """What was measured on the same validation inputs: the checkpoint in PyTorch, the fp32 file, the written file.

    `fp32` is the file of the same compressed network; it is the written one where that was asked for. `timed_by` is the
    provider that ran the files for their times.
    """

    subject: Subject
    frames: int
    inputs: int
    checkpoint: Measured
    fp32: Measured
    written: Measured
    boundaries: Boundaries
    timed_by: str

    @property
    def lost(self) -> dict[str, float]:
        """Points of accuracy that the written file loses, by what it is compared with; negative where it gains."""
        return {
            other.name: max(100.0 * (other.figures[key] - self.written.figures[key]) for key in self.subject.headline)
            for other in (self.checkpoint, self.fp32)
            if other is not self.written
        }

    @property
    def time_ratio(self) -> float | None:
        """The written file's time an input over the fp32 file's; None where they are the same file."""
        if self.written is self.fp32 or not self.written.milliseconds or not self.fp32.milliseconds:
            return None
        return self.written.milliseconds / self.fp32.milliseconds


@dataclass(frozen=True)
class Provenance:
    """Where a network and the frames of its export come from, for the file's metadata."""

    training: dict[str, Any]
    source: FrameSource


def export_network(
    subject: Subject, out: Path, settings: ExportSettings, provenance: Provenance, told: Callable[[str], None]
) -> ExportReport:
    """Writes `subject` to `out` (.onnx) and returns what it measures; `told` hears of each step.

    Training frames choose what the hidden layers keep and set the ranges of int8; validation frames set temperature and
    threshold and prove the file. Raises LabelError for frames that can't be used, and ExportError where the file misses
    the tolerance; then nothing is written.
    """
    told(f"preparing {provenance.source.origin}")
    ranging = subject.ranging(provenance.source)
    check = subject.check(provenance.source)
    told(
        f"compressing and calibrating with {len(ranging)} inputs of training frames, {len(check.inputs)} of validation"
    )
    whole = subject
    subject = subject.compressed(settings.rank_energy, ranging).calibrated(check)
    with tempfile.TemporaryDirectory() as folder:
        told(f"writing {settings.precision}")
        files = _files(subject, settings.precision, ranging[:_RANGES], Path(folder))
        description = Description(settings.name, settings.precision, _training(settings, provenance), {})
        for path in files.values():
            describe(path, subject.info(description))
        told("proving it")
        report = _measured(whole, subject, check, files)
        _refuse(report, settings)
        metrics = _metrics(report, provenance.source)
        final = Description(settings.name, settings.precision, description.training, metrics)
        describe(files[settings.precision], subject.info(final))
        publish(files[settings.precision], out)
    return report


def _files(subject: Subject, precision: Precision, ranging: NDArray[np.uint8], folder: Path) -> dict[Precision, Path]:
    """The fp32 file, which the others are measured against, and the one of `precision`."""
    files: dict[Precision, Path] = {name: folder / f"{name}.onnx" for name in ("fp32", precision)}
    names = subject.input_name, subject.output_name
    write_graph(subject.served(), ranging, files["fp32"], names)
    if precision == "fp16":
        write_graph(subject.served(half=True), ranging, files["fp16"], names)
    if precision == "int8":
        quantized(files["fp32"], files["int8"], ranging, subject.exact)
    return files


def _training(settings: ExportSettings, provenance: Provenance) -> dict[str, Any]:
    return {**provenance.training, "rank_energy": settings.rank_energy, "export_frames": provenance.source.origin}


def _measured(whole: Subject, subject: Subject, check: Check, files: dict[Precision, Path]) -> ExportReport:
    served = subject.served()
    expected = in_batches(served, check.inputs).numpy()
    # The checkpoint as it is, but with the same temperature and threshold: they are the file's, not the network's.
    checkpoint = in_batches(whole.under(subject.calibration).served(), check.inputs).numpy()
    times = timed({str(name): path for name, path in files.items()}, check.inputs)
    rows: dict[str, Measured] = {}
    for name, path in files.items():
        outputs, mean, largest = differences(OnnxModel.load(path, "cpu"), check, expected)
        figures = subject.figures(outputs, check)
        rows[name] = Measured(name, figures, mean, largest, path.stat().st_size, times.milliseconds[name])
    return ExportReport(
        subject,
        check.frames,
        len(check.inputs),
        Measured("checkpoint", subject.figures(checkpoint, check)),
        rows["fp32"],
        rows[name],
        boundaries(subject.detector, check, expected, outputs),
        times.provider,
    )


def _refuse(report: ExportReport, settings: ExportSettings) -> None:
    """Raises ExportError where the file differs too much from PyTorch, or loses too much of the checkpoint."""
    hint = _hint(settings)
    written = report.written
    mean, largest = _TOLERANCES[settings.precision]
    # Written so that what is no number is refused, too.
    if not (written.mean_difference <= mean and written.largest_difference <= largest):
        raise ExportError(
            f"the {settings.precision} file differs from PyTorch by {written.mean_difference:.5f} on average and "
            f"{written.largest_difference:.5f} at most, {mean:g} and {largest:g} are allowed",
            hint,
        )
    for name, lost in report.lost.items():
        if not lost <= settings.tolerance:
            raise ExportError(
                f"the {settings.precision} file loses {lost:.2f} points of accuracy against {name}, "
                f"{settings.tolerance:g} are allowed",
                hint,
            )


def _hint(settings: ExportSettings) -> str:
    """What to try instead."""
    tries = [] if settings.rank_energy >= 1.0 else ["a --rank-energy nearer to 1"]
    tries += [] if settings.precision == "fp32" else ["--precision fp16 or fp32"]
    return f"try {' or '.join(tries)}, or allow more with --tolerance" if tries else "allow more with --tolerance"


def _metrics(report: ExportReport, source: FrameSource) -> dict[str, Any]:
    told = {name: round(value, 4) for name, value in report.written.figures.items() if np.isfinite(value)}
    return {"frames": f"validation: {source.origin}", "frame_count": report.frames, "inputs": report.inputs, **told}
