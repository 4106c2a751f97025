"""Reads frames from video files, folders of images, cameras and network streams."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self
from urllib.parse import urlsplit

from lanestream.errors import SourceError, needs_extra
from lanestream_client.frames import SourceFrame

if TYPE_CHECKING:
    import av
    import cv2

    from lanestream_client.frames import BgrImage

IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp")
_HINT: Final = "use a video file, a folder of images, an image, a camera number or an rtsp:// or http:// URL"
_NETWORK_TIMEOUT_S: Final = 10.0


@dataclass(frozen=True)
class CameraSource:
    """The frames of one camera, to be read once.

    A `live` source delivers frames at its own pace; any other delivers them as fast as they are read. `length` is the
    number of frames if known, `fps` the rate at which to play them.
    """

    name: str
    frames: Iterator[SourceFrame]
    live: bool
    fps: float
    length: int | None = None


class NewestFrames:
    """Reads a live source in a thread, and yields only the newest frame that was not yielded before.

    A slow reader then skips frames instead of falling behind. `skipped` counts them. An exception of `frames` is raised
    after the last frame.
    """

    def __init__(self, frames: Iterator[SourceFrame]) -> None:
        self._frames = frames
        self._changed = threading.Condition()
        self._newest: SourceFrame | None = None
        self._error: Exception | None = None
        self._ended = False
        self._stopped = False
        self._thread = threading.Thread(target=self._read, name="lanestream-live-source", daemon=True)
        self.skipped = 0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._stopped = True
        self._thread.join()

    def __iter__(self) -> Iterator[SourceFrame]:
        return self

    def __next__(self) -> SourceFrame:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._ended)
            frame, self._newest = self._newest, None
            if frame is not None:
                return frame
            if self._error is not None:
                raise self._error
            raise StopIteration

    def _read(self) -> None:
        try:
            for frame in self._frames:
                with self._changed:
                    if self._stopped:
                        return
                    self.skipped += self._newest is not None
                    self._newest = frame
                    self._changed.notify()
        except Exception as error:
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


def open_source(spec: str, fps: float = 25.0) -> AbstractContextManager[CameraSource]:
    """Opens the source that `spec` names. `fps` sets the timestamps of image files, which have none.

    Raises SourceError if the source does not exist or can't be read, and, while it is read, if it has no frames.
    """
    if spec.isdecimal():
        return _camera(int(spec))
    if "://" in spec:
        return _video(spec, _without_login(spec))
    path = Path(spec)
    if path.is_dir():
        return _images(spec, image_files(path), fps)
    if not path.exists():
        raise SourceError(f"no such file or folder: {spec}", _HINT)
    return _images(spec, [path], fps) if path.suffix.lower() in IMAGE_SUFFIXES else _video(spec, spec)


def image_files(folder: Path) -> list[Path]:
    """Returns the image files in `folder` in natural order, 2.jpg before 10.jpg. Raises SourceError if it has none."""
    files = sorted((path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES), key=_natural_key)
    if not files:
        raise SourceError(f"no images in the folder {folder}", f"accepted file types: {', '.join(IMAGE_SUFFIXES)}")
    return files


def _natural_key(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name.lower())]


def _without_login(url: str) -> str:
    parts = urlsplit(url)
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()


@contextmanager
def _images(name: str, files: list[Path], fps: float) -> Iterator[CameraSource]:
    def frames() -> Iterator[SourceFrame]:
        for seq, path in enumerate(files):
            try:
                yield SourceFrame(seq, seq / fps, data=path.read_bytes(), name=path.name)
            except OSError as error:
                raise SourceError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None

    yield CameraSource(name, frames(), live=False, fps=fps, length=len(files))


@contextmanager
def _video(location: str, name: str) -> Iterator[CameraSource]:
    """Opens a video file or a network stream. A network stream without a known duration is live."""
    with needs_extra("video"):
        import av
    remote = "://" in location
    options = {"rtsp_transport": "tcp"} if location.startswith("rtsp") else {}
    try:
        container = av.open(location, options=options, timeout=_NETWORK_TIMEOUT_S if remote else None)
    except (av.FFmpegError, OSError) as error:
        raise SourceError(f"can't open {name}: {_reason(error)}", _HINT) from None
    with container:
        if not container.streams.video:
            raise SourceError(f"{name} has no video stream", _HINT)
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        fps = float(stream.average_rate or stream.guessed_rate or 25)
        live = remote and container.duration is None
        yield CameraSource(name, _decoded(container, name, fps), live=live, fps=fps, length=stream.frames or None)


def _decoded(container: av.container.InputContainer, name: str, fps: float) -> Iterator[SourceFrame]:
    import av

    seq = 0
    try:
        for seq, frame in enumerate(container.decode(video=0), 1):
            timestamp = (seq - 1) / fps if frame.time is None else frame.time
            yield SourceFrame(seq - 1, timestamp, pixels=_upright(frame))
    except (av.FFmpegError, OSError) as error:
        raise SourceError(f"{name} failed after {seq} frames: {_reason(error)}") from None
    if seq == 0:
        raise SourceError(f"{name} has no frames")


def _upright(frame: av.VideoFrame) -> BgrImage:
    import numpy as np

    pixels = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
    quarter_turns = round(frame.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(pixels, quarter_turns)) if quarter_turns else pixels


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()


@contextmanager
def _camera(number: int) -> Iterator[CameraSource]:
    with needs_extra("video"):
        import cv2
    capture = cv2.VideoCapture(number)
    try:
        if not capture.isOpened():
            raise SourceError(f"camera {number} was not found, or another program uses it", _HINT)
        yield CameraSource(
            f"camera {number}", _captured(capture, number), live=True, fps=capture.get(cv2.CAP_PROP_FPS) or 30.0
        )
    finally:
        capture.release()


def _captured(capture: cv2.VideoCapture, number: int) -> Iterator[SourceFrame]:
    import numpy as np

    seq = 0
    while True:
        success, pixels = capture.read()
        if not success:
            raise SourceError(f"camera {number} stopped delivering frames")
        yield SourceFrame(seq, time.monotonic(), pixels=np.asarray(pixels, np.uint8))
        seq += 1
