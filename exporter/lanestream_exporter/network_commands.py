"""The commands `train`, `export` and `evaluate`."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.engine import SHIPPED_MODEL, load_engine
from lanestream.inference.providers import cpu_threads
from lanestream_exporter.alexnet import load_state
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.evaluate import Evaluation
from lanestream_exporter.export import ExportReport, ExportSettings, export_classifier
from lanestream_exporter.patchstore import PatchStore, read_stores
from lanestream_exporter.rendering import real_store, rendered_stores
from lanestream_exporter.score import score as measured
from lanestream_exporter.train import ClassifierTraining, TrainData, TrainSettings, read_checkpoint
from lanestream_exporter.train import Progress as TrainProgress

_DATA = click.option(
    "--data", type=click.Path(path_type=Path), help="Folder of real frames [default: $LANESTREAM_DATA]."
)
_CHECKED = 1000  # rendered patches that validation looks at


@click.group()
def train() -> None:
    """Train a network."""


@train.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--steps", type=click.IntRange(1), default=TrainSettings.steps, show_default=True, help="Batches to learn from."
)
@click.option(
    "--batch", type=click.IntRange(8), default=TrainSettings.batch, show_default=True, help="Patches in a batch."
)
@click.option(
    "--rendered", type=click.IntRange(1), default=20, show_default=True, help="Files of 250 rendered scenes each."
)
@click.option("--init", type=click.Path(path_type=Path), help="torchvision's AlexNet weights to start from.")
@_DATA
def classifier(run: Path, steps: int, batch: int, rendered: int, init: Path | None, data: Path | None) -> None:
    """Train the candidate classifier in the folder RUN; the same command again goes on where it was.

    Renders scenes, cuts patches of them and of the real frames' training split, and mixes the two.
    """
    if init is not None:
        load_state(init)  # what is no checkpoint is told now, not after the patches have been made
    stores = _stores(run / "patches", data_root(data), rendered)
    click.echo(f"{len(stores.rendered)} rendered and {len(stores.real)} real patches to train on")
    training = ClassifierTraining(TrainSettings(steps=steps, batch=batch), stores, run, init)
    with _progress() as bar:
        task = bar.add_task("training", total=steps)

        def told(progress: TrainProgress) -> None:
            bar.update(task, completed=progress.step, description=f"training, loss {progress.loss:.3f}")
            if progress.real_check is not None:
                bar.console.print(
                    f"step {progress.step}: loss {progress.loss:.3f},"
                    f" validation {progress.rendered_check:.3f} rendered, {progress.real_check:.3f} real"
                )

        best = training.run(told)
    click.echo(f"best checkpoint: {best}")


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
    """Write CHECKPOINT as the ONNX file OUT that serves, after proving that it does the same."""
    root = data_root(data)
    read_checkpoint(checkpoint)  # what is no checkpoint is told now, not after the patches have been made
    folder = checkpoint.parent / "patches"
    train_patches = read_stores([real_store(folder, root, "train")])
    check = read_stores([real_store(folder, root, "val")])
    settings = ExportSettings(precision="fp32" if precision == "fp32" else "int8", rank_energy=rank_energy)
    _tell(export_classifier(checkpoint, out, settings, train_patches, check))


@click.command()
@click.option("--model", type=click.Path(path_type=Path), default=SHIPPED_MODEL, show_default="the shipped one")
@click.option("--split", type=click.Choice(["train", "val", "test"]), default="test", show_default=True)
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Also write the figures to this file.")
@_DATA
def evaluate(model: Path, split: str, json_path: Path | None, data: Path | None) -> None:
    """Measure a model file on the labelled real frames of a split.

    Prints candidates (precision, recall, accuracy, proposal recall), and boundaries of single images and of clips.
    """
    root = data_root(data)
    engine = load_engine(model, "cpu")
    evaluation = Evaluation(engine)
    figures = {
        "model": engine.network.name,
        "split": split,
        "images": evaluation.images(root, split),  # type: ignore[arg-type]  # click has checked it
        "clips": evaluation.clips(root, split),  # type: ignore[arg-type]
    }
    text = json.dumps(figures, indent=2)
    click.echo(text)
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        json_path.write_text(text + "\n")


@click.command()
@click.argument("results", type=click.Path(path_type=Path))
@click.argument("labels", type=click.Path(path_type=Path))
def score(results: Path, labels: Path) -> None:
    """Measure RESULTS, a file that `stream --jsonl` wrote, against the LABELS of the clip."""
    click.echo(json.dumps(measured(results, labels), indent=2))


def _stores(folder: Path, root: Path, files: int) -> TrainData:
    """All patches of a run, made where they are missing; the first rendered file is kept for validation."""
    real, real_check = (read_stores([real_store(folder, root, split)]) for split in ("train", "val"))
    with _progress() as bar:
        task = bar.add_task("rendering", total=files + 1)
        paths = rendered_stores(folder, files + 1, cpu_threads(), lambda _: bar.advance(task))
    held_out = read_stores(paths[:1])
    check = PatchStore(held_out.data, held_out.offsets[: _CHECKED + 1], held_out.labels[:_CHECKED])
    return TrainData(read_stores(paths[1:]), real, check, real_check)


def _progress() -> Progress:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns)


def _tell(report: ExportReport) -> None:
    click.echo(f"{report.path}: {report.size / 1e6:.1f} MB")
    click.echo(f"temperature {report.calibration.temperature:.3f}, threshold {report.calibration.threshold:.2f}")
    for name, accuracy in report.accuracy.items():
        click.echo(f"accuracy {name}: {accuracy:.4f} of {report.patches} validation patches")
    click.echo(f"difference: {report.mean_difference:.5f} on average, {report.largest_difference:.5f} at most")
