"""The command `export`."""

from __future__ import annotations

from pathlib import Path

import click

from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.export import ExportReport, ExportSettings, export_classifier
from lanestream_exporter.patchstore import PatchStore, read_stores
from lanestream_exporter.rendering import real_store
from lanestream_exporter.training.checkpoints import read_checkpoint
from lanestream_exporter.training.patchfiles import patches_of_run

_DATA = click.option(
    "--data",
    type=click.Path(path_type=Path),
    help="Folder of real frames [default: the patches of the run, else $LANESTREAM_DATA].",
)


@click.command()
@click.argument("checkpoint", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--precision", type=click.Choice(["fp32", "int8"]), default=ExportSettings.precision, show_default=True)
@click.option(
    "--rank-energy", type=click.FloatRange(0.5, 1.0), default=ExportSettings.rank_energy, show_default=True,
    help="Share of the hidden layers' variance to keep; 1 keeps the layers as they are.",
)  # fmt: skip
@_DATA
def export(checkpoint: Path, out: Path, precision: str, rank_energy: float, data: Path | None) -> None:
    """Write CHECKPOINT as the ONNX file OUT that serves, after proving that it does the same.

    It is calibrated and proved on the patches of its run, or on those of the real frames in --data.
    """
    read_checkpoint(checkpoint)  # what is no checkpoint is told now, not after the patches have been made
    patches = None if data is not None else patches_of_run(checkpoint.parent)
    train_patches, check = patches or _real_patches(checkpoint.parent / "patches", data_root(data))
    settings = ExportSettings(precision="fp32" if precision == "fp32" else "int8", rank_energy=rank_energy)
    _tell(export_classifier(checkpoint, out, settings, train_patches, check))


def _real_patches(folder: Path, root: Path) -> tuple[PatchStore, PatchStore]:
    train, check = (read_stores([real_store(folder, root, split)]) for split in ("train", "val"))
    return train, check


def _tell(report: ExportReport) -> None:
    click.echo(f"{report.path}: {report.size / 1e6:.1f} MB")
    click.echo(f"temperature {report.calibration.temperature:.3f}, threshold {report.calibration.threshold:.2f}")
    for name, accuracy in report.accuracy.items():
        click.echo(f"accuracy {name}: {accuracy:.4f} of {report.patches} validation patches")
    click.echo(f"difference: {report.mean_difference:.5f} on average, {report.largest_difference:.5f} at most")
