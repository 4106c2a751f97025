"""Small image files that would cost much memory or time, or that hide another image than the one that is checked.

python tests/bombs.py     prints the cost of each
"""

from __future__ import annotations

import os
import struct
import time
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import fakes

from lanestream.errors import ImageError
from lanestream.images.decoding import ImageLimits, decode

HUGE: Final = (20_000, 15_000)
PNG_MAGIC: Final = b"\x89PNG\r\n\x1a\n"


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, pixels: bytes | None = None, extra: bytes = b"", colors: int = 2) -> bytes:
    """A black RGB PNG with `extra` chunks before its pixels; `pixels` replaces its compressed data."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, colors, 0, 0, 0))
    if pixels is None:
        pixels = zlib.compress(bytes(height * (1 + 3 * width)), 9)
    return PNG_MAGIC + header + extra + png_chunk(b"IDAT", pixels) + png_chunk(b"IEND", b"")


def with_checksums(data: bytes) -> bytes:
    """A PNG with the right checksum after every chunk, so that decoders read on; other data unchanged."""
    fixed, at = bytearray(data), len(PNG_MAGIC)
    while data.startswith(PNG_MAGIC) and at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data):
            break
        fixed[end - 4 : end] = struct.pack(">I", zlib.crc32(data[at + 4 : end - 4]))
        at = end
    return bytes(fixed)


def zeros(size: int) -> bytes:
    """`size` zeros (a whole number of MB), compressed a thousandfold, without the end of the stream."""
    packer = zlib.compressobj(9)
    head = packer.compress(b"") + packer.flush(zlib.Z_FULL_FLUSH)
    megabyte = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return head + (size >> 20) * megabyte


def huge_png() -> bytes:
    """The classic decompression bomb: 140 KB of gray that decode to 144 megapixels, 430 MB of BGR."""
    return png(12_000, 12_000, zeros(12_000 * 12_001), colors=0)


def apng(first: tuple[int, int], frames: int) -> bytes:
    """An animated PNG of 320 x 180 whose first frame claims another size."""

    def control(seq: int, width: int, height: int) -> bytes:
        return png_chunk(b"fcTL", struct.pack(">IIIIIHHBB", seq, width, height, 0, 0, 1, 10, 0, 0))

    animation = png_chunk(b"acTL", struct.pack(">II", frames, 0)) + control(0, *first)
    still = png(320, 180, extra=animation)
    end = png_chunk(b"IEND", b"")
    more = b"".join(
        control(2 * at + 1, 1, 1) + png_chunk(b"fdAT", struct.pack(">I", 2 * at + 2) + zlib.compress(bytes(4)))
        for at in range(frames - 1)
    )
    return still.removesuffix(end) + more + end


def resized_jpeg(width: int, height: int) -> bytes:
    """A JPEG of 320 x 180 whose header claims another size."""
    data = fakes.image_file()
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


def jpeg_segment(marker: int, data: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", 2 + len(data)) + data


def jpeg_behind_a_marker() -> bytes:
    """A huge JPEG behind the marker TEM, which has no length: readers that expect one see the small JPEG after it."""
    hidden = resized_jpeg(8000, 8000)[2:]
    return b"\xff\xd8" + jpeg_segment(0x01, hidden) + fakes.image_file()[2:]


def jpeg_of_scans(scans: int, width: int = 4096, height: int = 2304) -> bytes:
    """A progressive JPEG whose scans are empty."""
    parts = b"".join(bytes([number, 0x11, 0]) for number in (1, 2, 3))
    tables = jpeg_segment(0xDB, bytes(1) + bytes([1] * 64))
    for kind, symbol in ((0x00, 0x00), (0x10, 0xE0)):
        tables += jpeg_segment(0xC4, bytes([kind, 1]) + bytes(15) + bytes([symbol]))
    frame = jpeg_segment(0xC2, struct.pack(">BHHB", 8, height, width, 3) + parts)
    first = jpeg_segment(0xDA, bytes([3, 1, 0, 2, 0, 3, 0, 0, 0, 1])) + bytes(10)
    again = jpeg_segment(0xDA, bytes([3, 1, 0, 2, 0, 3, 0, 0, 0, 0x10])) + bytes(1)
    return b"\xff\xd8" + tables + frame + first + (scans - 1) * again + b"\xff\xd9"


def webp_chunk(kind: bytes, data: bytes) -> bytes:
    return kind + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)


def webp(size: tuple[int, int], image: bytes, *, animated: bool = False) -> bytes:
    """An extended WebP that claims `size` and contains the image of the WebP file `image`."""

    def int24(number: int) -> bytes:
        return number.to_bytes(3, "little")

    width, height = size
    body = webp_chunk(b"VP8X", bytes([2 if animated else 0, 0, 0, 0]) + int24(width - 1) + int24(height - 1))
    if animated:
        frame = bytes(6) + int24(width - 1) + int24(height - 1) + int24(100) + bytes(1) + image[12:]
        body += webp_chunk(b"ANIM", bytes(6)) + webp_chunk(b"ANMF", frame)
    else:
        body += image[12:]
    return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body


def huge_webp() -> bytes:
    return fakes.image_file(".webp", 5000, 4000, 9)


# Each bomb with a part of the error message, or with an empty one if it is an ordinary image with ballast.
BOMBS: Final[Mapping[str, tuple[Callable[[], bytes], str]]] = {
    "png: huge": (huge_png, "12000 x 12000, 144,000,000 pixels"),
    "png: far more data than pixels": (lambda: png(320, 180, zeros(140 << 20)), "far more data than pixels"),
    "png: texts that inflate": (
        lambda: png(320, 180, extra=200 * png_chunk(b"zTXt", b"x\0\0" + zeros(7 << 20))),
        "",
    ),
    "png: a profile that inflates": (
        lambda: png(320, 180, extra=png_chunk(b"iCCP", b"x\0\0" + zeros(64 << 20))),
        "",
    ),
    "png: a million chunks": (lambda: png(320, 180, extra=400_000 * png_chunk(b"tEXt", b"x\0y")), "10,000 chunks"),
    "png: two sizes": (lambda: png(320, 180, extra=png(*HUGE, b"")[8:33]), "is corrupt"),
    "apng: a huge frame": (lambda: apng((8000, 8000), 2), ""),
    "apng: many frames": (lambda: apng((320, 180), 4000), ""),
    "jpeg: huge": (lambda: resized_jpeg(65_000, 65_000), "4,225,000,000 pixels"),
    "jpeg: huge, behind a marker": (jpeg_behind_a_marker, "64,000,000 pixels"),
    "jpeg: huge, and a second size": (lambda: resized_jpeg(64, 8000)[:-2] + resized_jpeg(8000, 8000), "elongated"),
    "jpeg: empty scans": (lambda: jpeg_of_scans(101, 320, 180), "more than 100 scans"),
    "jpeg: empty scans of many pixels": (lambda: jpeg_of_scans(11), "more than 10 scans"),
    "jpeg: two million segments": (
        lambda: b"\xff\xd8" + 2_000_000 * jpeg_segment(0xFE, b"") + fakes.image_file()[2:],
        "2,000 segments",
    ),
    "webp: huge": (huge_webp, "20,000,000 pixels"),
    "webp: huge size": (lambda: webp((16_000, 16_000), fakes.image_file(".webp")), "256,000,000 pixels"),
    "webp: small header, huge image": (lambda: webp((320, 180), huge_webp()), "is corrupt"),
    "webp: small animation, huge frame": (lambda: webp((320, 180), huge_webp(), animated=True), "is corrupt"),
}


def peak_mb() -> float:
    """Returns the peak memory of this process in MB."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(line.split()[1]) / 1024


def cost(data: bytes) -> tuple[float, float, str]:
    """Returns the milliseconds, the MB added to the peak memory and the outcome of decoding `data`."""
    before, started = peak_mb(), time.perf_counter()
    try:
        outcome = f"image of {decode(data, ImageLimits()).shape}"
    except ImageError as error:
        outcome = str(error)
    return 1e3 * (time.perf_counter() - started), peak_mb() - before, outcome


def main() -> None:
    """Prints the costs, each measured in a process of its own after ordinary images of all formats."""
    for name, (make, _) in BOMBS.items():
        data = make()
        if os.fork():
            os.wait()
            continue
        for kind in (".jpg", ".png", ".webp"):
            decode(fakes.image_file(kind), ImageLimits())
        milliseconds, added, outcome = cost(data)
        print(f"{name:36}{len(data):>11,} B {milliseconds:8.2f} ms {added:7.1f} MB  {outcome}", flush=True)
        os._exit(0)


if __name__ == "__main__":
    main()
