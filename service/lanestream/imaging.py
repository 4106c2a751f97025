"""Bytes to a checked, decoded frame: every limit is tested on the file's header, before any pixel is decoded.

Two walls stand before a decompression bomb: the pixel size read from the header here, and OpenCV's own limit, which it
reads once from the environment when it is first imported.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, ImageTooLargeError

# More than any setting allows; only OpenCV's first import in the process sees it.
MOST_PIXELS: Final = 1 << 26
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))

import cv2  # noqa: E402  (the limit above has to stand first)
import numpy as np  # noqa: E402

if TYPE_CHECKING:
    from lanestream.lanes import Image

ACCEPTED: Final = "JPEG, PNG or WebP are accepted"

# Inside JPEG scans 0xff is followed by a stuffed zero, a restart marker or padding; whatever else follows is a marker.
_JPEG_MARKER: Final = re.compile(rb"\xff([^\x00\xd0-\xd7\xff])")
_JPEG_SIZE_MARKERS: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_START_OF_SCAN: Final = 0xDA
_JPEG_END: Final = 0xD9
_BINARY: Final = re.compile(rb"[\x00-\x08\x0e-\x1f]")
# Every scan of a progressive JPEG is a pass over all pixels, and an empty one costs its sender only a few bytes.
_MOST_JPEG_SCANS: Final = 100


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
class Header:
    """What an image file says of itself; `complete` is False where its end is missing."""

    kind: str
    width: int
    height: int
    complete: bool


def decode(data: bytes, limits: ImageLimits) -> Image:
    """The image in `data`, a JPEG, PNG or WebP file, as BGR (H, W, 3) uint8, upright as its EXIF orientation says.

    Raises ImageTooLargeError beyond the limits, and ImageError where it is no image, too small, cut short or corrupt.
    """
    _check_bytes(len(data), limits)
    header = read_header(data)
    _check_size(header, limits)
    if not header.complete:
        raise ImageError(f"the {header.kind} image is cut short: its end is missing", "send the whole file")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise _corrupt(header.kind)
    return np.asarray(image, np.uint8)


def _check_bytes(size: int, limits: ImageLimits) -> None:
    """Raises ImageTooLargeError where an image of `size` bytes is more than the limits allow."""
    if size > limits.max_bytes:
        raise ImageTooLargeError(
            f"the image has {size:,} bytes; at most {limits.max_bytes:,} are accepted", "send it as a JPEG"
        )


def read_header(data: bytes) -> Header:
    """Kind and size of the image file in `data`, nothing decoded. Raises ImageError where it is none of the kinds."""
    for magic, kind, read in (
        (b"\xff\xd8\xff", "JPEG", _read_jpeg),
        (b"\x89PNG\r\n\x1a\n", "PNG", _read_png),
        (b"RIFF", "WebP", _read_webp),
    ):
        if data.startswith(magic):
            try:
                return read(data)
            except IndexError:
                raise ImageError(
                    f"the {kind} image is cut short: its header is missing", "send the whole file"
                ) from None
    raise ImageError(f"not an image: {_describe(data)}", ACCEPTED)


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


def _describe(data: bytes) -> str:
    if not data:
        return "it is empty"
    return "its kind is unknown" if _BINARY.search(data[:64]) else "it looks like text"


def _corrupt(kind: str) -> ImageError:
    return ImageError(f"the {kind} image is corrupt and can't be decoded", ACCEPTED)


def _number(data: bytes, start: int, size: int, *, big: bool = False) -> int:
    part = data[start : start + size]
    if len(part) < size:
        raise IndexError
    return int.from_bytes(part, "big" if big else "little")


def _read_jpeg(data: bytes) -> Header:
    """Walks the segments from marker to marker up to the end marker, which a file that was cut short lacks.

    What follows the end marker is ignored: many cameras pad their files, some append a preview.
    """
    size: tuple[int, int] | None = None
    at, scans = 2, 0
    while match := _JPEG_MARKER.search(data, at):
        marker, at = match.group(1)[0], match.end()
        if marker == _JPEG_END:
            return _jpeg_header(size, complete=True)
        if 0x02 <= marker < 0xC0:
            raise _corrupt("JPEG")
        if marker in _JPEG_SIZE_MARKERS and size is None:
            size = _number(data, at + 5, 2, big=True), _number(data, at + 3, 2, big=True)
        scans += marker == _JPEG_START_OF_SCAN
        if scans > _MOST_JPEG_SCANS:
            raise ImageError(f"the JPEG image has more than {_MOST_JPEG_SCANS} scans", "save it as a baseline JPEG")
        at += _number(data, at, 2, big=True)
    return _jpeg_header(size, complete=False)


def _jpeg_header(size: tuple[int, int] | None, *, complete: bool) -> Header:
    if size is None:
        if complete:
            raise _corrupt("JPEG")
        raise IndexError
    return Header("JPEG", *size, complete)


def _read_png(data: bytes) -> Header:
    """The size stands in IHDR, always the first chunk; IEND is always the last."""
    if data[12:16] != b"IHDR":
        raise _corrupt("PNG")
    width, height = _number(data, 16, 4, big=True), _number(data, 20, 4, big=True)
    return Header("PNG", width, height, data.rfind(b"IEND") > 0)


def _read_webp(data: bytes) -> Header:
    """The size stands in the first chunk, in one of three forms: lossy, lossless or extended."""
    if data[8:12] != b"WEBP":
        raise ImageError("not an image: its kind is unknown", ACCEPTED)
    complete = len(data) >= _number(data, 4, 4) + 8
    chunk = data[12:16]
    if chunk == b"VP8 ":
        width, height = _number(data, 26, 2) & 0x3FFF, _number(data, 28, 2) & 0x3FFF
    elif chunk == b"VP8L":
        bits = _number(data, 21, 4)
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    elif chunk == b"VP8X":
        width, height = _number(data, 24, 3) + 1, _number(data, 27, 3) + 1
    else:
        raise _corrupt("WebP")
    return Header("WebP", width, height, complete)
