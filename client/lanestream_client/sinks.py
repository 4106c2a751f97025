"""Where results go: lines of JSON, and video files."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Final, TextIO, cast

from lanestream.errors import SourceError, needs_extra

if TYPE_CHECKING:
    import av
    from pydantic import BaseModel

    from lanestream_client.frames import Image

# Divides the frame times of 24, 25, 29.97, 30, 50 and 60 fps, and fits MPEG-4's 16 bits.
_TIME_BASE: Final = Fraction(1, 60000)


class JsonLines:
    """Writes one message a line."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, message: BaseModel, **more: str) -> None:
        """Writes `message`, with the fields `more` in front."""
        self._file.write(json.dumps({**more, **message.model_dump(mode="json")}) + "\n")


@contextmanager
def json_lines(path: Path | None) -> Iterator[JsonLines | None]:
    """A writer to the file at `path`, to the standard output where that is `-`; None where there is no path.

    Raises SourceError where it can't be written.
    """
    if path is None:
        yield None
    elif str(path) == "-":
        yield JsonLines(sys.stdout)
    else:
        with _writing(path), path.open("w", encoding="utf-8") as file:
            yield JsonLines(file)


class VideoSink:
    """Writes images to an MP4 file: H.264 where there is an encoder for it, else MPEG-4.

    The first image sets the size; later ones of another size are fitted into it.
    """

    def __init__(self, container: av.container.OutputContainer, fps: float) -> None:
        self._container = container
        self._step = round(1 / (fps * _TIME_BASE)) if fps > 0 else 1
        self._stream: av.VideoStream | None = None
        self._origin = 0.0
        self._last = -1

    def write(self, image: Image, timestamp: float | None) -> None:
        """Adds a BGR image (H, W, 3) uint8 at `timestamp` seconds.

        Where the time is unknown, or not after that of the image before, it follows that at the frame rate.
        """
        import av

        if self._stream is None:
            self._stream = _video_stream(self._container, image)
            self._origin = timestamp or 0.0
        stream = self._stream
        ticks = -1 if timestamp is None else round((timestamp - self._origin) / _TIME_BASE)
        self._last = ticks if ticks > self._last else self._last + self._step
        frame = av.VideoFrame.from_ndarray(_fitted(image, stream.width, stream.height), format="bgr24")
        frame.pts, frame.time_base = self._last, _TIME_BASE
        self._container.mux(stream.encode(frame))

    def finish(self) -> None:
        """Writes what the encoder still holds."""
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))


@contextmanager
def video_sink(path: Path | None, fps: float) -> Iterator[VideoSink | None]:
    """A writer to the MP4 file at `path`; None where there is no path. Raises SourceError where it can't be written."""
    if path is None:
        yield None
        return
    with needs_extra("video"):
        import av
    with _writing(path), av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        sink = VideoSink(container, fps)
        try:
            yield sink
        finally:
            sink.finish()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise SourceError(f"can't write {path}: {(error.strerror or str(error)).lower()}") from None


def _video_stream(container: av.container.OutputContainer, image: Image) -> av.VideoStream:
    import av

    height, width = image.shape[:2]
    name = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    options = {"crf": "20", "preset": "veryfast"} if name == "libx264" else {}
    stream = cast("av.VideoStream", container.add_stream(name, options=options))
    # Half the colour resolution in both directions, which is what players expect, wants even sizes.
    stream.width, stream.height = width + width % 2, height + height % 2
    stream.pix_fmt = "yuv420p"
    stream.time_base = stream.codec_context.time_base = _TIME_BASE
    if name == "mpeg4":
        stream.codec_context.bit_rate = 4 * stream.width * stream.height
    return stream


def _fitted(image: Image, width: int, height: int) -> Image:
    """The image scaled to fit, where its size is another, and its edges repeated to fill `width` x `height`."""
    import cv2
    import numpy as np

    if (image.shape[1] + 1) // 2 * 2 != width or (image.shape[0] + 1) // 2 * 2 != height:
        scale = min(width / image.shape[1], height / image.shape[0])
        size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    down, right = height - image.shape[0], width - image.shape[1]
    return np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE), np.uint8)
