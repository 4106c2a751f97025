"""Where frames come from: video files, folders of images, cameras and streams on the network."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from lanestream.errors import SourceError, needs_extra
from lanestream_client.frames import SourceFrame

if TYPE_CHECKING:
    import av
    import cv2

    from lanestream_client.frames import Image

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")
_KINDS: Final = "a video file, a folder of images, an image, a camera number or an rtsp:// or http:// URL"
_STALL_S: Final = 10.0


@dataclass(frozen=True)
class Source:
    """Frames of one camera, to be read once.

    `live` sources give frames at their own pace and do not wait; others give them as fast as they are read. `length` is
    the number of frames where it is known, `fps` their rate, to show them at.
    """

    name: str
    frames: Iterator[SourceFrame]
    live: bool
    fps: float
    length: int | None = None


def open_source(spec: str, fps: float = 25.0) -> AbstractContextManager[Source]:
    """The source that `spec` names; `fps` is the rate of images in a folder, which have no times of their own.

    Raises SourceError where it is not there, can't be read, or has no frame; the last on reading it.
    """
    if spec.isdecimal():
        return _camera(int(spec))
    if "://" in spec:
        return _video(spec, _without_login(spec))
    path = Path(spec)
    if path.is_dir():
        return _images(spec, image_files(path), fps)
    if not path.exists():
        raise SourceError(f"no such file or folder: {spec}", f"{_KINDS} is accepted")
    return _images(spec, [path], fps) if path.suffix.lower() in IMAGE_SUFFIXES else _video(spec, spec)


def image_files(folder: Path) -> list[Path]:
    """The image files in `folder`, 2.jpg before 10.jpg. Raises SourceError where there is none."""
    files = sorted((path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES), key=_natural)
    if not files:
        raise SourceError(f"no image in the folder {folder}", f"files ending in {', '.join(IMAGE_SUFFIXES)} count")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name.lower())]


def _without_login(url: str) -> str:
    parts = urlsplit(url)
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


@contextmanager
def _images(name: str, files: list[Path], fps: float) -> Iterator[Source]:
    def frames() -> Iterator[SourceFrame]:
        for seq, path in enumerate(files):
            try:
                yield SourceFrame(seq, seq / fps, data=path.read_bytes(), name=path.name)
            except OSError as error:
                raise SourceError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None

    yield Source(name, frames(), live=False, fps=fps, length=len(files))


@contextmanager
def _video(place: str, name: str) -> Iterator[Source]:
    """A video file, or a stream on the network, which is live where it has no end."""
    with needs_extra("video"):
        import av
    remote = "://" in place
    options = {"rtsp_transport": "tcp"} if place.startswith("rtsp") else {}
    try:
        container = av.open(place, options=options, timeout=_STALL_S if remote else None)
    except (av.FFmpegError, OSError) as error:
        raise SourceError(f"can't open {name}: {_reason(error)}", f"{_KINDS} is accepted") from None
    with container:
        if not container.streams.video:
            raise SourceError(f"{name} has no video in it", f"{_KINDS} is accepted")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        fps = float(stream.average_rate or stream.guessed_rate or 25)
        live = remote and container.duration is None
        yield Source(name, _decoded(container, name, fps), live=live, fps=fps, length=stream.frames or None)


def _decoded(container: av.container.InputContainer, name: str, fps: float) -> Iterator[SourceFrame]:
    import av

    seq = 0
    try:
        for seq, frame in enumerate(container.decode(video=0), 1):
            timestamp = (seq - 1) / fps if frame.time is None else frame.time
            yield SourceFrame(seq - 1, timestamp, pixels=_upright(frame))
    except (av.FFmpegError, OSError) as error:
        raise SourceError(f"{name} breaks off after {seq} frames: {_reason(error)}") from None
    if seq == 0:
        raise SourceError(f"{name} has no frame in it")


def _upright(frame: av.VideoFrame) -> Image:
    import numpy as np

    pixels = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
    turns = round(frame.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(pixels, turns)) if turns else pixels


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()


@contextmanager
def _camera(number: int) -> Iterator[Source]:
    with needs_extra("video"):
        import cv2
    capture = cv2.VideoCapture(number)
    try:
        if not capture.isOpened():
            raise SourceError(f"there is no camera {number}, or another program has it", f"{_KINDS} is accepted")
        yield Source(
            f"camera {number}", _captured(capture, number), live=True, fps=capture.get(cv2.CAP_PROP_FPS) or 30.0
        )
    finally:
        capture.release()


def _captured(capture: cv2.VideoCapture, number: int) -> Iterator[SourceFrame]:
    import numpy as np

    seq = 0
    while True:
        there, pixels = capture.read()
        if not there:
            raise SourceError(f"camera {number} gives no more frames")
        yield SourceFrame(seq, time.monotonic(), pixels=np.asarray(pixels, np.uint8))
        seq += 1
