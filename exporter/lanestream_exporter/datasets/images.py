"""The images that labels belong to: image files, frames of videos, or bytes inside the label file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

from lanestream.errors import ImageError, SourceError
from lanestream.images.decoding import MOST_PIXELS, ImageLimits, decode
from lanestream.images.header import Header, read_header
from lanestream.road.view import Image

import cv2  # isort: skip  (lanestream.images sets OpenCV's own limit before it is imported)
import numpy as np  # isort: skip

# More than the service accepts: labeled frames may come from any camera, and as PNG files.
LIMITS: Final = ImageLimits(max_bytes=64 << 20, max_pixels=MOST_PIXELS // 2)
EVERY_FRAME: Final = range(1 << 31)
_USUAL_FPS: Final = 25.0  # of videos that don't say


@dataclass(frozen=True)
class ImageLocation:
    """Where an image is: an image file, frame `index` of a video file, or `data`, the bytes of an image file."""

    path: Path
    index: int | None = None
    data: bytes | None = field(default=None, repr=False)


class ImageReader:
    """Opens images one after another. Frames of one video in ascending order are decoded in a single pass."""

    def __init__(self) -> None:
        self._video: Path | None = None
        self._capture = cv2.VideoCapture()
        self._read = 0  # frames of the video read so far

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._capture.release()

    def open(self, location: ImageLocation) -> Image:
        """Returns the image as BGR (H, W, 3) uint8. Raises ImageError or SourceError if it can't be decoded."""
        if location.index is not None:
            return self._frame(location.path, location.index)
        return decode(location.data if location.data is not None else file_bytes(location.path), LIMITS)

    def _frame(self, video: Path, index: int) -> Image:
        if index < 0:
            raise SourceError(f"frame {index} is before the first one")
        if video != self._video or index < self._read:
            self._capture.release()
            self._video, self._read = video, 0
            if not self._capture.open(str(video)):
                raise SourceError(f"{video} can't be read as a video")
        while self._read <= index:
            if not self._capture.grab():
                raise SourceError(f"there is no frame {index}: {video.name} has {self._read} frames")
            self._read += 1
        decoded, image = self._capture.retrieve()
        if not decoded:
            raise SourceError(f"frame {index} of {video.name} can't be decoded")
        return np.asarray(image, dtype=np.uint8)


def video_size(video: Path) -> tuple[int, int]:
    """Returns the (width, height) of a video's frames. Raises SourceError if it can't be read."""
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            raise SourceError(f"{video} can't be read as a video", "give the path of a video file")
        return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
    finally:
        capture.release()


def decoded_frames(video: Path, frames: range = EVERY_FRAME) -> Iterator[tuple[int, Image, float]]:
    """Yields those `frames` of a video that it has, with their index and their time in seconds.

    Raises SourceError if it can't be read.
    """
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise SourceError(f"{video} can't be read as a video", "give the path of a video file")
    fps = capture.get(cv2.CAP_PROP_FPS) or _USUAL_FPS
    capture.set(cv2.CAP_PROP_POS_FRAMES, frames.start)
    try:
        for index in frames:
            ok, image = capture.read()
            if not ok:
                return
            yield index, np.asarray(image, dtype=np.uint8), index / fps
    finally:
        capture.release()


def file_bytes(path: Path) -> bytes:
    """Returns the bytes of the image file `path`. Raises ImageError if it can't be read or is too large."""
    try:
        if path.stat().st_size > LIMITS.max_bytes:
            raise ImageError(f"{path.name} has more than {LIMITS.max_bytes:,} bytes", "save it smaller")
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"can't read {path.name}: {(error.strerror or str(error)).lower()}") from None


def checked_header(data: bytes) -> Header:
    """Returns the header of the image in `data`. Raises ImageError if it is not an image or is too large."""
    header = read_header(data)
    if header.width * header.height > LIMITS.max_pixels:
        raise ImageError(f"the image is {header.width} x {header.height}: too large")
    return header
