"""The command `train`."""

from __future__ import annotations

from pathlib import Path

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.inference.providers import cpu_threads
from lanestream_exporter.alexnet import load_state
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.patchstore import PatchStore, read_stores
from lanestream_exporter.rendering import real_store, rendered_stores
from lanestream_exporter.train import ClassifierTraining, TrainData, TrainSettings
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
