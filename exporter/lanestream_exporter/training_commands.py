"""The command `train`."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lanestream.writing import check_file, check_folder
from lanestream_exporter.toml_files import CONFIG_FOLDER

if TYPE_CHECKING:
    from lanestream_exporter.training.config import C, TrainConfig
    from lanestream_exporter.training.loop import Task, TrainingProgress

_INTERRUPTED = 130

_RUN = click.option(
    "--run", "folder", type=click.Path(path_type=Path), required=True, help="Folder of the run; created if missing."
)
_INITIAL = click.option(
    "--initial", metavar="FILE", help="Start from this checkpoint, or from `shipped`, instead of the recipe's."
)
_MANIFEST = click.option(
    "--manifest", metavar="FILE", help="Train on the data sets of this manifest instead of the recipe's."
)
_DATA = click.option(
    "--data",
    type=click.Path(path_type=Path),
    help="Folder that the paths of the data set manifest count from."
    "  [default: $LANESTREAM_DATA, else the manifest's folder]",
)


@click.group()
def train() -> None:
    """Train a network. Run the same command again to resume."""


@train.command()
@click.argument("config", type=click.Path(path_type=Path), default=Path("classifier"))
@_RUN
@_INITIAL
@_MANIFEST
@_DATA
@click.option("--patches", type=click.Path(path_type=Path), help="Folder for the patches.  [default: in the run]")
def classifier(
    config: Path, folder: Path, initial: str | None, manifest: str | None, data: Path | None, patches: Path | None
) -> None:
    """Train the candidate classifier by the recipe CONFIG: a TOML file, or the name of a shipped one.

    Renders scenes, cuts patches from them and from real frames, and mixes the two.
    """
    from lanestream_exporter.datasets.manifest import origin_of
    from lanestream_exporter.samples.patch_files import PatchCache
    from lanestream_exporter.training.classifier import ClassifierTask, starting_network
    from lanestream_exporter.training.config import ClassifierConfig, read_config
    from lanestream_exporter.training.data_sources import open_datasets, patch_files

    settings = _changed(read_config(config, ClassifierConfig), initial, manifest)
    check_folder(folder)
    network = starting_network(settings)  # before the patches, so that a bad checkpoint is reported early
    datasets = open_datasets(settings.data, data)
    cache = PatchCache(patches or folder / "patches", settings.network.size, settings.data.regressor_file)
    with _bar("rendering") as advance:
        files = patch_files(settings.data, datasets, cache, advance)
    sources = [part.read() for part in files]
    for source in sources:
        click.echo(f"{source.name}: {len(source.train)} patches to train on, {len(source.check)} to validate with")
    origin = origin_of(datasets, settings.data.rendered_scenes)
    _train(ClassifierTask(settings, network, sources, origin), settings, folder)


@train.command()
@click.argument("config", type=click.Path(path_type=Path), default=Path("regressor"))
@_RUN
@_INITIAL
@_MANIFEST
@_DATA
@click.option("--frames", type=click.Path(path_type=Path), help="Folder for the scenes.  [default: in the run]")
def regressor(
    config: Path, folder: Path, initial: str | None, manifest: str | None, data: Path | None, frames: Path | None
) -> None:
    """Train the regressor by the recipe CONFIG: a TOML file, or the name of a shipped one.

    Renders scenes, and warps them and real frames as other cameras and roads would show them.
    """
    from lanestream_exporter.datasets.manifest import origin_of
    from lanestream_exporter.training.config import RegressorConfig, read_config
    from lanestream_exporter.training.data_sources import frame_sources, open_datasets
    from lanestream_exporter.training.regressor import RegressorTask, starting_regressor

    settings = _changed(read_config(config, RegressorConfig), initial, manifest)
    check_folder(folder)
    network = starting_regressor(settings)
    datasets = open_datasets(settings.data, data)
    with _bar("rendering") as advance:
        sources = frame_sources(settings.data, datasets, frames or folder / "frames", advance)
    for source in sources:
        click.echo(f"{source.name}: {len(source.train)} frames to train on, {len(source.check)} to validate with")
    origin = origin_of(datasets, settings.data.rendered_scenes)
    _train(RegressorTask(settings, network, sources, origin), settings, folder)


@train.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
def checkpoint(source: Path, out: Path) -> None:
    """Write the checkpoint SOURCE of a run to OUT in half precision, as a small file for others to start from."""
    from lanestream_exporter.training.shipped import write_half

    check_file(out)
    write_half(source, out)
    click.echo(f"{out}: {out.stat().st_size / 1e6:.1f} MB")


@train.command()
@click.argument("name", type=click.Choice(sorted(path.stem for path in CONFIG_FOLDER.glob("*.toml"))))
def recipe(name: str) -> None:
    """Print the shipped recipe NAME, or the manifest `datasets`, as a starting point for your own."""
    click.echo((CONFIG_FOLDER / f"{name}.toml").read_text(encoding="utf-8"), nl=False)


def _changed(config: C, initial: str | None, manifest: str | None) -> C:
    """Returns the recipe with other initial weights and another manifest, unless they are None."""
    given = config.model_dump(exclude_unset=True)
    if initial is not None:
        given["initial"] = initial
    if manifest is not None:
        given.setdefault("data", {})["manifest"] = manifest
    return type(config).model_validate(given)


def _train(task: Task, config: TrainConfig, folder: Path) -> None:
    """Trains to the end or until interrupted, and shows the progress."""
    from lanestream_exporter.training.loop import Run, best_device, describe_device

    run = Run(task, config, folder)
    click.echo(f"training on {describe_device(best_device())}" + (f" from step {run.step} on" if run.step else ""))
    with interruptible() as stopped, _progress() as bar:
        shown = bar.add_task("training", total=config.steps, completed=run.step)

        def report(progress: TrainingProgress) -> None:
            bar.update(shown, completed=progress.step, description=f"training, loss {progress.loss:.3f}")
            if progress.figures:
                figures = ", ".join(f"{name.replace('_', ' ')} {value:.4f}" for name, value in progress.figures.items())
                bar.console.print(
                    f"step {progress.step}: loss {progress.loss:.3f}, {figures}", highlight=False, soft_wrap=True
                )

        run.train(report, stopped)
    if not run.finished:
        click.echo(f"stopped after step {run.step}; run the same command again to resume")
        raise click.exceptions.Exit(_INTERRUPTED)
    click.echo(f"best checkpoint: {run.best}")


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Yields a function that returns true after Ctrl-C, so that a step can be finished; a second Ctrl-C interrupts."""
    requested = False

    def request(_number: int, _frame: FrameType | None) -> None:
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True

    before = {number: signal.signal(number, request) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """Shows a progress bar; the yielded function takes the number of items just done and the number of all."""
    with _progress() as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, advance=done, total=total)


def _progress() -> Progress:
    columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *columns)
