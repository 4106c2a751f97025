"""The command `scene`: renders a clip of a road with its labels, for experiments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.errors import SourceError
from lanestream_exporter.choices import CLIP_KINDS, ROAD_STYLES

if TYPE_CHECKING:
    from lanestream_exporter.scenes.clip import ProgressCallback


class SizeType(click.ParamType[tuple[int, int]]):
    """A click type for WIDTHxHEIGHT in pixels, both even, as video encoders require."""

    name = "WIDTHxHEIGHT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Returns (width, height); fails with a message that says what is accepted."""
        try:
            width, height = (int(part) for part in str(value).lower().split("x"))
        except ValueError:
            self.fail(f"{value!r} is not a valid size; give WIDTHxHEIGHT, for example 1280x720", param, ctx)
        if not (320 <= width <= 3840 and 180 <= height <= 2160) or width % 2 or height % 2:
            self.fail(f"{value!r} is not supported; give even numbers from 320x180 to 3840x2160", param, ctx)
        return width, height


@click.command()
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False), metavar="OUT.mp4")
@click.option(
    "--kind",
    type=click.Choice(CLIP_KINDS),
    help="A clip that tries a tracker, with its truth in meters; docs/training.md describes them.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=24,
    show_default=True,
    help="Seed of the random road.",
)
@click.option("--seconds", type=click.FloatRange(0.1, 600.0), help="Length of an ordinary drive.  [default: 8]")
@click.option("--fps", default=25.0, show_default=True, type=click.FloatRange(1.0, 120.0))
@click.option("--size", default="1280x720", show_default=True, type=SizeType())
@click.option(
    "--style",
    type=click.Choice(ROAD_STYLES),
    help="Road of an ordinary drive.  [default: highway]",
)
@click.option("--any-weather", is_flag=True, help="Sample night, rain, fog and camera faults too, not only clear days.")
@click.option("--labels", type=click.Path(path_type=Path, dir_okay=False), help="Labels file  [default: OUT.jsonl]")
def scene(
    out: Path,
    kind: str | None,
    seed: int,
    seconds: float | None,
    fps: float,
    size: tuple[int, int],
    style: Any,
    any_weather: bool,
    labels: Path | None,
) -> None:
    """Render a drive to the video OUT.mp4, with exact labels for every frame."""
    import numpy as np

    from lanestream_exporter.scenes import Drive, sample_clip, write_clip
    from lanestream_exporter.scenes.tracking_clips import sample_tracking_clip
    from lanestream_exporter.scenes.tracking_truth import write_tracking_clip

    labels = labels or out.with_suffix(".jsonl")
    if kind and (seconds or style or any_weather):
        raise click.UsageError("--seconds, --style and --any-weather don't apply to a --kind; leave them out")
    if kind:
        tracking_clip = sample_tracking_clip(kind, seed, size, fps)
        frames = len(tracking_clip.deliveries)
        render = partial(write_tracking_clip, tracking_clip, fps)
    else:
        drive, frames = Drive(style or "highway", fair=not any_weather), max(1, round((seconds or 8.0) * fps))
        clip = sample_clip(np.random.default_rng(seed), *size, frames=frames, fps=fps, drive=drive)
        render = partial(write_clip, clip)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        _show_progress(frames, partial(render, out, labels))
    except OSError as error:
        raise SourceError(f"can't write {out}: {(error.strerror or str(error)).lower()}") from None
    click.echo(f"{out}: {frames} frames of {size[0]} x {size[1]}, {fps:g} per second; labels in {labels}")


def _show_progress(frames: int, render: Callable[[ProgressCallback], None]) -> None:
    console = Console(stderr=True)
    columns = [TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("frames", total=frames)
        render(lambda done: bar.update(task, completed=done))
