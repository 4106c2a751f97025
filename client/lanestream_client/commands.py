"""The commands `detect` and `stream`, which find lanes in images and videos, with a service or in this process.

The program that mounts them passes the function that loads an engine of this process as the context's object, a
`LoadEngine`. This package itself does not depend on the service.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

import click
from click.core import ParameterSource
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lanestream.errors import ImageError, LanestreamError, SourceError, needs_extra
from lanestream.protocol import BoundaryKind, DetectorName, Mode
from lanestream.writing import check_folder, writing
from lanestream_client.annotated_names import annotated_names
from lanestream_client.client import LaneClient
from lanestream_client.departure_clips import departure_clips
from lanestream_client.failover import RetryPolicy
from lanestream_client.frames import CameraSource, SourceCounts, SourceFrame, StreamResult
from lanestream_client.image_files import NO_JPEG_END, image_files, lacks_jpeg_end, read_image_file
from lanestream_client.in_process import InProcessClient
from lanestream_client.options import Command, LoadEngine, chosen_camera, detection_options, network_options
from lanestream_client.preview import Preview, has_display, preview
from lanestream_client.requests import ServiceInfo
from lanestream_client.sinks import RunReport, json_lines_sink, video_sink
from lanestream_client.sources import RECONNECT_CAMERA_S, LiveReader, open_source
from lanestream_client.video_sources import RtspTransport

if TYPE_CHECKING:
    from lanestream.protocol import LanesMessage
    from lanestream_client.in_process import LaneService, ResultStream
    from lanestream_client.sinks import ResultSink

_EXIT_INTERRUPTED: Final = 130  # 128 + SIGINT, as shells report it


def _service_options(command: Command) -> Command:
    """Adds the options of a service, which is used instead of the networks of this process."""
    key = click.option(
        "--api-key", envvar="LANESTREAM_API_KEY", show_envvar=True, metavar="KEY", help="API key for the service."
    )
    url = click.option(
        "--url",
        multiple=True,
        help="URL of a service, such as http://127.0.0.1:8000; repeat it for replicas  [default: run in process]",
    )
    ca_file = click.option(
        "--ca-file",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="PEM file of the authorities whose certificates a service at https:// may have  [default: the system's]",
    )
    certificate = click.option(
        "--client-certificate",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="PEM file with a certificate and its private key, for a service that asks for one.",
    )
    return url(key(ca_file(certificate(command))))


_jsonl_option = click.option(
    "--jsonl",
    type=click.Path(path_type=Path),
    help="Write one line of JSON per frame to this file; - is standard output.",
)


@click.command()
@click.argument("paths", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="PATH...")
@_service_options
@network_options
@detection_options
@_jsonl_option
@click.option(
    "--annotate", type=click.Path(path_type=Path, file_okay=False), help="Write images with lanes to this folder."
)
@click.pass_context
def detect(
    context: click.Context,
    /,
    paths: tuple[Path, ...],
    detector: DetectorName | None,
    horizon: float | None,
    camera_file: Path | None,
    camera_height: float | None,
    field_of_view: float | None,
    kinds: tuple[BoundaryKind, ...],
    jsonl: Path | None,
    annotate: Path | None,
    **where: Any,
) -> None:
    """Find lanes in images: files, or folders of them. Each image is processed on its own."""
    files = _image_files(paths)
    names = annotated_names(files)
    camera = chosen_camera(camera_file, camera_height, field_of_view)
    if annotate is not None:
        check_folder(annotate)
    report = RunReport()
    with ExitStack() as stack:
        service = stack.enter_context(_open_service(context.obj, **where))
        detect_one = partial(service.detect, horizon=horizon, detector=detector, camera=camera, kinds=kinds or None)
        json_lines = stack.enter_context(json_lines_sink(jsonl))
        advance = stack.enter_context(_progress_bar("images", len(files)))
        try:
            for path, name in zip(files, names, strict=True):
                result = _detect_file(detect_one, path)
                advance()
                if result is None or result.lanes is None:
                    report.add_failure()
                    continue
                report.write_result(result)
                if json_lines is None:
                    click.echo(f"{path}: {_describe(result.lanes)}")
                else:
                    json_lines.write_result(result)
                if annotate is not None:
                    _write_annotated(result.frame, result.lanes, annotate / name)
        except SourceError:  # such as a full disk: what is done is not lost
            click.echo(f"\n{report.text(service.describe(detector))}", err=_is_stdout(jsonl))
            raise
        click.echo(f"\n{report.text(service.describe(detector))}", err=_is_stdout(jsonl))
    context.exit(1 if report.failed else 0)


@click.command()
@click.argument("source")
@_service_options
@network_options
@detection_options
@_jsonl_option
@click.option(
    "--mode",
    type=click.Choice(get_args(Mode)),
    help="Process the newest frame, or all frames  [default: latest for live sources, else all]",
)
@click.option("--video", type=click.Path(path_type=Path), help="Write a video with lanes to this MP4 file.")
@click.option(
    "--show",
    is_flag=True,
    help="Show the newest frame with lanes in a browser on this machine, at an address that is printed.",
)
@click.option(
    "--fps",
    type=click.FloatRange(0.1, 1000.0),
    default=25.0,
    show_default=True,
    help="Frame rate of a folder of images.",
)
@click.option(
    "--reconnect",
    type=click.FloatRange(min=0.0),
    metavar="SECONDS",
    help="Give up after this time without a connection; 0 disables reconnecting  [default: 30]",
)
@click.option(
    "--reconnect-camera",
    type=click.FloatRange(min=0.0),
    default=RECONNECT_CAMERA_S,
    show_default=True,
    metavar="SECONDS",
    help="Give up a live camera that is lost after this time; 0 disables opening it again.",
)
@click.option(
    "--rtsp-transport",
    type=click.Choice(get_args(RtspTransport)),
    default="auto",
    show_default=True,
    help="Transport of RTSP cameras; auto is TCP, and UDP if that fails.",
)
@click.option("--session", metavar="NAME", help="Name of the stream in the service's logs.")
@click.option(
    "--record-departures",
    type=click.FloatRange(0.1, 600.0),
    metavar="SECONDS",
    help="Record a clip with lanes from this long before each lane departure until this long after it.",
)
@click.option(
    "--departures-folder",
    type=click.Path(path_type=Path, file_okay=False),
    default="departures",
    show_default=True,
    help="Folder for the clips of --record-departures.",
)
@click.pass_context
def stream(
    context: click.Context,
    /,
    source: str,
    detector: DetectorName | None,
    horizon: float | None,
    camera_file: Path | None,
    camera_height: float | None,
    field_of_view: float | None,
    kinds: tuple[BoundaryKind, ...],
    jsonl: Path | None,
    mode: Mode | None,
    video: Path | None,
    show: bool,
    fps: float,
    reconnect_camera: float,
    rtsp_transport: RtspTransport,
    session: str | None,
    record_departures: float | None,
    departures_folder: Path,
    **where: Any,
) -> None:
    """Track the lanes in the frames of one camera.

    SOURCE is a video file, a folder of images, a camera number or an rtsp:// or http:// URL.
    """
    camera = chosen_camera(camera_file, camera_height, field_of_view)
    if session is not None and not where["url"]:
        raise click.UsageError("--session needs a service: add --url")
    if record_departures is not None and camera is None:
        raise click.UsageError(
            "--record-departures needs the camera: add --camera, or --camera-height and --field-of-view"
        )
    with ExitStack() as stack:
        frames = stack.enter_context(
            open_source(
                source,
                fps,
                reconnect_s=reconnect_camera,
                rtsp_transport=rtsp_transport,
                notify=partial(click.echo, err=True),
            )
        )
        service = stack.enter_context(_open_service(context.obj, **where))
        sinks = [
            stack.enter_context(json_lines_sink(jsonl)),
            stack.enter_context(video_sink(video, frames.fps)),
            clips := stack.enter_context(departure_clips(departures_folder, record_departures, frames.fps)),
            shown := stack.enter_context(preview(show)),
        ]
        if shown is not None:
            _announce(shown)
        run = _StreamRun([sink for sink in sinks if sink is not None])
        mode = mode or ("latest" if frames.live else "all")
        start = partial(
            service.stream,
            mode=mode,
            horizon=horizon,
            detector=detector,
            camera=camera,
            kinds=kinds or None,
            session=session,
        )
        try:
            interrupted = run.process(start, frames, mode)
        except LanestreamError:
            if run.report.frames:
                click.echo(run.report_text(service, detector, frames.counts), err=_is_stdout(jsonl))
            raise
        click.echo(run.report_text(service, detector, frames.counts), err=_is_stdout(jsonl))
        for path in [] if clips is None else clips.paths:
            click.echo(f"departure: {path}", err=_is_stdout(jsonl))
    context.exit(_EXIT_INTERRUPTED if interrupted else 0)


class _StreamRun:
    """One run of the command `stream`: passes results to sinks and reports lost connections."""

    def __init__(self, sinks: Sequence[ResultSink]) -> None:
        self.report = RunReport()
        self._sinks = sinks
        self._dropped = 0
        self._info: ServiceInfo | None = None
        self._reconnects = 0
        self._warned = 0
        self._warned_of_end = False

    def process(self, start: Callable[..., ResultStream], source: CameraSource, mode: Mode) -> bool:
        """Streams the source. Returns whether the user interrupted it, which is how a live stream ends."""
        with ExitStack() as stack:
            advance = stack.enter_context(_progress_bar("frames", source.length))
            reader = None
            if source.live:
                reader = stack.enter_context(LiveReader(source.frames, skip=mode == "latest"))
            results = start(reader or source.frames)
            interrupted = False
            try:
                with closing(iter(results)) as iterator, ExitStack() as stops:
                    # A thread of the stream may wait for a camera that is lost.
                    stops.callback(source.stop)
                    if reader is not None:
                        stops.callback(reader.stop)
                    for result in iterator:
                        self._check_connection(results)
                        self._report_warnings(results)
                        self._write(result)
                        advance()
                self._check_connection(results)
                self._report_warnings(results)
            except KeyboardInterrupt:
                interrupted = True
            finally:
                dropped = results.summary.dropped if results.summary else 0
                self._dropped = dropped + (reader.skipped if reader else 0)
        return interrupted

    def report_text(self, service: LaneService, detector: DetectorName | None, source: SourceCounts) -> str:
        """Returns the report. Asks the service what it runs only if the stream did not say: it may be gone by now."""
        return self.report.text(self._info or service.describe(detector), self._dropped, source)

    def _write(self, result: StreamResult) -> None:
        self.report.write_result(result)
        if not self._warned_of_end and lacks_jpeg_end(result.frame.data or b""):
            self._warned_of_end = True
            click.echo(f"warning: frame {result.frame.seq}: {NO_JPEG_END}", err=True)
        if result.error is not None:
            click.echo(f"frame {result.frame.seq}: {result.error.message}", err=True)
        for sink in self._sinks:
            sink.write_result(result)

    def _report_warnings(self, results: ResultStream) -> None:
        for warning in results.warnings[self._warned :]:
            click.echo(f"warning: {warning.message}; {warning.hint}", err=True)
        self._warned = len(results.warnings)

    def _check_connection(self, results: ResultStream) -> None:
        """Notes what the service runs, and reports a connection that was lost and restored."""
        if (ready := results.ready) is None:
            return
        self._info = ServiceInfo(ready.model, ready.provider)
        if results.reconnects > self._reconnects:
            self._reconnects = results.reconnects
            state = "was resumed" if ready.resumed else "is new, with new track ids"
            click.echo(f"reconnected after a lost connection: session {ready.session} {state}", err=True)


def _announce(shown: Preview) -> None:
    """Prints where the preview is, and opens it if this machine has a display."""
    click.echo(f"preview: {shown.url}", err=True)
    if has_display():
        # Some systems return from this only when the browser is closed.
        threading.Thread(target=partial(click.launch, shown.url, wait=True), name="browser", daemon=True).start()


@contextmanager
def _open_service(
    load_engine: LoadEngine,
    url: tuple[str, ...],
    api_key: str | None,
    ca_file: Path | None,
    client_certificate: Path | None,
    reconnect: float | None = None,
    **in_process: Any,
) -> Iterator[LaneService]:
    """Opens a client of the service at `url`, or of an engine in this process if `url` is empty."""
    if not url:
        key_was_given = click.get_current_context().get_parameter_source("api_key") is ParameterSource.COMMANDLINE
        if key_was_given or any(option is not None for option in (ca_file, client_certificate, reconnect)):
            raise click.UsageError(
                "--api-key, --ca-file, --client-certificate and --reconnect need a service: add --url"
            )
        yield InProcessClient(load_engine(in_process["model"], in_process["provider"], in_process["regressor"]))
        return
    if any(option is not None for option in in_process.values()):
        raise click.UsageError(
            "--model, --regressor and --provider configure the networks of this process and can't be used with --url"
        )
    reconnect_s = RetryPolicy.total_s if reconnect is None else reconnect
    with LaneClient(
        url, api_key=api_key, reconnect_s=reconnect_s, ca_file=ca_file, client_certificate=client_certificate
    ) as client:
        yield client


@contextmanager
def _progress_bar(label: str, length: int | None) -> Iterator[Callable[[], None]]:
    """Shows a progress bar if standard error is a terminal. Yields the function that advances it by one."""
    console = Console(stderr=True)
    columns = [TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(label, total=length)
        yield lambda: bar.advance(task)


def _image_files(paths: Sequence[Path]) -> list[Path]:
    return [
        file
        for path in paths
        for file in (image_files(path, partial(click.echo, err=True)) if path.is_dir() else [path])
    ]


def _detect_file(detect_one: Callable[[bytes], LanesMessage], path: Path) -> StreamResult | None:
    """Returns the result of an image file. If the file or the image is bad, prints why and returns None."""
    try:
        data = read_image_file(path)
    except SourceError as error:
        click.echo(f"error: {error}", err=True)
        return None
    try:
        lanes = detect_one(data)
    except ImageError as error:
        click.echo(f"error: {path}: {error}", err=True)
        return None
    if lacks_jpeg_end(data):
        click.echo(f"warning: {path}: {NO_JPEG_END}", err=True)
    return StreamResult(SourceFrame(0, None, data=data, name=str(path)), lanes=lanes)


def _describe(lanes: LanesMessage) -> str:
    sides = [side for side, track in (("left", lanes.ego.left), ("right", lanes.ego.right)) if track is not None]
    ego = f"ego {' and '.join(sides)}" if sides else "no ego lane"
    count = len(lanes.lanes)
    return f"{count} {'boundary' if count == 1 else 'boundaries'}, {ego}, {lanes.timing_ms.total:.1f} ms"


def _write_annotated(frame: SourceFrame, lanes: LanesMessage, target: Path) -> None:
    with needs_extra("video"):
        import cv2

        from lanestream_client.overlays import draw_lanes
    # OpenCV itself can't write to a name that is not UTF-8.
    _, encoded = cv2.imencode(".jpg", draw_lanes(frame.image(), lanes))
    with writing(target):
        target.write_bytes(encoded.tobytes())


def _is_stdout(path: Path | None) -> bool:
    """Returns whether JSON goes to standard output, which must then carry nothing else."""
    return str(path) == "-"
