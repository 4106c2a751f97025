"""The command `export`."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from rich.console import Console
from rich.table import Table

from lanestream.errors import ExportError
from lanestream.writing import check_file
from lanestream_exporter.choices import NORMALIZATIONS, PRECISIONS

if TYPE_CHECKING:
    from lanestream.road.crops import PatchGeometry
    from lanestream_exporter.datasets.manifest import DatasetCollection
    from lanestream_exporter.exporting.checkpoint import ForeignNetwork
    from lanestream_exporter.exporting.export import ExportReport
    from lanestream_exporter.exporting.exportable import ExportableNetwork
    from lanestream_exporter.exporting.frames import ExportFrames
    from lanestream_exporter.exporting.proof import ModelMeasurement

_PATCH_KEYS: Final = {"size": int, "half_width": float, "min_half_width": float, "obliquity": float}
# The checkpoints of a run; the folder's name says which run it was.
_RUN_FILES: Final = ("best.pt", "last.pt")
# Names and versions appear in messages, metrics and logs.
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,63}")
_OUTSIDE_NAMES: Final = re.compile(r"[^A-Za-z0-9._+-]+")


def _classes(_context: click.Context, _option: click.Parameter, value: str | None) -> tuple[str, ...] | None:
    return None if value is None else tuple(name.strip() for name in value.split(","))


def _patch_geometry(_context: click.Context, _option: click.Parameter, value: str | None) -> PatchGeometry | None:
    """Parses `size=224,half_width=0.5,min_half_width=5`; keys that are not given have their defaults."""
    if value is None:
        return None
    from lanestream.road.crops import PatchGeometry
    from lanestream_exporter.alexnet import FULL

    given: dict[str, Any] = {"size": FULL.size}
    for part in filter(None, value.split(",")):
        key, _, number = (text.strip() for text in part.partition("="))
        if key not in _PATCH_KEYS:
            raise click.BadParameter(f"unknown key {key!r}; accepted: {', '.join(_PATCH_KEYS)}")
        try:
            given[key] = _PATCH_KEYS[key](number)
        except ValueError:
            raise click.BadParameter(f"{key} must be a number, not {number!r}") from None
        if not (0 < given[key] < math.inf or (key == "obliquity" and given[key] == 0)):
            raise click.BadParameter(f"{key} must be above 0")
    return PatchGeometry(**given)


def _checked_name(_context: click.Context, _option: click.Parameter, value: str | None) -> str | None:
    if value is not None and not _NAME.fullmatch(value):
        raise click.BadParameter(f"{value!r} is not accepted; give up to 64 letters, digits and . _ + -")
    return value


def default_name(checkpoint: Path) -> str:
    """Returns the name of the run that a checkpoint belongs to, or of the file itself, as a name for the model."""
    path = checkpoint.absolute()
    source = path.parent.name if path.name in _RUN_FILES else path.stem
    return _OUTSIDE_NAMES.sub("-", source).strip("-._+")[:64] or "model"


@click.command()
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--precision",
    type=click.Choice(PRECISIONS),
    default="int8",
    show_default=True,
    help="int8 for CPUs, fp16 for GPUs.",
)
@click.option(
    "--rank-energy", type=click.FloatRange(0.5, 1.0),
    help="Share of the hidden layers' variance to keep; 1 keeps the layers unchanged."
    "  [default: 0.998 for a classifier, 0.9999 for a regressor]",
)  # fmt: skip
@click.option(
    "--tolerance", type=click.FloatRange(0.0, 100.0), default=0.5, show_default=True,
    help="Points of accuracy that the file may lose.",
)  # fmt: skip
@click.option(
    "--data", type=click.Path(path_type=Path), envvar="LANESTREAM_DATA", show_envvar=True,
    help="Folder of real frames; without it only rendered scenes are used. A network trained on frames of your own is"
    " verified on those.",
)  # fmt: skip
@click.option(
    "--scenes", type=click.IntRange(4), default=48, show_default=True,
    help="Number of rendered scenes for calibration, and again for verification.",
)  # fmt: skip
@click.option(
    "--regressor", type=click.Path(path_type=Path), metavar="FILE|shipped|none",
    help="For a classifier: the regressor that it will be served with.  [default: shipped]",
)  # fmt: skip
@click.option(
    "--name", callback=_checked_name, help="Name of the model in messages and reports.  [default: the run's folder]"
)
@click.option("--version", callback=_checked_name, help="Version of the model.  [default: the date, as 2026-01-31]")
@click.option("--classes", callback=_classes, help="For a torchvision AlexNet: its classes in order, e.g. false,lane.")
@click.option(
    "--patch", callback=_patch_geometry,
    help="For a torchvision AlexNet: the geometry of its patches, e.g. size=224,half_width=0.5,min_half_width=5.",
)  # fmt: skip
@click.option(
    "--normalization", type=click.Choice(NORMALIZATIONS), default="imagenet", show_default=True,
    help="For a torchvision AlexNet: the pixel normalization of its training.",
)  # fmt: skip
def export(checkpoint: Path, out: Path, **given: Any) -> None:
    """Write CHECKPOINT as the ONNX file OUT for serving, after verifying that both give the same results."""
    from lanestream_exporter.exporting.checkpoint import read_network
    from lanestream_exporter.exporting.export import ExportSettings, Provenance, export_network
    from lanestream_exporter.exporting.frames import ExportFrames

    if out.is_dir():
        raise ExportError(f"{out} is a folder", "give the path of the file to write")
    check_file(out)
    foreign = _foreign_network(given["classes"], given["patch"], given["normalization"])
    # An invalid checkpoint must fail now, not after the frames have been prepared.
    network, training = read_network(checkpoint, foreign)
    network = _with_prior(network, given["regressor"])
    frames = ExportFrames(_datasets(training, given["data"]), rendered=given["scenes"])
    energy = network.default_rank_energy if given["rank_energy"] is None else given["rank_energy"]
    name = given["name"] or default_name(checkpoint)
    version = given["version"] or datetime.now(UTC).date().isoformat()
    settings = ExportSettings(name, version, energy, given["precision"], given["tolerance"])
    _print_report(out, export_network(network, out, settings, Provenance(training, frames), click.echo), frames)
    click.echo(f"model {name} {version}")


def _with_prior(network: ExportableNetwork, regressor: Path | None) -> ExportableNetwork:
    """Returns a classifier with the prior of `regressor`, as it is served; returns a regressor unchanged."""
    from lanestream.engine import resolve_regressor
    from lanestream_exporter.exporting.classifier import ExportableClassifier
    from lanestream_exporter.samples.prior_regressor import load_prior_regressor

    if isinstance(network, ExportableClassifier):
        path = resolve_regressor(regressor)
        return network if path is None else replace(network, prior=load_prior_regressor(path))
    if regressor is not None:
        raise click.UsageError("--regressor is only for classifiers; CHECKPOINT is a regressor")
    return network


def _datasets(training: dict[str, Any], data: Path | None) -> DatasetCollection | None:
    """Returns the data sets that a network was trained with; None if their frames are not available.

    The shipped manifest is only used with a data folder, `data`.
    """
    from lanestream_exporter.datasets.manifest import DatasetCollection

    recipe = training.get("config", {}).get("data", {})
    manifest = recipe.get("manifest")
    if manifest is not None and Path(manifest).is_file():
        return DatasetCollection.open(Path(manifest), data).without(recipe.get("without", ()))
    return None if data is None else DatasetCollection.open(None, data).without(recipe.get("without", ()))


def _foreign_network(
    classes: tuple[str, ...] | None, geometry: PatchGeometry | None, normalization: str
) -> ForeignNetwork | None:
    from lanestream_exporter.exporting.checkpoint import ForeignNetwork

    if classes is None and geometry is None:
        return None
    if classes is None or geometry is None:
        raise click.UsageError("a torchvision AlexNet needs both --classes and --patch")
    return ForeignNetwork(classes, geometry, normalization)


def _print_report(out: Path, report: ExportReport, frames: ExportFrames) -> None:
    rows = [report.checkpoint, report.fp32, *([] if report.written is report.fp32 else [report.written])]
    title = f"{report.inputs} inputs of {report.frames} validation frames: {frames.origin}"
    table = Table("", title=title, title_justify="left")
    names = [name.replace("_", " ") for name in report.written.metrics]
    for heading in ("size", *names, "difference", "largest", "CPU"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*_cells(row))
    Console(width=140, highlight=False).print(table)
    calibration, compared = report.network.calibration, report.boundaries
    click.echo(f"temperature {calibration.temperature:.3f}, threshold {calibration.threshold:.2f}")
    click.echo(
        f"boundaries: {compared.matched} found by both PyTorch and the file, {compared.unmatched} by only one; "
        f"distance {compared.mean:.3f} px on average, {compared.largest:.2f} px at most (at 640 px width)"
    )
    for reference, lost in report.lost.items():
        click.echo(f"{report.written.name} against {reference}: {lost:.2f} points of accuracy lost")
    if report.time_ratio is not None:
        ratio = f"{report.time_ratio:.2f} of the time ({report.timing_provider})"
        click.echo(f"{report.written.name} against fp32, the same network: {ratio}")
    click.echo(f"{out}: {out.stat().st_size:,} bytes")


def _cells(row: ModelMeasurement) -> list[str]:
    metrics = [f"{value:.2f} px" if name.endswith("_px") else f"{value:.4f}" for name, value in row.metrics.items()]
    if row.size is None or row.milliseconds is None:
        return [f"{row.name}, PyTorch", "", *metrics, "", "", ""]
    size, time = f"{row.size / 1e6:.1f} MB", f"{row.milliseconds:.2f} ms"
    return [f"{row.name} file", size, *metrics, f"{row.mean_difference:.1e}", f"{row.largest_difference:.1e}", time]
