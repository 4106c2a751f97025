"""What can be known of an image file without decoding it, and the part of it that a decoder needs.

A file is told apart by its first bytes and measured by its header. The rest is walked through chunk by chunk, because
each format lets a small file ask for a lot of work that has nothing to do with its pixels.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from lanestream.errors import ImageError

ACCEPTED: Final = "JPEG, PNG or WebP are accepted"

# Inside JPEG scans 0xff is followed by a stuffed zero, a restart marker or padding; whatever else follows is a marker.
_JPEG_MARKER: Final = re.compile(rb"\xff([^\x00\xd0-\xd7\xff])")
_JPEG_FIRST: Final = 0xC0
_JPEG_SIZE_MARKERS: Final = frozenset(range(_JPEG_FIRST, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_START_OF_SCAN: Final = 0xDA
_JPEG_END: Final = 0xD9
# A marker without a length: what decoders read right after it must not be skipped here.
_JPEG_TEMPORARY: Final = 0x01
# Every scan of a progressive JPEG is a pass over all pixels, and an empty one costs its sender only a few bytes.
_MOST_JPEG_SCANS: Final = 100
_MOST_JPEG_SEGMENTS: Final = 2000

_PNG_CHUNKS_AT: Final = 8
_MOST_PNG_CHUNKS: Final = 10_000
# Beside the chunks that every decoder has to know: transparency, and which side is up.
_PNG_KEPT: Final = frozenset({b"tRNS", b"eXIf"})
_PNG_OPTIONAL: Final = 0x20
_PNG_CHANNELS: Final = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
# Deflate makes of one byte that many at most; a decoder inflates all of them, also those that are no pixels. What that
# costs in vain is less than a second; to make sure of less would cost every PNG of a camera as much as its decoding.
_DEFLATE_RATIO: Final = 1032
_INFLATED_FOR_NOTHING: Final = 1 << 30
_INFLATE_STEP: Final = 1 << 18

_BINARY: Final = re.compile(rb"[\x00-\x08\x0e-\x1f]")


@dataclass(frozen=True)
class Format:
    """A kind of image file: how it begins, how its (width, height) is read, and how what a decoder needs is got."""

    kind: str
    magic: bytes
    read_size: Callable[[bytes], tuple[int, int]]
    read_body: Callable[[bytes], bytes]


@dataclass(frozen=True)
class Header:
    """What an image file says of itself at its beginning: pixels before any turn that its EXIF data ask for."""

    format: Format
    width: int
    height: int

    @property
    def kind(self) -> str:
        """JPEG, PNG or WebP."""
        return self.format.kind


def read_header(data: bytes) -> Header:
    """Kind and size of the image file in `data`, nothing decoded. Raises ImageError where it is none of the kinds."""
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
    """The file in `data` with nothing in it but what a decoder needs for its pixels.

    Raises ImageError where it is cut short or asks for far more work than its pixels do.
    """
    try:
        return header.format.read_body(data)
    except IndexError:
        raise ImageError(f"the {header.kind} image is cut short: its end is missing", "send the whole file") from None


def corrupt(kind: str) -> ImageError:
    """The error of a file that begins as one of a kind and can't be decoded."""
    return ImageError(f"the {kind} image is corrupt and can't be decoded", ACCEPTED)


def _describe(data: bytes) -> str:
    if not data:
        return "it is empty"
    return "its kind is unknown" if _BINARY.search(data[:64]) else "it looks like text"


def _number(data: bytes, start: int, size: int, *, big: bool = False) -> int:
    part = data[start : start + size]
    if len(part) < size:
        raise IndexError
    return int.from_bytes(part, "big" if big else "little")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """The size stands in the first frame segment, and a decoder refuses a second one."""
    at = _walk_jpeg(data, _JPEG_SIZE_MARKERS)
    return _number(data, at + 5, 2, big=True), _number(data, at + 3, 2, big=True)


def _jpeg_body(data: bytes) -> bytes:
    """All of the file up to its end marker: many cameras pad their files, some append a preview."""
    return data[: _walk_jpeg(data, frozenset({_JPEG_END}))]


def _walk_jpeg(data: bytes, wanted: frozenset[int]) -> int:
    """Goes from marker to marker as a decoder does; where the first of the `wanted` ones ends.

    Raises IndexError where none comes, and ImageError where no decoder would go on to it, or too long.
    """
    at, scans = 2, 0
    for _ in range(_MOST_JPEG_SEGMENTS):
        match = _JPEG_MARKER.search(data, at)
        if match is None:
            raise IndexError
        marker, at = match.group(1)[0], match.end()
        if marker in wanted:
            return at
        if marker == _JPEG_END or _JPEG_TEMPORARY < marker < _JPEG_FIRST:
            raise corrupt("JPEG")
        scans += marker == _JPEG_START_OF_SCAN
        if scans > _MOST_JPEG_SCANS:
            raise ImageError(f"the JPEG image has more than {_MOST_JPEG_SCANS} scans", "save it as a baseline JPEG")
        if marker != _JPEG_TEMPORARY:
            at += _number(data, at, 2, big=True)
    raise ImageError(f"the JPEG image has more than {_MOST_JPEG_SEGMENTS:,} segments", "save it as a baseline JPEG")


def _png_size(data: bytes) -> tuple[int, int]:
    """The size stands in IHDR, always the first chunk."""
    if data[12:16] != b"IHDR":
        raise corrupt("PNG")
    return _number(data, 16, 4, big=True), _number(data, 20, 4, big=True)


def _png_body(data: bytes) -> bytes:
    """The file without what is no pixels: texts and profiles may inflate a thousandfold, animations are ignored."""
    view = memoryview(data)
    kept, pixels = [view[:_PNG_CHUNKS_AT]], []
    at, once = _PNG_CHUNKS_AT, set(_PNG_KEPT)
    for _ in range(_MOST_PNG_CHUNKS):
        kind, end = data[at + 4 : at + 8], at + 12 + _number(data, at, 4, big=True)
        if end > len(data):
            raise IndexError
        if not kind[0] & _PNG_OPTIONAL or kind in once:
            once.discard(kind)
            kept.append(view[at:end])
        if kind == b"IDAT":
            pixels.append(view[at + 8 : end - 4])
        if kind == b"IEND":
            _check_inflated(data, pixels)
            return b"".join(kept)
        at = end
    raise ImageError(f"the PNG image has more than {_MOST_PNG_CHUNKS:,} chunks", "save it with another program")


def _check_inflated(data: bytes, pixels: list[memoryview]) -> None:
    """Raises ImageError where the compressed `pixels` hold far more than the image that the header promises."""
    width, height = _png_size(data)
    depth, colours = data[24], data[25]
    # Twice as much as the pixels take, because the seven passes of an interlaced image each begin their rows anew.
    left = 2 * height * (1 + width * _PNG_CHANNELS.get(colours, 4) * depth // 8) + _INFLATED_FOR_NOTHING
    if _DEFLATE_RATIO * sum(map(len, pixels)) <= left:
        return
    for size in _inflated(pixels):
        left -= size
        if left < 0:
            raise ImageError("the PNG image has far more data than pixels", "save it with another program")


def _inflated(parts: list[memoryview]) -> Iterator[int]:
    """How many bytes are in a stream in `parts`, step by step."""
    inflater = zlib.decompressobj()
    for part in parts:
        rest: bytes | memoryview = part
        while rest and not inflater.eof:
            try:
                yield len(inflater.decompress(rest, _INFLATE_STEP))
            except zlib.error:
                raise corrupt("PNG") from None
            rest = inflater.unconsumed_tail


def _webp_size(data: bytes) -> tuple[int, int]:
    """The size stands in the first chunk, in one of three forms: lossy, lossless or extended.

    An extended file's canvas is that of its one image, or holds all images of its animation: a decoder refuses others.
    """
    if data[8:12] != b"WEBP":
        raise ImageError("not an image: its kind is unknown", ACCEPTED)
    chunk = data[12:16]
    if chunk == b"VP8 ":
        return _number(data, 26, 2) & 0x3FFF, _number(data, 28, 2) & 0x3FFF
    if chunk == b"VP8L":
        bits = _number(data, 21, 4)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if chunk == b"VP8X":
        return _number(data, 24, 3) + 1, _number(data, 27, 3) + 1
    raise corrupt("WebP")


def _webp_body(data: bytes) -> bytes:
    """All of the file up to the length that its beginning tells."""
    end = _number(data, 4, 4) + 8
    if end > len(data):
        raise IndexError
    return data[:end]


_FORMATS: Final = (
    Format("JPEG", b"\xff\xd8\xff", _jpeg_size, _jpeg_body),
    Format("PNG", b"\x89PNG\r\n\x1a\n", _png_size, _png_body),
    Format("WebP", b"RIFF", _webp_size, _webp_body),
)
