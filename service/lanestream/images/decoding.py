"""Decodes image files. All limits are checked on the file's header, before any pixel is decoded.

Two checks stop decompression bombs: the size in the header is checked here, and OpenCV has a limit of its own, which it
reads from the environment once, when it is first imported.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, ImageTooLargeError
from lanestream.images.header import JPEG_END, JPEG_SCAN, Header, corrupt_image, lacks_end, read_body, read_header
from lanestream.road.view import Scaling

if TYPE_CHECKING:
    from lanestream.road.view import Image

# OpenCV's own limit. No setting allows more. It takes effect only if OpenCV was not imported before.
MOST_PIXELS: Final = 1 << 26
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))

import cv2  # noqa: E402  (the limit above has to be set first)
import numpy as np  # noqa: E402

# OpenCV's flag for each reduction: full size, and a half, a quarter and an eighth of it on each side.
_FLAGS: Final = {
    1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8,
}  # fmt: skip

# Bytes that a JPEG decoder takes for pixels if pixels are missing, in the current interval and in the following ones.
# Behind the last pixel they change nothing, except that the decoder complains on standard error.
_RESTARTS: Final = (b"", *(bytes((0xFF, marker)) for marker in range(0xD0, 0xD8)))
_OTHER_PIXELS: Final = b"".join(restart + 64 * b"\xb5\x6d\x9a" for restart in _RESTARTS)
_GRAY_TOLERANCE: Final = 2


@dataclass(frozen=True)
class ImageLimits:
    """Which images are accepted: `min_side` is in pixels, `max_aspect` the longer side over the shorter one.

    All frames are scaled to the same width, so a very tall one would cost more than its number of pixels suggests.
    """

    max_bytes: int = 8 << 20
    max_pixels: int = 4096 * 2304
    min_side: int = 64
    max_aspect: int = 5


@dataclass(frozen=True)
class DecodedImage:
    """A decoded image: upright BGR pixels `image` (H, W, 3) uint8. Its file is `reduction` times as wide and high."""

    image: Image
    reduction: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image file."""
        return self.image.shape[1] * self.reduction, self.image.shape[0] * self.reduction

    @property
    def scaling(self) -> Scaling:
        """The scaling from pixels of the file to pixels of `image`."""
        return Scaling(1.0 / self.reduction)


def decode(data: bytes, limits: ImageLimits) -> Image:
    """Returns the image in `data`, a JPEG, PNG or WebP file, as BGR (H, W, 3) uint8, upright by its EXIF orientation.

    A JPEG may lack its end marker if it has all its pixels. Raises ImageTooLargeError if it exceeds the limits, and
    ImageError if `data` is not an image, or if the image is too small, too elongated, cut short or corrupt.
    """
    return _decode_checked(data, _check(data, limits), 1)


def decode_reduced(data: bytes, limits: ImageLimits, min_width: int) -> DecodedImage:
    """Returns the image in `data` at full size, a half, a quarter or an eighth, but at least `min_width` pixels wide.

    That is faster than reducing it after decoding. Raises ImageTooLargeError and ImageError for the same images as
    `decode`.
    """
    header = _check(data, limits)
    reduction = max(n for n in _FLAGS if n == 1 or (header.width >= n * min_width and _is_divisible(header, n)))
    image = _decode_checked(data, header, reduction)
    if image.shape[1] * reduction != header.width:
        # The EXIF orientation swapped the sides, so the image may be narrower than `min_width` now.
        return DecodedImage(_decode_checked(data, header, 1))
    return DecodedImage(image, reduction)


def _is_divisible(header: Header, n: int) -> bool:
    return header.width % n == 0 and header.height % n == 0


def _check(data: bytes, limits: ImageLimits) -> Header:
    _check_bytes(len(data), limits)
    header = read_header(data)
    _check_size(header, limits)
    return header


def _decode_checked(data: bytes, header: Header, reduction: int) -> Image:
    """Returns the pixels of a checked image file, each side divided by `reduction`."""
    body = read_body(data, header)
    if not lacks_end(body, header):
        return _decode_body(body, header, reduction)
    image = _decode_body(body + JPEG_END, header, reduction)
    if (body.count(JPEG_SCAN) > 1 or _has_gray_corner(image)) and not np.array_equal(
        image, _decode_body(body + _OTHER_PIXELS + JPEG_END, header, reduction)
    ):
        raise ImageError(f"the {header.kind} image is cut short: its end is missing", "send the whole file")
    return image


def _has_gray_corner(image: Image) -> bool:
    """Returns whether pixels may be missing at the end of a JPEG: decoders make them gray, wherever EXIF turns them."""
    return bool((np.abs(image[[0, 0, -1, -1], [0, -1, 0, -1]].astype(int) - 128) <= _GRAY_TOLERANCE).all(axis=1).any())


def _decode_body(body: bytes, header: Header, reduction: int) -> Image:
    try:
        image = cv2.imdecode(np.frombuffer(body, np.uint8), _FLAGS[reduction])
    except cv2.error:
        image = None
    # The EXIF orientation may swap the sides. After any other difference the limits were checked on another image.
    if image is None or sorted(image.shape[:2]) != sorted((header.width // reduction, header.height // reduction)):
        raise corrupt_image(header.kind)
    return np.asarray(image, np.uint8)


def _check_bytes(size: int, limits: ImageLimits) -> None:
    """Raises ImageTooLargeError if a file of `size` bytes exceeds the limits."""
    if size > limits.max_bytes:
        raise ImageTooLargeError(
            f"the image has {size:,} bytes; at most {limits.max_bytes:,} are accepted", "send it as a JPEG"
        )


def _check_size(header: Header, limits: ImageLimits) -> None:
    size = f"{header.width} x {header.height}"
    if header.width * header.height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the image is {size}, {header.width * header.height:,} pixels; at most {limits.max_pixels:,} are accepted",
            "scale it down, 1280 x 720 is enough",
        )
    if min(header.width, header.height) < limits.min_side:
        raise ImageError(
            f"the image is {size}, too small to show a road",
            f"at least {limits.min_side} pixels on each side are accepted, use 320 x 180 or more",
        )
    if max(header.width, header.height) > limits.max_aspect * min(header.width, header.height):
        raise ImageError(
            f"the image is {size}, too elongated to show a road",
            f"one side may be at most {limits.max_aspect} times the other",
        )
