"""The command `batch`, which finds lanes in whole archives."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, get_args

import click

from lanestream.errors import needs_extra
from lanestream.protocol import BoundaryKind, DetectorName
from lanestream_client.batch.gpx import find_tracks
from lanestream_client.batch.outputs import Format, create_folders
from lanestream_client.batch.pool import WorkerPool
from lanestream_client.batch.processing import BatchJob, EngineInfo
from lanestream_client.batch.ray_runner import RayCluster
from lanestream_client.batch.report import BatchReport, print_summary, write_summary
from lanestream_client.batch.state import BatchState, open_state
from lanestream_client.batch.stopping import StopSignals, stop_signals
from lanestream_client.batch.units import SourceFile, find_files, units_of
from lanestream_client.options import chosen_camera, detection_options, network_options

if TYPE_CHECKING:
    from collections.abc import Sequence
    from contextlib import AbstractContextManager

    from lanestream_client.batch.pool import ReportUnfinished
    from lanestream_client.batch.state import UnitResult
    from lanestream_client.batch.units import Unit

_EXIT_SIGNAL: Final = 128  # plus the number of the signal, as shells report it


class Executor(Protocol):
    """Where units are processed."""

    def start(self) -> EngineInfo | None:
        """Returns what runs in the workers; None if it was stopped."""
        ...

    def run(self, units: Sequence[Unit], report: ReportUnfinished) -> Iterator[UnitResult]:
        """Yields the outcomes of all units as they come, until it is stopped."""
        ...


@click.command()
@click.argument("sources", nargs=-1, required=True, metavar="SOURCE...")
@click.option(
    "--out",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Folder for the results and the state of the batch.",
)
@network_options
@detection_options
@click.option(
    "--format",
    "output_format",
    type=click.Choice(get_args(Format)),
    default="jsonl",
    show_default=True,
    help="One line of JSON per frame, or Parquet tables of frames and of lanes.",
)
@click.option(
    "--processes",
    type=click.IntRange(1),
    help="Number of processes, each with its own networks  [default: one per processor, as far as the memory allows]",
)
@click.option("--retry-failed", is_flag=True, help="Process the files again that failed in an earlier run.")
@click.option(
    "--gpx",
    type=click.Path(path_type=Path, exists=True),
    metavar="FILE|DIR",
    help="GPX track of the drives, or a folder of tracks; writes what was seen along them as GeoJSON.",
)
@click.option(
    "--gpx-offset",
    type=float,
    metavar="SECONDS",
    help="Seconds to add to the times of the videos to get those of the tracks  [default: 0]",
)
@click.option(
    "--ray",
    metavar="ADDRESS",
    help="Use the Ray cluster at this address, or `auto`; all its machines must have the sources and DIR.",
)
@click.pass_context
def batch(
    context: click.Context,
    /,
    sources: tuple[str, ...],
    out: Path,
    model: Path | None,
    regressor: Path | None,
    provider: str | None,
    detector: DetectorName | None,
    horizon: float | None,
    camera_file: Path | None,
    camera_height: float | None,
    field_of_view: float | None,
    kinds: tuple[BoundaryKind, ...],
    output_format: Format,
    processes: int | None,
    retry_failed: bool,
    gpx: Path | None,
    gpx_offset: float | None,
    ray: str | None,
) -> None:
    """Find lanes in archives of videos and images.

    A SOURCE is a file, a folder with all folders below it, a pattern such as 'drives/**/*.mp4', or @FILE with one
    source per line. Videos are tracked through all of their frames; each image is processed on its own.

    The same command continues a batch that was interrupted, and processes new and changed files. The exit code is 1 if
    files failed.
    """
    if gpx_offset is not None and gpx is None:
        raise click.UsageError("--gpx-offset needs --gpx")
    if output_format == "parquet":
        with needs_extra("batch"):
            import pyarrow.parquet  # noqa: F401
    notify = partial(click.echo, err=True)
    files = find_files(sources, notify, out)
    job = BatchJob(
        out=out.absolute(),
        format=output_format,
        load=context.obj,
        model=_absolute(model),
        provider=provider,
        regressor=_absolute(regressor),
        detector=detector,
        horizon=horizon,
        camera=chosen_camera(camera_file, camera_height, field_of_view),
        kinds=kinds or None,
        tracks=None if gpx is None else find_tracks(gpx.absolute(), gpx_offset or 0.0, notify),
    )
    with open_state(job.out) as state, stop_signals() as stop:
        with _executor(job, len(files), processes, ray, stop) as executor:
            failed = _run(job, gpx, state, executor, files, retry_failed)
        if stop.signal is not None:
            click.echo("stopped; the same command continues", err=True)
            context.exit(_EXIT_SIGNAL + stop.signal)
    context.exit(1 if failed else 0)


def _run(
    job: BatchJob, gpx: Path | None, state: BatchState, executor: Executor, files: list[SourceFile], retry_failed: bool
) -> dict[str, str]:
    """Processes and reports the files that remain. Returns the errors of all files that failed, by path."""
    info = executor.start()
    if info is None:
        return {}
    settings = _settings(job, gpx, info)
    state.check_settings(settings)
    create_folders(job.out, job.format, job.tracks is not None)
    pending = state.pending(files, retry_failed)
    if len(pending) < len(files):
        click.echo(f"{len(files) - len(pending)} of {len(files)} files were processed before", err=True)
    report = BatchReport(sum(file.size for file in pending), len(pending))
    try:
        with report.shown():
            for result in executor.run(units_of(pending), report.show):
                if state.record(result):
                    report.add(result)
    finally:
        failed = state.failed(files)
        totals = report.summary(state.totals(), *state.numbers())
        print_summary(totals, failed, f"model {info.service.model} on {info.service.provider}")
    write_summary(job.out, {"settings": settings, "provider": info.service.provider, **totals, "failed": failed})
    return failed


def _settings(job: BatchJob, gpx: Path | None, info: EngineInfo) -> dict[str, Any]:
    """Returns what the results depend on. Each processor computes them alike, so the provider is not a part of it."""
    return {
        "lanestream": version("lanestream"),
        "format": job.format,
        "networks": info.networks,
        "detector": job.detector,
        "horizon": job.horizon,
        "camera": None if job.camera is None else job.camera.model_dump(exclude_none=True),
        "kinds": job.kinds,
        "gpx": None if gpx is None else str(gpx.absolute()),
        "gpx_offset": None if job.tracks is None else job.tracks.offset_s,
    }


def _absolute(model: Path | None) -> Path | None:
    """Returns the absolute path of a model file, for other machines. The words `shipped` and `none` are not paths."""
    return model if model in (None, Path("shipped"), Path("none")) else model.absolute()


def _executor(
    job: BatchJob, files: int, processes: int | None, ray: str | None, stop: StopSignals
) -> AbstractContextManager[Executor]:
    if ray is not None:
        return RayCluster(job, ray, processes, stop)
    return WorkerPool(job, min(processes or job.load.most_processes(), files), stop.received)
