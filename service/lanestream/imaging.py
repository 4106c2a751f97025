"""Bytes to a checked, decoded frame: every limit is tested on the file's header, before any pixel is decoded.

Two walls stand before a decompression bomb: the pixel size read from the header here, and OpenCV's own limit, which it
reads once from the environment when it is first imported.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, ImageTooLargeError
from lanestream.image_files import Header, corrupt, read_body, read_header

if TYPE_CHECKING:
    from lanestream.lanes import Image

# More than any setting allows; only OpenCV's first import in the process sees it.
MOST_PIXELS: Final = 1 << 26
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))

import cv2  # noqa: E402  (the limit above has to stand first)
import numpy as np  # noqa: E402


@dataclass(frozen=True)
class ImageLimits:
    """What is accepted: bytes and pixels at most, pixels at least on the shorter side, and how elongated it may be.

    Frames are worked on at one width, so that a very tall one would cost more than its pixels tell.
    """

    max_bytes: int = 8 << 20
    max_pixels: int = 4096 * 2304
    min_side: int = 64
    max_aspect: int = 5


def decode(data: bytes, limits: ImageLimits) -> Image:
    """The image in `data`, a JPEG, PNG or WebP file, as BGR (H, W, 3) uint8, upright as its EXIF orientation says.

    Raises ImageTooLargeError beyond the limits, and ImageError where it is no image, too small, cut short or corrupt.
    """
    _check_bytes(len(data), limits)
    header = read_header(data)
    _check_size(header, limits)
    try:
        image = cv2.imdecode(np.frombuffer(read_body(data, header), np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    # A turn by EXIF swaps the sides; any other difference means that the limits were checked on another image.
    if image is None or sorted(image.shape[:2]) != sorted((header.width, header.height)):
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
