"""Reads the format and size of image files without decoding them, and extracts the part that a decoder needs.

The format is recognized by the first bytes, the size is read from the header. The rest is scanned chunk by chunk,
because every format lets a small file cause a lot of work that has nothing to do with its pixels.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from lanestream.errors import ImageError

ACCEPTED: Final = "JPEG, PNG or WebP are accepted"

# Inside JPEG scans 0xff is followed by a stuffed zero, a restart marker or padding; anything else is a marker.
_JPEG_MARKER: Final = re.compile(rb"\xff([^\x00\xd0-\xd7\xff])")
_JPEG_FIRST: Final = 0xC0
_JPEG_SIZE_MARKERS: Final = frozenset(range(_JPEG_FIRST, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_START_OF_SCAN: Final = 0xDA
_JPEG_END: Final = 0xD9
JPEG_END: Final = bytes((0xFF, _JPEG_END))
JPEG_SCAN: Final = bytes((0xFF, _JPEG_START_OF_SCAN))
_JPEG_MAGIC: Final = b"\xff\xd8\xff"
_JPEG_LAST_COEFFICIENT: Final = 63
# TEM, a marker without a length: decoders read on right after it.
_JPEG_TEMPORARY: Final = 0x01
# Every scan of a progressive JPEG is a pass over all pixels, and an empty scan takes only a few bytes. Ordinary files
# have ten scans. More are accepted for images with so few pixels that the passes take a fraction of a second.
_ORDINARY_JPEG_SCANS: Final = 10
_MAX_JPEG_SCANS: Final = 100
_MAX_JPEG_PASSES: Final = 100_000_000
_MAX_JPEG_SEGMENTS: Final = 2000

_PNG_FIRST_CHUNK: Final = 8
_MAX_PNG_CHUNKS: Final = 10_000
# Optional chunks that are kept: transparency, and EXIF for the orientation.
_PNG_KEPT: Final = frozenset({b"tRNS", b"eXIf"})
# This bit of the first byte of a chunk's name marks optional chunks.
_PNG_OPTIONAL: Final = 0x20
_PNG_CHANNELS: Final = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
# Deflate expands one byte to at most this many. A decoder inflates all data, even those beyond the last pixel.
_DEFLATE_RATIO: Final = 1032
# Bytes beyond the pixels that a decoder may inflate, which takes less than a fifth of a second. Files too small to hold
# so many are not checked, since the check takes as long as decoding.
_MAX_EXCESS_BYTES: Final = 1 << 26
_INFLATE_STEP: Final = 1 << 18

# Formats that are not accepted, by their first bytes.
_OTHER_FORMATS: Final = {
    "HEIC": re.compile(rb"....ftyp(hei[cfmsx]|hev[cmsx]|mif1|msf1)", re.DOTALL),
    "AVIF": re.compile(rb"....ftypavi[fs]", re.DOTALL),
    "TIFF": re.compile(rb"II\*\0|MM\0\*"),
    "BMP": re.compile(rb"BM"),
    "GIF": re.compile(rb"GIF8[79]a"),
    "PDF": re.compile(rb"%PDF-"),
    "SVG": re.compile(rb"\s*<(\?xml.{0,200}<)?svg", re.DOTALL),
}
_BINARY: Final = re.compile(rb"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class ImageFormat:
    """An image format: its first bytes, and functions that read (width, height) and the part that a decoder needs."""

    kind: str
    magic: bytes
    read_size: Callable[[bytes], tuple[int, int]]
    read_body: Callable[[bytes], bytes]


@dataclass(frozen=True)
class Header:
    """An image file's format, and its size in pixels before the EXIF orientation is applied."""

    format: ImageFormat
    width: int
    height: int

    @property
    def kind(self) -> str:
        """The format's name: JPEG, PNG or WebP."""
        return self.format.kind


def read_header(data: bytes) -> Header:
    """Returns the format and size of the image file in `data`. Raises ImageError if it has no accepted format."""
    for each in _FORMATS:
        if data.startswith(each.magic):
            try:
                return Header(each, *each.read_size(data))
            except IndexError:
                raise ImageError(
                    f"the {each.kind} image is cut short: its header is missing", "send the whole file"
                ) from None
    raise ImageError(f"not an image: {_describe(data)}", ACCEPTED)


def read_body(data: bytes, header: Header) -> bytes:
    """Returns the file in `data` reduced to what a decoder needs for the pixels.

    Raises ImageError if it is cut short or would take far more work than its pixels need.
    """
    try:
        return header.format.read_body(data)
    except IndexError:
        raise ImageError(f"the {header.kind} image is cut short: its end is missing", "send the whole file") from None


def corrupt_image(kind: str) -> ImageError:
    """Returns the error for a file that begins like the format `kind` but can't be decoded."""
    return ImageError(f"the {kind} image is corrupt and can't be decoded", ACCEPTED)


def _describe(data: bytes) -> str:
    if not data:
        return "it is empty"
    for kind, magic in _OTHER_FORMATS.items():
        if magic.match(data):
            return f"its format is {kind}"
    return "its format is unknown" if _BINARY.search(data[:64]) else "it looks like text"


def _number(data: bytes, start: int, size: int, *, big: bool = False) -> int:
    """Returns an integer of `size` bytes. Raises IndexError if `data` ends before."""
    part = data[start : start + size]
    if len(part) < size:
        raise IndexError
    return int.from_bytes(part, "big" if big else "little")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Reads the size from the first frame segment; decoders refuse a second one."""
    for marker, at in _jpeg_markers(data, _MAX_JPEG_SCANS):
        if marker in _JPEG_SIZE_MARKERS:
            return _number(data, at + 5, 2, big=True), _number(data, at + 3, 2, big=True)
    raise IndexError


def _jpeg_body(data: bytes) -> bytes:
    """Returns the file up to its end marker: many cameras pad their files, some append a preview.

    If the end marker is missing, but no scan, it returns the whole file: some cameras omit the marker. Only decoding
    then shows whether pixels are missing, too.
    """
    width, height = _jpeg_size(data)
    most_scans = min(_MAX_JPEG_SCANS, max(_ORDINARY_JPEG_SCANS, _MAX_JPEG_PASSES // max(1, width * height)))
    components, finished = 0, set[int]()
    for marker, at in _jpeg_markers(data, most_scans):
        if marker == _JPEG_END:
            return data[:at]
        if marker in _JPEG_SIZE_MARKERS:
            components = _number(data, at + 7, 1)
        if marker == _JPEG_START_OF_SCAN:
            end = at + 3 + 2 * _number(data, at + 2, 1)
            # The last scan of a component has its last coefficient, down to the lowest bit.
            if _number(data, end + 1, 1) == _JPEG_LAST_COEFFICIENT and _number(data, end + 2, 1) & 0x0F == 0:
                finished.update(data[at + 3 : end : 2])
    if not 0 < components <= len(finished):
        raise IndexError
    return data.rstrip(b"\xff")


def lacks_end(body: bytes, header: Header) -> bool:
    """Returns whether the `body` of an image file is that of a JPEG without its end marker."""
    return header.format.magic == _JPEG_MAGIC and not body.endswith(JPEG_END)


def _jpeg_markers(data: bytes, most_scans: int) -> Iterator[tuple[int, int]]:
    """Yields each marker and the offset after it, as a decoder reads them, to the end marker or the end of the data.

    Raises IndexError if the data end in a segment, and ImageError if a decoder would stop or would take too long.
    """
    at, scans = 2, 0
    for _ in range(_MAX_JPEG_SEGMENTS):
        match = _JPEG_MARKER.search(data, at)
        if match is None:
            return
        marker, at = match.group(1)[0], match.end()
        scans += marker == _JPEG_START_OF_SCAN
        if scans > most_scans:
            raise ImageError(f"the JPEG image has more than {most_scans} scans", "save it as a baseline JPEG")
        yield marker, at
        if marker == _JPEG_END or _JPEG_TEMPORARY < marker < _JPEG_FIRST:
            raise corrupt_image("JPEG")
        if marker != _JPEG_TEMPORARY:
            at += _number(data, at, 2, big=True)
    raise ImageError(f"the JPEG image has more than {_MAX_JPEG_SEGMENTS:,} segments", "save it as a baseline JPEG")


def _png_size(data: bytes) -> tuple[int, int]:
    """Reads the size from IHDR, which is always the first chunk."""
    if data[12:16] != b"IHDR":
        raise corrupt_image("PNG")
    return _number(data, 16, 4, big=True), _number(data, 20, 4, big=True)


def _png_body(data: bytes) -> bytes:
    """Returns the file without texts and profiles, which may inflate a thousandfold, and without animations."""
    view = memoryview(data)
    kept, pixels = [view[:_PNG_FIRST_CHUNK]], []
    # Each optional chunk is kept only the first time.
    at, wanted = _PNG_FIRST_CHUNK, set(_PNG_KEPT)
    for _ in range(_MAX_PNG_CHUNKS):
        kind, end = data[at + 4 : at + 8], at + 12 + _number(data, at, 4, big=True)
        if end > len(data):
            raise IndexError
        if not kind[0] & _PNG_OPTIONAL or kind in wanted:
            wanted.discard(kind)
            kept.append(view[at:end])
        if kind == b"IDAT":
            pixels.append(view[at + 8 : end - 4])
        if kind == b"IEND":
            _check_inflated(data, pixels)
            return b"".join(kept)
        at = end
    raise ImageError(f"the PNG image has more than {_MAX_PNG_CHUNKS:,} chunks", "save it with another program")


def _check_inflated(data: bytes, pixels: list[memoryview]) -> None:
    """Raises ImageError if the compressed `pixels` hold far more data than an image of the header's size."""
    width, height = _png_size(data)
    depth, colors = data[24], data[25]
    # Twice the size of the pixels, because each of the seven passes of an interlaced image has rows of its own.
    left = 2 * height * (1 + width * _PNG_CHANNELS.get(colors, 4) * depth // 8) + _MAX_EXCESS_BYTES
    if _DEFLATE_RATIO * sum(map(len, pixels)) <= left:
        return
    for size in _inflated(pixels):
        left -= size
        if left < 0:
            raise ImageError("the PNG image has far more data than pixels", "save it with another program")


def _inflated(parts: list[memoryview]) -> Iterator[int]:
    """Yields how many bytes each step of inflating a stream in `parts` gives."""
    inflater = zlib.decompressobj()
    for part in parts:
        rest: bytes | memoryview = part
        while rest and not inflater.eof:
            try:
                yield len(inflater.decompress(rest, _INFLATE_STEP))
            except zlib.error:
                raise corrupt_image("PNG") from None
            rest = inflater.unconsumed_tail


def _webp_size(data: bytes) -> tuple[int, int]:
    """Reads the size from the first chunk, in one of three forms: lossy, lossless or extended.

    An extended file's size is that of its image, or of the area for all images of its animation. Decoders refuse files
    with larger images.
    """
    if data[8:12] != b"WEBP":
        raise ImageError("not an image: its format is unknown", ACCEPTED)
    chunk = data[12:16]
    if chunk == b"VP8 ":
        return _number(data, 26, 2) & 0x3FFF, _number(data, 28, 2) & 0x3FFF
    if chunk == b"VP8L":
        bits = _number(data, 21, 4)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if chunk == b"VP8X":
        return _number(data, 24, 3) + 1, _number(data, 27, 3) + 1
    raise corrupt_image("WebP")


def _webp_body(data: bytes) -> bytes:
    """Returns the file up to the length in its header."""
    end = _number(data, 4, 4) + 8
    if end > len(data):
        raise IndexError
    return data[:end]


_FORMATS: Final = (
    ImageFormat("JPEG", _JPEG_MAGIC, _jpeg_size, _jpeg_body),
    ImageFormat("PNG", b"\x89PNG\r\n\x1a\n", _png_size, _png_body),
    ImageFormat("WebP", b"RIFF", _webp_size, _webp_body),
)
