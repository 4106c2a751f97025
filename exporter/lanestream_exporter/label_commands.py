"""The command `label`: pre-labels for a labeling team."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

import click
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn

from lanestream.errors import LanestreamError, SourceError
from lanestream.writing import writing
from lanestream_exporter.choices import PRELABEL_FORMATS

if TYPE_CHECKING:
    from lanestream_exporter.labeling.prelabels import PrelabeledFrame

_SHOWN: Final = 5  # of the hardest frames
_USUAL_STEP_S: Final = 1.0


@click.command()
@click.argument("inputs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="IMAGES|VIDEO...")
@click.argument("out", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--format", "format_name", type=click.Choice(PRELABEL_FORMATS), required=True, help="The format of the labels."
)
@click.option("--hardest", type=click.IntRange(1), metavar="N", help="Keep the N hardest frames only.")
@click.option(
    "--every", type=click.FloatRange(0.0, min_open=True), metavar="SECONDS",
    help=f"Time between two frames of a video.  [default: {_USUAL_STEP_S:g}]",
)  # fmt: skip
@click.option("--model", type=click.Path(path_type=Path), help="ONNX file.  [default: the shipped classifier]")
@click.option("--regressor", type=click.Path(path_type=Path), help="ONNX file.  [default: the shipped regressor]")
def label(
    inputs: tuple[Path, ...],
    out: Path,
    format_name: str,
    hardest: int | None,
    every: float | None,
    model: Path | None,
    regressor: Path | None,
) -> None:
    """Find the lanes in images or in a video and write them to the new folder OUT as labels to correct.

    The input is a folder of images, image files, or a video. Frames are ordered by how much the two detectors disagree
    about them, the hardest first; docs/labeling.md describes the order and each format.
    """
    from lanestream.engine import load_engine, resolve_regressor
    from lanestream_exporter.labeling.frames import Labeler, image_paths
    from lanestream_exporter.labeling.writers import REPORT, hardest_first, require_new, write_task

    paths = image_paths(inputs)
    if paths is not None and every is not None:
        raise click.UsageError("--every is for a video; leave it out")
    require_new(out)
    labeler = Labeler(load_engine(model, regressor=resolve_regressor(regressor)))
    skipped: list[LanestreamError] = []
    with writing(out), TemporaryDirectory(dir=out) as folder:
        found = (
            labeler.images(paths, skipped.append)
            if paths is not None
            else labeler.video(inputs[0], every or _USUAL_STEP_S, Path(folder))
        )
        all_frames = list(_with_progress(found))
        frames = hardest_first(all_frames, hardest)
        if frames:
            written = write_task(frames, out, format_name)
    for error in skipped:
        click.echo(f"skipped: {error}", err=True)
    if not frames:
        if paths is None:
            raise SourceError(f"{inputs[0]} has no frames", "give a video that can be decoded")
        raise SourceError("none of the images can be used", "the reasons are listed above")
    _print_summary(frames, len(all_frames), written, out / REPORT)


def _with_progress(frames: Iterator[PrelabeledFrame]) -> Iterator[PrelabeledFrame]:
    console = Console(stderr=True)
    columns = TextColumn("frames"), MofNCompleteColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task("frames", total=None)
        for frame in frames:
            bar.advance(task)
            yield frame


def _print_summary(frames: list[PrelabeledFrame], looked_at: int, written: Path, report: Path) -> None:
    of = "" if looked_at == len(frames) else f" of {looked_at}"
    lanes = sum(len(frame.lanes) for frame in frames)
    click.echo(f"{written}: {len(frames)}{of} frames with {lanes} boundaries, the hardest first")
    click.echo(f"{report}: score and reason of each frame; the hardest:")
    for frame in frames[:_SHOWN]:
        click.echo(f"  {frame.difficulty.score:.2f}  {frame.source}  {frame.difficulty.reason}")
