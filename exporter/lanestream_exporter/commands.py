"""The command `scene`: a rendered clip of a road, to try things with."""

from __future__ import annotations

from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.errors import SettingsError, SourceError, needs_extra


@click.command()
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False), metavar="OUT.mp4")
@click.option("--seed", default=1, show_default=True, help="Another number, another road.")
@click.option("--seconds", type=click.FloatRange(0.1, 600.0), default=8.0, show_default=True, help="Length.")
@click.option("--fps", type=click.FloatRange(1.0, 120.0), default=25.0, show_default=True, help="Frames a second.")
@click.option("--size", default="1280x720", show_default=True, help="Width and height in pixels, both even.")
@click.option("--labels", type=click.Path(path_type=Path, dir_okay=False), help="Where labels go  [default: OUT.jsonl]")
def scene(out: Path, seed: int, seconds: float, fps: float, size: str, labels: Path | None) -> None:
    """Render a clip of a road as a camera in a car sees it, with the exact lane boundaries of every frame."""
    with needs_extra("video"):
        import numpy as np

        from lanestream_exporter.scenes import Drive, sample_clip, write_clip
    width, height = _parse_size(size)
    frames = max(1, round(seconds * fps))
    clip = sample_clip(np.random.default_rng(seed), width, height, frames, fps, Drive(lane_change=True, fair=True))
    console = Console(stderr=True)
    columns = [TextColumn("frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    labels = labels or out.with_suffix(".jsonl")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
            task = bar.add_task("frames", total=frames)
            write_clip(clip, out, labels, lambda done, _: bar.update(task, completed=done))
    except OSError as error:
        raise SourceError(f"can't write {out}: {(error.strerror or str(error)).lower()}") from None
    click.echo(f"{out}: {frames} frames of {width} x {height} at {fps:g} a second; labels in {labels}")


def _parse_size(size: str) -> tuple[int, int]:
    """Width and height of `640x360`. Raises SettingsError where they are none, odd, or no camera's."""
    width, _, height = size.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise SettingsError(f"--size {size} is no size", "1280x720 would be one")
    numbers = int(width), int(height)
    if numbers[0] % 2 or numbers[1] % 2 or min(numbers) < 180 or max(numbers) > 4096:
        raise SettingsError(f"--size {size} can't be rendered", "both are even, at least 180 and at most 4096")
    return numbers
