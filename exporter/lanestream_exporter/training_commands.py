"""The command `train`."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lanestream_exporter.samples.patch_files import PatchStores
from lanestream_exporter.training.classifier import ClassifierTask, starting_network
from lanestream_exporter.training.config import SHIPPED, ClassifierConfig, TrainConfig, read_config
from lanestream_exporter.training.device import best_device, described
from lanestream_exporter.training.framesources import frame_sources
from lanestream_exporter.training.loop import Progress as Learnt
from lanestream_exporter.training.loop import Run, Task
from lanestream_exporter.training.regressor import RegressorConfig, RegressorTask, starting_regressor
from lanestream_exporter.training.sources import origin_of, patch_files

_INTERRUPTED = 130

_RUN = click.option(
    "--run", "folder", type=click.Path(path_type=Path), required=True, help="Folder of the run; made where missing."
)
_DATA = click.option(
    "--data", type=click.Path(path_type=Path), help="Folder of real frames [default: $LANESTREAM_DATA]."
)


@click.group()
def train() -> None:
    """Train a network. The same command again goes on where the run was."""


@train.command()
@click.argument("config", type=click.Path(path_type=Path), default=Path("classifier"))
@_RUN
@_DATA
@click.option("--patches", type=click.Path(path_type=Path), help="Folder that keeps the patches [default: in the run].")
def classifier(config: Path, folder: Path, data: Path | None, patches: Path | None) -> None:
    """Train the candidate classifier as CONFIG says: a TOML file, or the name of a shipped one.

    Renders scenes, cuts patches of them and of real frames, and mixes the two.
    """
    settings = read_config(config, ClassifierConfig)
    network = starting_network(settings)  # what is no checkpoint is told now, not after the patches have been made
    guide = settings.data.guide
    with _bar("rendering") as advance:
        stores = PatchStores(patches or folder / "patches", settings.network.size, Path(guide) if guide else None)
        files = patch_files(settings.data, stores, data, advance)
    sources = [part.read() for part in files]
    for source in sources:
        click.echo(f"{source.name}: {len(source.train)} patches to train on, {len(source.check)} to validate with")
    _learn(ClassifierTask(settings, network, sources, origin_of(settings.data)), settings, folder)


@train.command()
@click.argument("config", type=click.Path(path_type=Path), default=Path("regressor"))
@_RUN
@_DATA
@click.option("--frames", type=click.Path(path_type=Path), help="Folder that keeps the scenes [default: in the run].")
def regressor(config: Path, folder: Path, data: Path | None, frames: Path | None) -> None:
    """Train the regressor as CONFIG says: a TOML file, or the name of a shipped one.

    Renders scenes, and moves them and the real frames as other cameras and roads would show them.
    """
    settings = read_config(config, RegressorConfig)
    network = starting_regressor(settings)
    with _bar("rendering") as advance:
        sources = frame_sources(settings.data, frames or folder / "frames", data, advance)
    for source in sources:
        click.echo(f"{source.name}: {len(source.train)} frames to train on, {len(source.check)} to validate with")
    _learn(RegressorTask(settings, network, sources, origin_of(settings.data)), settings, folder)


@train.command()
@click.argument("name", type=click.Choice(sorted(path.stem for path in SHIPPED.glob("*.toml"))))
def recipe(name: str) -> None:
    """Print the shipped configuration NAME, to start one's own from."""
    click.echo((SHIPPED / f"{name}.toml").read_text(encoding="utf-8"), nl=False)


def _learn(task: Task, config: TrainConfig, folder: Path) -> None:
    """Trains to the end or to an interruption, and tells how it goes."""
    run = Run(task, config, folder)
    click.echo(f"training on {described(best_device())}" + (f" from step {run.step} on" if run.step else ""))
    with interruptible() as stopped, _progress() as bar:
        shown = bar.add_task("training", total=config.steps, completed=run.step)

        def told(learnt: Learnt) -> None:
            bar.update(shown, completed=learnt.step, description=f"training, loss {learnt.loss:.3f}")
            if learnt.figures:
                figures = ", ".join(f"{name.replace('_', ' ')} {value:.4f}" for name, value in learnt.figures.items())
                bar.console.print(
                    f"step {learnt.step}: loss {learnt.loss:.3f}, {figures}", highlight=False, soft_wrap=True
                )

        run.go(told, stopped)
    if not run.finished:
        click.echo(f"stopped after step {run.step}; the same command again goes on from there")
        raise click.exceptions.Exit(_INTERRUPTED)
    click.echo(f"best checkpoint: {run.best}")


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C in the block makes the yielded function true, so that a step is never cut in two; a second one ends it."""
    asked = False

    def ask(_number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar that is told (how many more are done, how many there are)."""
    with _progress() as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, total: bar.update(task, advance=done, total=total)


def _progress() -> Progress:
    columns = BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    return Progress(TextColumn("{task.description}"), *columns)
