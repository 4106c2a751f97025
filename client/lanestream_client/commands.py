"""The commands `detect` and `stream`: lanes of images and of videos, by a service or in this process.

Whoever mounts them gives the way to load an engine of this process as the context's object, a `Load`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.errors import ImageError, LanestreamError, LostError, SourceError, needs_extra
from lanestream.protocol import parse_camera
from lanestream.runtime import PROVIDERS
from lanestream_client.client import LaneClient
from lanestream_client.failover import Patience
from lanestream_client.frames import SourceFrame
from lanestream_client.in_process import InProcess, LocalEngine
from lanestream_client.live import NewestFrames
from lanestream_client.report import Tally
from lanestream_client.requests import image_bytes
from lanestream_client.service import ServiceInfo
from lanestream_client.sinks import json_lines, video_sink
from lanestream_client.sources import image_files, open_source

if TYPE_CHECKING:
    from lanestream.protocol import DetectorName, LanesMessage, Mode
    from lanestream_client.frames import StreamResult
    from lanestream_client.service import LaneService, ResultStream
    from lanestream_client.sinks import JsonLines, VideoSink
    from lanestream_client.sources import Source

Load = Callable[[Path | None, str, Path | None], LocalEngine]
_Command = Callable[..., None]
_INTERRUPTED = 130


def _service_options(command: _Command) -> _Command:
    options = [
        click.option(
            "--url",
            multiple=True,
            help="Service to ask, such as http://127.0.0.1:8000; each of its replicas  [default: work in this process]",
        ),
        click.option(
            "--api-key",
            envvar="LANESTREAM_API_KEY",
            show_envvar=True,
            metavar="KEY",
            help="What opens the service, where it asks for a key.",
        ),
        click.option("--model", type=click.Path(path_type=Path), help="ONNX file to run in this process."),
        click.option(
            "--regressor",
            type=click.Path(path_type=Path),
            metavar="FILE|none",
            help="ONNX file of the second network in this process, or none  [default: the shipped one]",
        ),
        click.option(
            "--provider",
            type=click.Choice(PROVIDERS),
            help="What runs them in this process  [default: auto]",
        ),
        click.option(
            "--detector",
            type=click.Choice(["candidates", "regression"]),
            help="What finds the lanes  [default: that of the model]",
        ),
        click.option(
            "--horizon",
            type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True),
            help="Row of the horizon as a share of the image height  [default: estimated]",
        ),
        click.option(
            "--camera-height",
            type=click.FloatRange(0.3, 4.0),
            metavar="M",
            help="Metres up to the camera, with --field-of-view: lanes in metres too",
        ),
        click.option(
            "--field-of-view",
            type=click.FloatRange(20.0, 150.0),
            metavar="DEG",
            help="Horizontal field of view of the camera in degrees",
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
    /,
    paths: tuple[Path, ...],
    detector: DetectorName | None,
    horizon: float | None,
    camera_height: float | None,
    field_of_view: float | None,
    jsonl: Path | None,
    annotate: Path | None,
    **where: Any,
) -> None:
    """Find lanes in images: files, or folders of them. Each image stands for itself."""
    files = _files(paths)
    camera = parse_camera(camera_height, field_of_view)
    tally = Tally()
    with ExitStack() as stack:
        service = stack.enter_context(_service(context.obj, **where))
        lanes_of = partial(service.detect, horizon=horizon, detector=detector, camera=camera)
        lines = stack.enter_context(json_lines(jsonl))
        advance = stack.enter_context(_progress("images", len(files)))
        for path in files:
            lanes = _detected(lanes_of, path)
            advance()
            if lanes is None:
                tally.fail()
                continue
            tally.answered(lanes)
            if lines is None:
                click.echo(f"{path}: {_in_words(lanes)}")
            else:
                lines.write(lanes, file=str(path))
            if annotate is not None:
                _annotate(path, lanes, annotate)
        click.echo(f"\n{tally.report(service.describe(detector))}", err=_is_output(jsonl))
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
@click.option(
    "--reconnect",
    type=click.FloatRange(min=0.0),
    metavar="SECONDS",
    help="How long a lost connection is sought; 0 is not at all  [default: 30]",
)
@click.option("--session", metavar="NAME", help="A name for the stream in the service's logs.")
@click.pass_context
def stream(
    context: click.Context,
    /,
    source: str,
    detector: DetectorName | None,
    horizon: float | None,
    camera_height: float | None,
    field_of_view: float | None,
    jsonl: Path | None,
    mode: Mode | None,
    video: Path | None,
    fps: float,
    session: str | None,
    **where: Any,
) -> None:
    """Follow the lanes of one camera.

    SOURCE is a video file, a folder of images, a camera number or an rtsp:// or http:// URL.
    """
    model = parse_camera(camera_height, field_of_view)
    if session is not None and not where["url"]:
        raise click.UsageError("--session is for the service at --url")
    with ExitStack() as stack:
        camera = stack.enter_context(open_source(source, fps))
        service = stack.enter_context(_service(context.obj, **where))
        lines = stack.enter_context(json_lines(jsonl))
        outputs = _Outputs(lines, stack.enter_context(video_sink(video, camera.fps)))
        mode = mode or ("latest" if camera.live else "all")
        follow = partial(service.stream, mode=mode, horizon=horizon, detector=detector, camera=model, session=session)
        try:
            interrupted = _follow(follow, camera, outputs, mode)
        except LanestreamError:
            if outputs.tally.frames:
                click.echo(outputs.report(service, detector), err=_is_output(jsonl))
            raise
        click.echo(outputs.report(service, detector), err=_is_output(jsonl))
    context.exit(_INTERRUPTED if interrupted else 0)


class _Outputs:
    """What is done with every result of a stream."""

    def __init__(self, lines: JsonLines | None, video: VideoSink | None) -> None:
        self.tally = Tally()
        self.dropped = 0
        self.info: ServiceInfo | None = None
        self._reconnects = 0
        self._lines = lines
        self._video = video

    def take(self, result: StreamResult) -> None:
        """Counts a result, and writes it to where it was asked to go."""
        if result.lanes is not None:
            self.tally.answered(result.lanes)
        elif result.error is not None:
            self.tally.fail(lost=result.error.code == LostError.code)
            click.echo(f"frame {result.frame.seq}: {result.error.message}", err=True)
        message = result.lanes or result.error
        if self._lines is not None and message is not None:
            self._lines.write(message, **({"file": result.frame.name} if result.frame.name else {}))
        if self._video is not None:
            self._draw(result, self._video)

    def watch(self, results: ResultStream) -> None:
        """Keeps what the stream knows of the service, and says so where its connection was lost and is back."""
        if (ready := results.ready) is None:
            return
        self.info = ServiceInfo(ready.model, ready.provider)
        if results.reconnects > self._reconnects:
            self._reconnects = results.reconnects
            how = "goes on" if ready.resumed else "begins afresh, with new track ids"
            click.echo(f"the connection was lost and is back: session {ready.session} {how}", err=True)

    def report(self, service: LaneService, detector: DetectorName | None) -> str:
        """The closing lines; a service that has said what it runs may be gone by now."""
        return self.tally.report(self.info or service.describe(detector), self.dropped)

    def _draw(self, result: StreamResult, video: VideoSink) -> None:
        from lanestream_client.overlays import draw_error, draw_lanes

        with suppress(ImageError):  # there is nothing to draw on
            image = result.frame.image()
            if result.lanes is not None:
                image = draw_lanes(image, result.lanes)
            elif result.error is not None:
                image = draw_error(image, result.error)
            video.write(image, result.frame.timestamp)


def _follow(stream: Callable[..., ResultStream], camera: Source, outputs: _Outputs, mode: Mode) -> bool:
    """Takes the camera's frames to `outputs`. True where the user broke it off, which is how a live one ends."""
    with ExitStack() as stack:
        advance = stack.enter_context(_progress("frames", camera.length))
        newest = None
        if camera.live and mode == "latest":
            newest = stack.enter_context(NewestFrames(camera.frames))
        results = stream(newest or camera.frames)
        interrupted = False
        try:
            with closing(iter(results)) as each:
                for result in each:
                    outputs.watch(results)
                    outputs.take(result)
                    advance()
            outputs.watch(results)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            outputs.dropped = (results.summary.dropped if results.summary else 0) + (newest.skipped if newest else 0)
    return interrupted


@contextmanager
def _service(
    load: Load,
    url: tuple[str, ...],
    api_key: str | None,
    reconnect: float | None = None,
    **local: Any,
) -> Iterator[LaneService]:
    if not url:
        key_was_given = click.get_current_context().get_parameter_source("api_key") is ParameterSource.COMMANDLINE
        if key_was_given or reconnect is not None:
            raise click.UsageError("--api-key and --reconnect are for the service at --url")
        yield InProcess(load(local["model"], local["provider"] or "auto", local["regressor"]))
        return
    if any(option is not None for option in local.values()):
        raise click.UsageError(
            "--model, --regressor and --provider are for work in this process; the service at --url has its own"
        )
    with LaneClient(url, api_key=api_key, reconnect_s=Patience.total_s if reconnect is None else reconnect) as client:
        yield client


@contextmanager
def _progress(what: str, length: int | None) -> Iterator[Callable[[], None]]:
    """A bar on a terminal, nothing in a pipe; what it gives is called once a step."""
    console = Console(stderr=True)
    columns = [TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(what, total=length)
        yield lambda: bar.advance(task)


def _files(paths: Sequence[Path]) -> list[Path]:
    return [file for path in paths for file in (image_files(path) if path.is_dir() else [path])]


def _detected(lanes_of: Callable[[bytes], LanesMessage], path: Path) -> LanesMessage | None:
    """The lanes of an image; None, with a line about why, where that image has none to give."""
    try:
        return lanes_of(image_bytes(path))
    except ImageError as error:
        click.echo(f"error: {path}: {error}", err=True)
    except SourceError as error:
        click.echo(f"error: {error}", err=True)
    return None


def _in_words(lanes: LanesMessage) -> str:
    sides = [side for side, track in (("left", lanes.ego.left), ("right", lanes.ego.right)) if track is not None]
    ego = f"ego {' and '.join(sides)}" if sides else "no ego lane"
    count = len(lanes.lanes)
    return f"{count} {'boundary' if count == 1 else 'boundaries'}, {ego}, {lanes.timing_ms.total:.1f} ms"


def _annotate(path: Path, lanes: LanesMessage, folder: Path) -> None:
    with needs_extra("video"):
        import cv2

        from lanestream_client.overlays import draw_lanes
    target = folder / f"{path.name}.lanes.jpg"
    picture = draw_lanes(SourceFrame(0, None, data=path.read_bytes(), name=str(path)).image(), lanes)
    folder.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(target), picture):
        raise SourceError(f"can't write {target}")


def _is_output(path: Path | None) -> bool:
    """Whether the standard output carries JSON, and nothing else may be said there."""
    return str(path) == "-"
