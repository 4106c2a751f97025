"""Where the results of a command go: lines of JSON, video files, and the report at the end.

To add a sink, write a class with the method of `ResultSink`, here or in its own module, and add its option in
commands.py.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TextIO, cast

from lanestream.errors import ImageError, LostError, needs_extra
from lanestream.protocol import TimingModel
from lanestream.writing import check_file, writing

if TYPE_CHECKING:
    import av

    from lanestream.protocol import LanesMessage
    from lanestream_client.frames import SourceCounts, StreamResult
    from lanestream_client.pixels import BgrImage
    from lanestream_client.requests import ServiceInfo

# The frame times of 24, 25, 29.97, 30, 50 and 60 fps are multiples of it, and it fits into MPEG-4's 16 bits.
_TIME_BASE: Final = Fraction(1, 60000)
# The most that is lost of a video that can't be finished, in microseconds.
_FRAGMENT_US: Final = 1_000_000


class ResultSink(Protocol):
    """Takes the results of a run, one by one."""

    def write_result(self, result: StreamResult) -> None:
        """Writes one result."""
        ...


class JsonLinesSink:
    """Writes one message per line, with what is known about its frame.

    Before the message that is its `file` if it has a name. Behind it is the `clock` that its time is from, and in how
    many `reconnects` its source had been lost before, if any.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write_result(self, result: StreamResult) -> None:
        """Writes the frame's lanes or its error."""
        self._file.write(self.line(result))

    @staticmethod
    def line(result: StreamResult) -> str:
        """Returns the line of a frame with its end; empty if it has neither lanes nor an error."""
        message = result.lanes or result.error
        if message is None:
            return ""
        frame = result.frame
        fields = {"file": frame.name, **message.model_dump(mode="json")}
        fields |= {"clock": frame.clock, "reconnects": frame.reconnects}
        unknown = {name for name in ("file", "clock", "reconnects") if not fields[name]}
        return json.dumps({name: value for name, value in fields.items() if name not in unknown}) + "\n"


@contextmanager
def json_lines_sink(path: Path | None) -> Iterator[JsonLinesSink | None]:
    """Opens a sink to the file at `path`, or to standard output if it is `-`. Yields None if `path` is None.

    Raises SourceError if the file can't be written.
    """
    if path is None:
        yield None
    elif str(path) == "-":
        yield JsonLinesSink(sys.stdout)
    else:
        with _writing_to(path), path.open("w", encoding="utf-8", buffering=1) as file:
            yield JsonLinesSink(file)


class VideoSink:
    """Writes images to an MP4 file, as H.264 if an encoder is available and as MPEG-4 otherwise.

    The first image sets the size. Later images of another size are scaled to fit.
    """

    def __init__(self, container: av.container.OutputContainer, fps: float) -> None:
        self._container = container
        self._ticks_per_frame = round(1 / (fps * _TIME_BASE)) if fps > 0 else 1
        self._stream: av.VideoStream | None = None
        self._first_timestamp = 0.0
        self._last_ticks = -1

    def write_result(self, result: StreamResult) -> None:
        """Draws the lanes or the error on the frame and writes it. Skips a frame that can't be decoded."""
        with suppress(ImageError):
            self.write(result.draw(), result.frame.timestamp)

    def write(self, image: BgrImage, timestamp: float | None) -> None:
        """Adds a BGR image (H, W, 3) uint8 at `timestamp` seconds.

        If the timestamp is None or does not rise, the image follows the previous one at the frame rate.
        """
        import av

        if self._stream is None:
            self._stream = _add_video_stream(self._container, image)
            self._first_timestamp = timestamp or 0.0
        stream = self._stream
        ticks = -1 if timestamp is None else round((timestamp - self._first_timestamp) / _TIME_BASE)
        self._last_ticks = ticks if ticks > self._last_ticks else self._last_ticks + self._ticks_per_frame
        frame = av.VideoFrame.from_ndarray(_resize_to_fit(image, stream.width, stream.height), format="bgr24")
        frame.pts, frame.time_base = self._last_ticks, _TIME_BASE
        self._mux(stream.encode(frame))

    def finish(self) -> None:
        """Writes the frames that the encoder still holds."""
        if self._stream is not None:
            self._mux(self._stream.encode(None))

    def _mux(self, packets: list[av.Packet[Any]]) -> None:
        try:
            self._container.mux(packets)
        except OSError:
            self._stream = None  # there is nothing to finish any more
            raise


@contextmanager
def video_sink(path: Path | None, fps: float) -> Iterator[VideoSink | None]:
    """Opens a sink to the MP4 file at `path`. Yields None if `path` is None.

    Raises SourceError if the file can't be written.
    """
    if path is None:
        yield None
        return
    with needs_extra("video"):
        import av  # noqa: F401
    with _writing_to(path), _mp4_container(path) as container:
        sink = VideoSink(container, fps)
        try:
            yield sink
        finally:
            sink.finish()


@contextmanager
def _mp4_container(path: Path) -> Iterator[av.container.OutputContainer]:
    import av

    # FFmpeg opens the file itself: PyAV loses a Ctrl-C that Python notices while it writes to a file of Python's.
    # Written in fragments until it is closed, the file can be played even if the disk gets full or the power fails.
    options = {"movflags": "+hybrid_fragmented+negative_cts_offsets", "frag_duration": str(_FRAGMENT_US)}
    container = av.open(f"file:{path}", "w", format="mp4", options=options)
    failed = False
    try:
        yield container
    except OSError:
        failed = True
        raise
    finally:
        with suppress(av.FFmpegError) if failed else nullcontext():
            container.close()


class RunReport:
    """Counts and times the results of a run, and describes them at its end. The run starts when it is created."""

    def __init__(self) -> None:
        self._started = time.monotonic()
        self._timings: list[TimingModel] = []
        self._with_both_ego_boundaries = 0
        self.failed = 0
        self.lost = 0

    @property
    def frames(self) -> int:
        """The number of frames with a result, lanes or an error."""
        return len(self._timings) + self.failed + self.lost

    def write_result(self, result: StreamResult) -> None:
        """Counts one result."""
        if result.lanes is not None:
            self.add_lanes(result.lanes)
        elif result.error is not None and result.error.code == LostError.code:
            self.lost += 1
        else:
            self.add_failure()

    def add_lanes(self, lanes: LanesMessage) -> None:
        """Counts a frame that got lanes."""
        self._timings.append(lanes.timing_ms)
        self._with_both_ego_boundaries += lanes.ego.left is not None and lanes.ego.right is not None

    def add_failure(self) -> None:
        """Counts a frame that failed."""
        self.failed += 1

    def text(self, info: ServiceInfo, dropped: int = 0, source: SourceCounts | None = None) -> str:
        """Returns the report. `dropped` is the number of frames without any result, `source` what the source lost."""
        answered = len(self._timings)
        rate = answered / max(time.monotonic() - self._started, 1e-9)
        lost = f", {self.lost} lost" if self.lost else ""
        lines = [
            f"{self.frames + dropped} frames: "
            f"{answered} answered, {dropped} dropped, {self.failed} failed{lost}; {rate:.1f} frames/s"
        ]
        if answered:
            share = 100.0 * self._with_both_ego_boundaries / answered
            lines += [f"both ego boundaries in {share:.1f} % of the answered frames", ""]
            lines += [f"{'ms':<8}{'p50':>9}{'p95':>9}", *(self._stage(stage) for stage in TimingModel.model_fields), ""]
        if source is not None and source.lost_frames:
            lines.append(f"the source lost {_counted(source.lost_frames, 'damaged frame')}")
        if source is not None and source.reconnects:
            times = _counted(source.reconnects, "time")
            lines.append(f"the camera was opened again {times}, with {source.outage_s:.1f} s without frames")
        lines.append(f"model {info.model} on {info.provider}")
        return "\n".join(lines)

    def _stage(self, stage: str) -> str:
        values = sorted(getattr(timing, stage) for timing in self._timings)
        return f"{stage:<8}{nearest_rank(values, 50):>9.2f}{nearest_rank(values, 95):>9.2f}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def nearest_rank(ordered: Sequence[float], percent: float) -> float:
    """Returns the nearest-rank percentile of values in ascending order."""
    return ordered[max(0, math.ceil(percent / 100.0 * len(ordered)) - 1)]


@contextmanager
def _writing_to(path: Path) -> Iterator[None]:
    check_file(path)
    with writing(path):
        yield


def _add_video_stream(container: av.container.OutputContainer, image: BgrImage) -> av.VideoStream:
    import av

    height, width = image.shape[:2]
    name = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    options = {"crf": "20", "preset": "veryfast"} if name == "libx264" else {}
    stream = cast("av.VideoStream", container.add_stream(name, options=options))
    # Players expect yuv420p, which halves the color resolution in both directions and so needs an even size.
    stream.width, stream.height = width + width % 2, height + height % 2
    stream.pix_fmt = "yuv420p"
    stream.time_base = stream.codec_context.time_base = _TIME_BASE
    if name == "mpeg4":
        stream.codec_context.bit_rate = 4 * stream.width * stream.height
    return stream


def _resize_to_fit(image: BgrImage, width: int, height: int) -> BgrImage:
    """Scales the image to fit into `width` x `height` if necessary, and repeats its edges to fill the rest."""
    import cv2
    import numpy as np

    if (image.shape[1] + 1) // 2 * 2 != width or (image.shape[0] + 1) // 2 * 2 != height:
        scale = min(width / image.shape[1], height / image.shape[0])
        size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    down, right = height - image.shape[0], width - image.shape[1]
    return np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE), np.uint8)
