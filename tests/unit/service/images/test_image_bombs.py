"""Files that are small and ask for a lot, and files that look odd and are fine."""

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
DECODED_TO_BE_REFUSED = {"png: two sizes", "webp: small canvas, huge image", "webp: small animation, huge frame"}


@pytest.mark.parametrize("name", bombs.BOMBS)
def test_a_bomb_is_refused_or_goes_off_unheard(name: str) -> None:
    make, why = bombs.BOMBS[name]
    if not why:
        assert decode(make(), LIMITS).shape == (180, 320, 3)
        return
    with pytest.raises(ImageError, match=why) as caught:
        decode(make(), LIMITS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", bombs.BOMBS.keys() - DECODED_TO_BE_REFUSED)
def test_no_decoder_sees_what_is_refused_or_what_inflates(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    monkeypatch.setattr(decoding.cv2, "imdecode", lambda file, flags: seen.append(file.size))
    make, why = bombs.BOMBS[name]
    with pytest.raises(ImageError):
        decode(make(), LIMITS)
    assert len(seen) == (not why)
    assert sum(seen) < 1000


def test_the_memory_for_a_bombs_pixels_is_never_asked_for() -> None:
    script = "import bombs; bombs.cost(bombs.png(320, 180)); print(*bombs.cost(bombs.huge_png()), sep='|')"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=Path(bombs.__file__).parent, capture_output=True, text=True, check=True
    )
    _, more_mb, outcome = done.stdout.split("|")
    assert "144,000,000 pixels" in outcome
    assert float(more_mb) < 20.0


def test_the_usual_bomb_is_the_one_that_is_spoken_of() -> None:
    assert 130_000 < len(bombs.huge_png()) < 150_000


def test_another_image_than_the_one_that_was_checked_is_not_given_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoding.cv2, "imdecode", lambda file, flags: np.zeros((180, 321, 3), np.uint8))
    with pytest.raises(ImageError, match="is corrupt"):
        decode(fakes.image_file(), LIMITS)


def turned(orientation: int) -> bytes:
    return b"MM\x00*" + struct.pack(">IHHHIHH", 8, 1, 0x0112, 3, 1, orientation, 0) + bytes(4)


def test_a_png_is_turned_upright_whatever_else_is_in_it() -> None:
    text = bombs.png_chunk(b"tEXt", b"Comment\0a road")
    exif = bombs.png_chunk(b"eXIf", turned(6))
    assert decode(bombs.png(320, 180, extra=text + exif + text), LIMITS).shape == (320, 180, 3)


def test_deep_palette_and_transparent_pngs_are_seen_as_they_look() -> None:
    grey = np.tile(np.linspace(0, 255, 320).astype(np.uint8), (180, 1))
    clear = cv2.merge([grey, grey, grey, np.full_like(grey, 9)])
    for image, expected in ((grey.astype(np.uint16) * 257, grey), (grey, grey), (clear, grey)):
        found = decode(cv2.imencode(".png", image)[1].tobytes(), LIMITS)
        assert np.array_equal(found, cv2.merge([expected] * 3))
    header = bombs.png_chunk(b"IHDR", struct.pack(">IIBBBBB", 320, 180, 8, 3, 0, 0, 0))
    colours = bombs.png_chunk(b"PLTE", bytes([10, 20, 30, 200, 100, 50])) + bombs.png_chunk(b"tRNS", bytes([0, 128]))
    rows = zlib.compress(b"".join(bytes([0]) + bytes([0, 1] * 160) for _ in range(180)))
    data = b"".join([bombs.PNG_MAGIC, header, colours, bombs.png_chunk(b"IDAT", rows), bombs.png_chunk(b"IEND", b"")])
    assert [tuple(pixel) for pixel in decode(data, LIMITS)[0, :2]] == [(30, 20, 10), (50, 100, 200)]


def test_a_large_camera_png_passes_the_count_of_its_data() -> None:
    noise = np.random.default_rng(7).integers(0, 256, (720, 1280, 3), np.uint8)
    assert np.array_equal(decode(cv2.imencode(".png", noise)[1].tobytes(), LIMITS), noise)


def test_a_jpeg_for_print_is_seen_as_it_looks() -> None:
    ramp = fakes.picture()
    file = io.BytesIO()
    Image.fromarray(ramp).convert("CMYK").save(file, "JPEG", quality=95)
    assert np.abs(decode(file.getvalue(), LIMITS).astype(int) - ramp).max() <= 6
