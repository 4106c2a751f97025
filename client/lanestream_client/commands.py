"""The commands `detect` and `stream`: lanes of images and of videos, by a service or in this process.

Whoever mounts them gives the way to load an engine of this process as the context's object, a `Load`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.errors import ImageError, SettingsError, SourceError
from lanestream_client.client import LaneClient
from lanestream_client.in_process import InProcess, LocalEngine
from lanestream_client.live import NewestFrames
from lanestream_client.report import Tally
from lanestream_client.requests import image_bytes
from lanestream_client.sinks import json_lines, video_sink
from lanestream_client.sources import image_files, open_source

if TYPE_CHECKING:
    from lanestream.protocol import LanesMessage, Mode
    from lanestream_client.frames import SourceFrame, StreamResult
    from lanestream_client.service import LaneService
    from lanestream_client.sinks import JsonLines, VideoSink
    from lanestream_client.sources import Source

Load = Callable[[Path | None, str], LocalEngine]
_Command = Callable[..., None]
_INTERRUPTED = 130


def _service_options(command: _Command) -> _Command:
    options = [
        click.option("--url", help="Service to ask, such as http://127.0.0.1:8000  [default: work in this process]"),
        click.option("--model", type=click.Path(path_type=Path), help="ONNX file to run in this process."),
        click.option(
            "--provider",
            type=click.Choice(["auto", "cpu", "cuda"]),
            help="What runs it in this process  [default: auto]",
        ),
        click.option(
            "--horizon",
            type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
            help="Row of the horizon as a share of the image height  [default: estimated]",
        ),
        click.option(
            "--jsonl", type=click.Path(path_type=Path), help="Write one line of JSON a frame; - is the output."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


@click.command()
@click.argument("paths", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="PATH...")
@_service_options
@click.option("--annotate", type=click.Path(path_type=Path, file_okay=False), help="Folder to draw the lanes into.")
@click.pass_context
def detect(
    context: click.Context,
    paths: tuple[Path, ...],
    horizon: float | None,
    jsonl: Path | None,
    annotate: Path | None,
    **where: Any,
) -> None:
    """Find lanes in images: files, or folders of them. Each image stands for itself."""
    files = _files(paths)
    tally = Tally()
    with ExitStack() as stack:
        service = stack.enter_context(_service(context.obj, **where))
        lines = stack.enter_context(json_lines(jsonl))
        advance = stack.enter_context(_progress("images", len(files)))
        for path in files:
            lanes = _detected(service, path, horizon)
            advance()
            if lanes is None:
                tally.fail()
                continue
            tally.answered(lanes)
            if lines is not None:
                lines.write(lanes, file=str(path))
            if lines is None:
                click.echo(f"{path}: {_in_words(lanes)}")
            if annotate is not None:
                _annotate(path, lanes, annotate)
        click.echo(f"\n{tally.report(service.describe())}", err=_is_output(jsonl))
    context.exit(1 if tally.failed else 0)


@click.command()
@click.argument("source")
@_service_options
@click.option(
    "--mode", type=click.Choice(["all", "latest"]), help="Every frame, or the newest  [default: all of a file]"
)
@click.option("--video", type=click.Path(path_type=Path), help="Draw the lanes into this MP4 file.")
@click.option(
    "--fps", type=click.FloatRange(0.1, 1000.0), default=25.0, show_default=True, help="Rate of a folder of images."
)
@click.pass_context
def stream(
    context: click.Context,
    source: str,
    horizon: float | None,
    jsonl: Path | None,
    mode: Mode | None,
    video: Path | None,
    fps: float,
    **where: Any,
) -> None:
    """Follow the lanes of one camera.

    SOURCE is a video file, a folder of images, a camera number or an rtsp:// or http:// URL.
    """
    with ExitStack() as stack:
        camera = stack.enter_context(open_source(source, fps))
        service = stack.enter_context(_service(context.obj, **where))
        outputs = _Outputs(stack.enter_context(json_lines(jsonl)), stack.enter_context(video_sink(video, camera.fps)))
        interrupted = _run(service, camera, mode or ("latest" if camera.live else "all"), horizon, outputs)
        click.echo(outputs.report(service), err=_is_output(jsonl))
    context.exit(_INTERRUPTED if interrupted else 0)
