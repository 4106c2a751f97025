"""Small files that would cost much memory or time, and unusual files that are valid."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import bombs
import cv2
import fakes
import numpy as np
import pytest
from PIL import Image

from lanestream.errors import ImageError
from lanestream.images import decoding
from lanestream.images.decoding import ImageLimits, decode

LIMITS = ImageLimits()
REFUSED_BY_THE_DECODER = {"png: two sizes", "webp: small header, huge image", "webp: small animation, huge frame"}


@pytest.mark.parametrize("name", bombs.BOMBS)
def test_a_bomb_is_refused_or_decoded_without_its_ballast(name: str) -> None:
    make, message = bombs.BOMBS[name]
    if not message:
        assert decode(make(), LIMITS).shape == (180, 320, 3)
        return
    with pytest.raises(ImageError, match=message) as caught:
        decode(make(), LIMITS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", sorted(bombs.BOMBS.keys() - REFUSED_BY_THE_DECODER))
def test_the_decoder_gets_neither_refused_files_nor_ballast(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    monkeypatch.setattr(decoding.cv2, "imdecode", lambda file, flags: sizes.append(file.size))
    make, message = bombs.BOMBS[name]
    with pytest.raises(ImageError):
        decode(make(), LIMITS)
    assert len(sizes) == (not message)
    assert sum(sizes) < 1000


def test_the_memory_for_a_bombs_pixels_is_never_allocated() -> None:
    script = "import bombs; bombs.cost(bombs.png(320, 180)); print(*bombs.cost(bombs.huge_png()), sep='|')"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=Path(bombs.__file__).parent, capture_output=True, text=True, check=True
    )
    _, added_mb, outcome = done.stdout.split("|")
    assert "144,000,000 pixels" in outcome
    assert float(added_mb) < 20.0


def test_the_huge_png_has_the_documented_size() -> None:
    assert 130_000 < len(bombs.huge_png()) < 150_000


def test_an_image_of_another_size_than_in_the_header_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoding.cv2, "imdecode", lambda file, flags: np.zeros((180, 321, 3), np.uint8))
    with pytest.raises(ImageError, match="is corrupt"):
        decode(fakes.image_file(), LIMITS)


def exif(orientation: int) -> bytes:
    return b"MM\x00*" + struct.pack(">IHHHIHH", 8, 1, 0x0112, 3, 1, orientation, 0) + bytes(4)


def test_the_exif_orientation_of_a_png_is_applied_among_other_chunks() -> None:
    text = bombs.png_chunk(b"tEXt", b"Comment\0a road")
    orientation = bombs.png_chunk(b"eXIf", exif(6))
    assert decode(bombs.png(320, 180, extra=text + orientation + text), LIMITS).shape == (320, 180, 3)


def test_16_bit_palette_and_transparent_pngs_are_decoded() -> None:
    gray = np.tile(np.linspace(0, 255, 320).astype(np.uint8), (180, 1))
    clear = cv2.merge([gray, gray, gray, np.full_like(gray, 9)])
    for image, expected in ((gray.astype(np.uint16) * 257, gray), (gray, gray), (clear, gray)):
        found = decode(cv2.imencode(".png", image)[1].tobytes(), LIMITS)
        assert np.array_equal(found, cv2.merge([expected] * 3))
    header = bombs.png_chunk(b"IHDR", struct.pack(">IIBBBBB", 320, 180, 8, 3, 0, 0, 0))
    colors = bombs.png_chunk(b"PLTE", bytes([10, 20, 30, 200, 100, 50])) + bombs.png_chunk(b"tRNS", bytes([0, 128]))
    rows = zlib.compress(b"".join(bytes([0]) + bytes([0, 1] * 160) for _ in range(180)))
    data = b"".join([bombs.PNG_MAGIC, header, colors, bombs.png_chunk(b"IDAT", rows), bombs.png_chunk(b"IEND", b"")])
    assert [tuple(pixel) for pixel in decode(data, LIMITS)[0, :2]] == [(30, 20, 10), (50, 100, 200)]


def test_a_large_png_that_hardly_compresses_is_decoded() -> None:
    noise = np.random.default_rng(7).integers(0, 256, (720, 1280, 3), np.uint8)
    assert np.array_equal(decode(cv2.imencode(".png", noise)[1].tobytes(), LIMITS), noise)


def test_a_cmyk_jpeg_is_decoded() -> None:
    ramp = fakes.picture()
    file = io.BytesIO()
    Image.fromarray(ramp).convert("CMYK").save(file, "JPEG", quality=95)
    assert np.abs(decode(file.getvalue(), LIMITS).astype(int) - ramp).max() <= 6
