"""The pictures that labels belong to: image files, frames of videos, or bytes in the label file itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Self

from lanestream.errors import ImageError, SourceError
from lanestream.images.decoding import MOST_PIXELS, ImageLimits, decode
from lanestream.images.header import Header, read_header
from lanestream.road.view import Image

import cv2  # isort: skip  (imaging sets OpenCV's own limit before it is imported)
import numpy as np  # isort: skip

# More than a service accepts: labelled frames may come from any camera, and as PNG files.
LIMITS: Final = ImageLimits(max_bytes=64 << 20, max_pixels=MOST_PIXELS // 2)


@dataclass(frozen=True)
class Picture:
    """Where a picture is: an image file, frame `index` of a video file, or `data`, the bytes of an image file."""

    path: Path
    index: int | None = None
    data: bytes | None = field(default=None, repr=False)


class Opener:
    """Opens pictures one after another; frames of one video in order are decoded on, not from its start."""

    def __init__(self) -> None:
        self._video: Path | None = None
        self._capture = cv2.VideoCapture()
        self._read = 0  # frames of the video that have been passed

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._capture.release()

    def open(self, picture: Picture) -> Image:
        """The picture as BGR (H, W, 3) uint8. Raises ImageError or SourceError where it can't be decoded."""
        if picture.index is not None:
            return self._frame(picture.path, picture.index)
        return decode(picture.data if picture.data is not None else file_bytes(picture.path), LIMITS)

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


def file_bytes(path: Path) -> bytes:
    """What is in the image file `path`. Raises ImageError where it can't be read or is too large."""
    try:
        if path.stat().st_size > LIMITS.max_bytes:
            raise ImageError(f"{path.name} has more than {LIMITS.max_bytes:,} bytes", "save it smaller")
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"can't read {path.name}: {(error.strerror or str(error)).lower()}") from None


def checked_header(data: bytes) -> Header:
    """What the image in `data` says of itself. Raises ImageError where it is none, or larger than is accepted."""
    header = read_header(data)
    if header.width * header.height > LIMITS.max_pixels:
        raise ImageError(f"the image is {header.width} x {header.height}: too large")
    return header
