"""Reads frames from video files, folders of images, cameras and network streams."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from lanestream.errors import SourceError
from lanestream_client.frames import CameraSource, SourceFrame
from lanestream_client.image_files import IMAGE_SUFFIXES, image_files, read_image_file
from lanestream_client.video_sources import SOURCE_HINT, open_camera, open_network_stream, open_video_file

if TYPE_CHECKING:
    from lanestream_client.video_sources import RtspTransport

# How long a live camera is opened again by default. Many need most of a minute to start.
RECONNECT_CAMERA_S: Final = 60.0

_log: Final = logging.getLogger(__name__)


class LiveReader:
    """Reads a live source in a thread, and by default yields only the newest frame that was not yielded before.

    A slow caller then skips frames instead of falling behind; `skipped` counts them. With `skip=False` the thread waits
    until each frame was taken. The caller can be interrupted while it waits, which FFmpeg does not allow. An exception
    of `frames` is raised after the last frame.
    """

    def __init__(self, frames: Iterator[SourceFrame], *, skip: bool = True) -> None:
        self._frames = frames
        self._skip = skip
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
        self.stop()
        # A camera that is silent keeps the thread until its wait for data ends. FFmpeg can't be interrupted before.
        self._thread.join()

    def stop(self) -> None:
        """Ends the iteration, also while another thread waits for a frame."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def __iter__(self) -> Iterator[SourceFrame]:
        return self

    def __next__(self) -> SourceFrame:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._ended or self._stopped)
            if self._stopped:
                raise StopIteration
            frame, self._newest = self._newest, None
            if frame is not None:
                self._changed.notify_all()
                return frame
            if self._error is not None:
                raise self._error
            raise StopIteration

    def _read(self) -> None:
        try:
            for frame in self._frames:
                with self._changed:
                    if not self._skip:
                        self._changed.wait_for(lambda: self._newest is None or self._stopped)
                    if self._stopped:
                        return
                    self.skipped += self._newest is not None
                    self._newest = frame
                    self._changed.notify_all()
        except Exception as error:
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()


def open_source(
    spec: str,
    fps: float = 25.0,
    *,
    reconnect_s: float = RECONNECT_CAMERA_S,
    rtsp_transport: RtspTransport = "auto",
    notify: Callable[[str], None] = _log.warning,
) -> AbstractContextManager[CameraSource]:
    """Opens the source that `spec` names: a video, a folder of images, an image, a camera's number or a URL.

    `fps` sets the timestamps of image files, which have none. A live camera that is lost is opened again for up to
    `reconnect_s` seconds, 0 disables this, and `notify` gets a line of text when it is lost and when it is back. RTSP
    streams are requested over TCP and if that fails over UDP, or over one of them only.

    Raises SourceError if the source does not exist or can't be read, and, while it is read, if it has no frames, and
    its subclass CameraLostError if a live camera does not come back.
    """
    if spec.isdecimal():
        return open_camera(int(spec), reconnect_s, notify)
    if "://" in spec:
        return open_network_stream(spec, reconnect_s, rtsp_transport, notify)
    path = Path(spec)
    if path.is_dir():
        return _images(spec, image_files(path, notify), fps)
    if not path.exists():
        raise SourceError(f"no such file or folder: {spec}", SOURCE_HINT)
    if path.is_char_device():
        return open_camera(spec, reconnect_s, notify)
    return _images(spec, [path], fps) if path.suffix.lower() in IMAGE_SUFFIXES else open_video_file(spec)


@contextmanager
def _images(name: str, files: list[Path], fps: float) -> Iterator[CameraSource]:
    def frames() -> Iterator[SourceFrame]:
        for seq, path in enumerate(files):
            yield SourceFrame(seq, seq / fps, data=read_image_file(path), name=path.name, clock="frame_rate")

    yield CameraSource(name, frames(), live=False, fps=fps, length=len(files))
