"""Image files that cost as much as possible to decode, and ordinary ones."""

from __future__ import annotations

import struct
import zlib
from functools import cache
from typing import Final

import cv2
import numpy as np
from bench.frames import load_clips

LARGEST: Final = (4096, 2304)
_MEGABYTE: Final = 1 << 20
_LOSSLESS_QUALITY: Final = 101
_ADLER_MODULUS: Final = 65521
_TRUE_COLOR: Final = 2
_TRUE_COLOR_ALPHA: Final = 6


@cache
def road_jpeg(width: int, height: int) -> bytes:
    """Returns a JPEG file of a rendered road."""
    return load_clips(((width, height),), 1)[width, height][0]


def padded(data: bytes, size: int) -> bytes:
    """Returns the image file `data` with so many zeros behind it that it has `size` bytes."""
    return data + bytes(size - len(data))


@cache
def progressive_jpeg(width: int, height: int, scans: int) -> bytes:
    """Returns a JPEG file of few bytes whose scans, each a pass over all pixels, are empty."""
    parts = b"".join(bytes([number, 0x11, 0]) for number in (1, 2, 3))
    tables = _segment(0xDB, bytes(1) + bytes([1] * 64))
    for kind, symbol in ((0x00, 0x00), (0x10, 0xE0)):
        tables += _segment(0xC4, bytes([kind, 1]) + bytes(15) + bytes([symbol]))
    frame = _segment(0xC2, struct.pack(">BHHB", 8, height, width, 3) + parts)
    first = _segment(0xDA, bytes([3, 1, 0, 2, 0, 3, 0, 0, 0, 1])) + bytes(10)
    again = _segment(0xDA, bytes([3, 1, 0, 2, 0, 3, 0, 0, 0, 0x10])) + bytes(1)
    return b"\xff\xd8" + tables + frame + first + (scans - 1) * again + b"\xff\xd9"


@cache
def png(width: int, height: int, excess_mb: int = 0) -> bytes:
    """Returns a black PNG file whose data inflate to its pixels and `excess_mb` MB more."""
    pixels = height * (1 + 3 * width)
    return _png(width, height, 8, _TRUE_COLOR, pixels + excess_mb * _MEGABYTE)


@cache
def deep_png(width: int, height: int) -> bytes:
    """Returns a black PNG file with four channels of 16 bits."""
    return _png(width, height, 16, _TRUE_COLOR_ALPHA, height * (1 + 8 * width))


@cache
def lossless_webp(width: int, height: int) -> bytes:
    """Returns a lossless WebP file of noise that fits into 8 MB."""
    image = np.random.default_rng(1).integers(0, 4, (height, width, 3), np.uint8)
    return bytes(cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS_QUALITY])[1])


def _segment(marker: int, data: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", 2 + len(data)) + data


def _png(width: int, height: int, depth: int, colors: int, inflated: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colors, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", _zeros(inflated)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _zeros(size: int) -> bytes:
    """Returns `size` zeros, rounded up to whole MB, compressed a thousandfold."""
    megabytes = -(-size // _MEGABYTE)
    packer = zlib.compressobj(9)
    beginning = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    megabyte = packer.compress(bytes(_MEGABYTE)) + packer.flush(zlib.Z_FULL_FLUSH)
    # The stream ends with the Adler-32 of all its data.
    checksum = struct.pack(">HH", megabytes * _MEGABYTE % _ADLER_MODULUS, 1)
    return beginning + megabytes * megabyte + packer.flush(zlib.Z_FINISH)[:-4] + checksum
