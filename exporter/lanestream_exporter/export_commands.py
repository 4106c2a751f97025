"""The command `export`."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import click
from rich.console import Console
from rich.table import Table

from lanestream.detection.patches import PatchGeometry
from lanestream.engine import resolve_regressor
from lanestream.errors import ExportError
from lanestream_exporter.alexnet import FULL
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.exporting.checkpoint import Foreign, read_subject
from lanestream_exporter.exporting.classifier import ClassifierSubject
from lanestream_exporter.exporting.export import ExportReport, ExportSettings, Provenance, export_network
from lanestream_exporter.exporting.frames import FrameSource
from lanestream_exporter.exporting.normalisation import NORMALISATIONS
from lanestream_exporter.exporting.proof import Measured
from lanestream_exporter.exporting.subject import Precision, Subject
from lanestream_exporter.samples.prior_regressor import prior_estimator

_STRIP = {"size": int, "half_width": float, "min_half_width": float, "lean": float}


def _classes(_context: click.Context, _option: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    return None if value is None else tuple(name.strip() for name in value.split(","))


def _strip(_context: click.Context, _option: click.Parameter, value: str | None) -> PatchGeometry | None:
    """The strip geometry in `size=224,half_width=0.5,min_half_width=5`; what isn't named has its usual value."""
    if value is None:
        return None
    given: dict[str, Any] = {"size": FULL.size}
    for part in filter(None, value.split(",")):
        key, _, number = (word.strip() for word in part.partition("="))
        if key not in _STRIP:
            raise click.BadParameter(f"there is no {key!r}; accepted: {', '.join(_STRIP)}")
        try:
            given[key] = _STRIP[key](number)
        except ValueError:
            raise click.BadParameter(f"{key} must be a number, not {number!r}") from None
        if not (0 < given[key] < math.inf or (key == "lean" and given[key] == 0)):
            raise click.BadParameter(f"{key} must be above 0")
    return PatchGeometry(**given)


@click.command()
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--precision", type=click.Choice(get_args(Precision)), default=ExportSettings.precision, show_default=True
)
@click.option(
    "--rank-energy", type=click.FloatRange(0.5, 1.0),
    help="Share of the hidden layers' variance to keep; 1 keeps the layers as they are."
    "  [default: 0.998 of a classifier's, 0.9999 of a regressor's]",
)  # fmt: skip
@click.option(
    "--tolerance", type=click.FloatRange(0.0, 100.0), default=ExportSettings.tolerance, show_default=True,
    help="Points of accuracy that the file may lose.",
)  # fmt: skip
@click.option(
    "--data", type=click.Path(path_type=Path), envvar="LANESTREAM_DATA", show_envvar=True,
    help="Folder of real frames; without it rendered scenes alone are used. What was trained on frames of your own is"
    " proved on those.",
)  # fmt: skip
@click.option(
    "--scenes", type=click.IntRange(4), default=FrameSource.rendered, show_default=True,
    help="Rendered scenes to calibrate with, and as many to prove the file with.",
)  # fmt: skip
@click.option(
    "--guide", type=click.Path(path_type=Path), metavar="FILE",
    help="Of a classifier: the regressor that it will be served with, or `none`  [default: the shipped one].",
)  # fmt: skip
@click.option("--name", help="What the model is called  [default: by its kind]")
@click.option("--classes", callback=_classes, help="Of a torchvision AlexNet: its classes in order, say false,lane.")
@click.option(
    "--strip", callback=_strip, help="Of a torchvision AlexNet: its strips, size=224,half_width=0.5,min_half_width=5."
)
@click.option(
    "--normalisation", type=click.Choice(list(NORMALISATIONS)), default=Foreign.normalisation, show_default=True,
    help="Of a torchvision AlexNet: how its training normalised pixels.",
)  # fmt: skip
def export(checkpoint: Path, out: Path, **given: Any) -> None:
    """Write CHECKPOINT as the ONNX file OUT that serves, after proving that it does the same."""
    if out.is_dir():
        raise ExportError(f"{out} is a folder", "give the path of the file to write")
    foreign = _foreign(given["classes"], given["strip"], given["normalisation"])
    # What is no checkpoint is told now, not after the frames have been made.
    subject, training = read_subject(checkpoint, foreign)
    subject = _guided(subject, given["guide"])
    source = FrameSource(_datasets(training, given["data"]), rendered=given["scenes"])
    energy = subject.rank_energy if given["rank_energy"] is None else given["rank_energy"]
    settings = ExportSettings(given["name"] or subject.name, energy, given["precision"], given["tolerance"])
    _tell(out, export_network(subject, out, settings, Provenance(training, source), click.echo), source)


def _guided(subject: Subject, named: Path | None) -> Subject:
    """A classifier as it is served, with the regressor that is `named`; a regressor as it is."""
    if isinstance(subject, ClassifierSubject):
        guide = resolve_regressor(named)
        return subject if guide is None else replace(subject, glance=prior_estimator(guide))
    if named is not None:
        raise click.UsageError("a regressor has no guide: --guide is for classifiers")
    return subject


def _datasets(training: dict[str, Any], data: Path | None) -> DatasetCollection | None:
    """Returns the data sets of the manifest that a network was trained with; None if its frames are not available.

    The shipped manifest is only used with a data folder, `data`.
    """
    manifest = training.get("config", {}).get("data", {}).get("manifest")
    if manifest is not None and Path(manifest).is_file():
        return DatasetCollection.open(Path(manifest), data)
    return None if data is None else DatasetCollection.open(None, data)


def _foreign(classes: tuple[str, ...] | None, strip: PatchGeometry | None, normalisation: str) -> Foreign | None:
    if classes is None and strip is None:
        return None
    if classes is None or strip is None:
        raise click.UsageError("a torchvision AlexNet needs both --classes and --strip")
    return Foreign(classes, strip, normalisation)


def _tell(out: Path, report: ExportReport, source: FrameSource) -> None:
    rows = [report.checkpoint, report.fp32, *([] if report.written is report.fp32 else [report.written])]
    title = f"{report.inputs} inputs of {report.frames} validation frames: {source.origin}"
    table = Table("", title=title, title_justify="left")
    names = [name.replace("_", " ") for name in report.written.figures]
    for heading in ("size", *names, "difference", "largest", "CPU"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*_cells(row))
    Console(width=140, highlight=False).print(table)
    calibration, found = report.subject.calibration, report.boundaries
    click.echo(f"temperature {calibration.temperature:.3f}, threshold {calibration.threshold:.2f}")
    click.echo(
        f"boundaries: {found.both} by PyTorch and by the file, {found.alone} by one alone; "
        f"{found.mean:.3f} px apart on average, {found.largest:.2f} at most (of 640 wide)"
    )
    for other, lost in report.lost.items():
        click.echo(f"{report.written.name} against {other}: {lost:.2f} points of accuracy lost")
    if report.time_ratio is not None:
        ratio = f"{report.time_ratio:.2f} of the time ({report.timed_by})"
        click.echo(f"{report.written.name} against fp32, the same network: {ratio}")
    click.echo(f"{out}: {out.stat().st_size:,} bytes")


def _cells(row: Measured) -> list[str]:
    figures = [f"{value:.2f} px" if name.endswith("_px") else f"{value:.4f}" for name, value in row.figures.items()]
    if row.size is None or row.milliseconds is None:
        return [f"{row.name}, PyTorch", "", *figures, "", "", ""]
    size, time = f"{row.size / 1e6:.1f} MB", f"{row.milliseconds:.2f} ms"
    return [f"{row.name} file", size, *figures, f"{row.mean_difference:.1e}", f"{row.largest_difference:.1e}", time]
