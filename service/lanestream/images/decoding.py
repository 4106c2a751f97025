"""Bytes to a checked, decoded frame: every limit is tested on the file's header, before any pixel is decoded.

Two walls stand before a decompression bomb: the pixel size read from the header here, and OpenCV's own limit, which it
reads once from the environment when it is first imported.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, ImageTooLargeError
from lanestream.images.header import Header, corrupt, read_body, read_header
from lanestream.road.view import Scaling

if TYPE_CHECKING:
    from lanestream.road.view import Image

# More than any setting allows; only OpenCV's first import in the process sees it.
MOST_PIXELS: Final = 1 << 26
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))

import cv2  # noqa: E402  (the limit above has to stand first)
import numpy as np  # noqa: E402

# How OpenCV is told to decode an image whole, at a half, at a quarter and at an eighth of its size.
_REDUCED: Final = {
    1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8,
}  # fmt: skip


@dataclass(frozen=True)
class ImageLimits:
    """What is accepted: bytes and pixels at most, pixels at least on the shorter side, and how elongated it may be.

    Frames are worked on at one width, so that a very tall one would cost more than its pixels tell.
    """

    max_bytes: int = 8 << 20
    max_pixels: int = 4096 * 2304
    min_side: int = 64
    max_aspect: int = 5


@dataclass(frozen=True)
class Picture:
    """A decoded image: BGR pixels `image` (H, W, 3) uint8, upright; those of its file are `reduced` times as many."""

    image: Image
    reduced: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in its file."""
        return self.image.shape[1] * self.reduced, self.image.shape[0] * self.reduced

    @property
    def scaling(self) -> Scaling:
        """From pixels of the file to those of `image`."""
        return Scaling(1.0 / self.reduced)


def decode(data: bytes, limits: ImageLimits) -> Image:
    """The image in `data`, a JPEG, PNG or WebP file, as BGR (H, W, 3) uint8, upright as its EXIF orientation says.

    Raises ImageTooLargeError beyond the limits, and ImageError where it is no image, too small, cut short or corrupt.
    """
    header = _checked(data, limits)
    return _decoded(data, header, 1)


def decode_reduced(data: bytes, limits: ImageLimits, least_width: int) -> Picture:
    """The image in `data` at a half, a quarter or an eighth of its size, as long as it is `least_width` pixels wide.

    That costs less than to decode it and to reduce it then. Raises what `decode` raises.
    """
    header = _checked(data, limits)
    reduced = max(by for by in _REDUCED if (header.width >= by * least_width and _divides(by, header)) or by == 1)
    image = _decoded(data, header, reduced)
    if image.shape[1] * reduced != header.width:  # turned by EXIF, and its height is not known to suffice
        return Picture(_decoded(data, header, 1))
    return Picture(image, reduced)


def _divides(by: int, header: Header) -> bool:
    return header.width % by == 0 and header.height % by == 0


def _checked(data: bytes, limits: ImageLimits) -> Header:
    _check_bytes(len(data), limits)
    header = read_header(data)
    _check_size(header, limits)
    return header


def _decoded(data: bytes, header: Header, reduced: int) -> Image:
    """The pixels of a checked image file, each side divided by `reduced`."""
    try:
        image = cv2.imdecode(np.frombuffer(read_body(data, header), np.uint8), _REDUCED[reduced])
    except cv2.error:
        image = None
    # A turn by EXIF swaps the sides; any other difference means that the limits were checked on another image.
    if image is None or sorted(image.shape[:2]) != sorted((header.width // reduced, header.height // reduced)):
        raise corrupt(header.kind)
    return np.asarray(image, np.uint8)


def _check_bytes(size: int, limits: ImageLimits) -> None:
    """Raises ImageTooLargeError where an image of `size` bytes is more than the limits allow."""
    if size > limits.max_bytes:
        raise ImageTooLargeError(
            f"the image has {size:,} bytes; at most {limits.max_bytes:,} are accepted", "send it as a JPEG"
        )


def _check_size(header: Header, limits: ImageLimits) -> None:
    size = f"{header.width} x {header.height}"
    if header.width * header.height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the image is {size}, {header.width * header.height:,} pixels; at most {limits.max_pixels:,} are accepted",
            "scale it down; 1280 x 720 is plenty",
        )
    if min(header.width, header.height) < limits.min_side:
        raise ImageError(
            f"the image is {size}; too small to show a road",
            f"at least {limits.min_side} pixels on each side are accepted, 320 x 180 or more is useful",
        )
    if max(header.width, header.height) > limits.max_aspect * min(header.width, header.height):
        raise ImageError(
            f"the image is {size}; too elongated to show a road",
            f"one side may be {limits.max_aspect} times the other at most",
        )
