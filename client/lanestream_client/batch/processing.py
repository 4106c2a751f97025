"""The processing of one unit: frames in, result files out. Local workers and those of a cluster share it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

import click

from lanestream.errors import (
    LanestreamError,
    MissingExtraError,
    NoDetectorError,
    SettingsError,
    SourceError,
    WriteError,
    needs_extra,
    one_line,
)
from lanestream.protocol import BoundaryKind, CameraModel, DetectorName
from lanestream.writing import writing
from lanestream_client.batch.geojson import SegmentLog
from lanestream_client.batch.gpx import Tracks, video_time
from lanestream_client.batch.outputs import TRACKS, Format, UnitFiles, UnitWriter, unit_files, unit_writer
from lanestream_client.batch.state import Counts, UnitResult
from lanestream_client.frames import SourceFrame, StreamResult
from lanestream_client.image_files import NO_JPEG_END, lacks_jpeg_end, read_image_file
from lanestream_client.in_process import InProcessClient
from lanestream_client.video_sources import open_video_file

if TYPE_CHECKING:
    from lanestream_client.batch.units import SourceFile, Unit
    from lanestream_client.in_process import InProcessEngine
    from lanestream_client.options import LoadEngine
    from lanestream_client.requests import ServiceInfo

# How often progress is reported at most, in seconds.
_PROGRESS_S: Final = 0.5


@dataclass(frozen=True)
class Progress:
    """How far a unit is: at the file with this `index`, of which this `share` is done, from 0 to 1.

    `frames` counts the frames of the unit that are done.
    """

    index: int = 0
    share: float = 0.0
    frames: int = 0


ReportProgress = Callable[[Progress], object]


@dataclass(frozen=True)
class BatchJob:
    """What all units of a batch have in common; a value that can be sent to other processes and machines.

    `load` loads the engine from `model`, `provider` and `regressor`. Results go to the folder `out`.
    """

    out: Path
    format: Format
    load: LoadEngine
    model: Path | None = None
    provider: str | None = None
    regressor: Path | None = None
    detector: DetectorName | None = None
    horizon: float | None = None
    camera: CameraModel | None = None
    kinds: tuple[BoundaryKind, ...] | None = None
    tracks: Tracks | None = None


@dataclass(frozen=True)
class EngineInfo:
    """What runs in a worker: the chosen detector's network, and the hash of each detector's network by its name."""

    service: ServiceInfo
    networks: dict[str, str]


class UnitProcessor:
    """Processes units, one after the other, with its own engine and in one thread.

    Raises the errors of `BatchJob.load`, and NoDetectorError.
    """

    def __init__(self, job: BatchJob) -> None:
        self._job = job
        self._engine = _load(job)
        self._client = InProcessClient(self._engine)
        with needs_extra("video"):
            import cv2
        # There is a process for each processor. Imported after the engine, which sets OpenCV's limits before.
        cv2.setNumThreads(1)
        self.engine_info = EngineInfo(self._client.describe(job.detector), _network_hashes(self._engine))

    def process(self, unit: Unit, report: ReportProgress) -> UnitResult:
        """Returns the outcome of a unit. What is wrong with its files is a part of it.

        Raises WriteError if its results can't be written.
        """
        process = self._process_video if unit.kind == "video" else self._process_images
        with unit_files(self._job.out, unit.name) as files:
            result = process(unit, files, report)
            if len(result.failed) == len(unit.files):
                files.discard()
                return replace(result, parts=(), counts=Counts())
            with writing(self._job.out):
                return replace(result, parts=files.finish())

    def _process_video(self, unit: Unit, files: UnitFiles, report: ReportProgress) -> UnitResult:
        (file,) = unit.files
        failed: dict[str, str] = {}
        notes: list[str] = []
        tally = _Tally()
        segments = SegmentLog()
        with unit_writer(files, self._job.out, self._job.format) as writer, _noting_failure(file, failed):
            notes += self._track_video(file, writer, tally, segments, report)
        if self._job.tracks is not None and not failed:
            try:
                self._write_segments(file, self._job.tracks, segments, files)
            except WriteError:
                raise
            except SourceError as error:
                notes.append(f"{file.path}: {error}")
        return UnitResult(unit, counts=tally.counts, failed=failed, notes=tuple(notes))

    def _track_video(
        self, file: SourceFile, writer: UnitWriter, tally: _Tally, segments: SegmentLog, report: ReportProgress
    ) -> list[str]:
        """Writes and counts the results of a video, and returns what was wrong with its frames."""
        job = self._job
        reported = time.monotonic()
        report(Progress())
        with open_video_file(file.path, threads=1) as source:
            stream = self._client.stream(
                source.frames,
                mode="all",
                horizon=job.horizon,
                detector=job.detector,
                camera=job.camera,
                kinds=job.kinds,
            )
            for result in stream:
                writer.write(file.path, result)
                tally.add(result)
                if result.lanes is not None:
                    segments.add(result.lanes)
                if time.monotonic() - reported > _PROGRESS_S:
                    reported = time.monotonic()
                    share = min(1.0, tally.frames / source.length) if source.length else 0.0
                    report(Progress(0, share, tally.frames))
            tally.add_video(source.fps, source.counts.lost_frames)
        return [f"{file.path}: {warning.message}" for warning in stream.warnings]

    def _process_images(self, unit: Unit, files: UnitFiles, report: ReportProgress) -> UnitResult:
        job = self._job
        failed: dict[str, str] = {}
        notes: list[str] = []
        tally = _Tally()
        with unit_writer(files, job.out, job.format) as writer:
            for index, file in enumerate(unit.files):
                report(Progress(index, 0.0, tally.frames))
                with _noting_failure(file, failed):
                    image = read_image_file(Path(file.path))
                    lanes = self._client.detect(
                        image,
                        horizon=job.horizon,
                        detector=job.detector,
                        camera=job.camera,
                        kinds=job.kinds,
                    )
                    result = StreamResult(SourceFrame(0, None, name=file.path), lanes=lanes)
                    writer.write(file.path, result)
                    tally.add(result)
                    if lacks_jpeg_end(image):
                        notes.append(f"{file.path}: {NO_JPEG_END}")
        return UnitResult(unit, counts=tally.counts, failed=failed, notes=tuple(notes))

    def _write_segments(self, file: SourceFile, tracks: Tracks, segments: SegmentLog, files: UnitFiles) -> None:
        """Raises SourceError if the video has no track, and WriteError."""
        track, start = tracks.match(file.path, video_time(file.path))
        content = segments.feature_collection(file.path, track, start)
        if not content["features"]:
            raise SourceError("no positions: the track has only gaps where the video is")
        with writing(self._job.out):
            files.create(TRACKS, "geojson").write(json.dumps(content).encode())


class _Tally:
    """Counts the results of a unit."""

    def __init__(self) -> None:
        self.counts = Counts()
        self._first = self._last = 0.0

    @property
    def frames(self) -> int:
        return self.counts.frames

    def add(self, result: StreamResult) -> None:
        lanes = result.lanes
        if lanes is None:
            self.counts += Counts(frames=1, failed_frames=1)
            return
        if self.frames == self.counts.failed_frames:
            self._first = lanes.timestamp
        self._last = lanes.timestamp
        both = lanes.ego.left is not None and lanes.ego.right is not None
        self.counts += Counts(frames=1, boundaries=len(lanes.lanes), both_ego=int(both))

    def add_video(self, fps: float, lost_frames: int) -> None:
        """Adds what is known at the end of a video: from its first frame to its last one, which lasts 1 / `fps`."""
        self.counts += Counts(lost_frames=lost_frames, video_s=self._last - self._first + 1.0 / fps)


@contextmanager
def _noting_failure(file: SourceFile, failed: dict[str, str]) -> Iterator[None]:
    """Notes in one line why a file fails, whatever is wrong with it. Problems with the results are raised."""
    try:
        yield
    except (WriteError, NoDetectorError, MissingExtraError):
        raise
    except LanestreamError as error:
        failed[file.path] = one_line(str(error).removeprefix(f"can't open {file.path}: "))
    except Exception as error:  # of FFmpeg, OpenCV or a network's runtime, for a file that nobody has tried before
        failed[file.path] = one_line(f"{type(error).__name__}: {error}")


def _load(job: BatchJob) -> InProcessEngine:
    """Loads the engine. Raises SettingsError for a bad option, in place of click's error, which can't be pickled."""
    try:
        return job.load(job.model, job.provider, job.regressor, 1)
    except click.ClickException as error:
        raise SettingsError(error.format_message()) from None


def _network_hashes(engine: InProcessEngine) -> dict[str, str]:
    hashes = {}
    for name in get_args(DetectorName):
        try:
            hashes[name] = engine.network(name).sha256
        except NoDetectorError:
            continue
    return hashes
