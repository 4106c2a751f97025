"""Which files are decoded, and the errors for all others."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib

import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError, ImageTooLargeError
from lanestream.images.decoding import ImageLimits, decode, decode_reduced
from lanestream.images.header import Header, read_header

import cv2  # isort: skip  (lanestream.images sets OpenCV's own limit before it is imported)

LIMITS = ImageLimits()
KINDS = {".jpg": "JPEG", ".png": "PNG", ".webp": "WebP"}


def png(width: int, height: int) -> bytes:
    """A PNG with a size in its header and without pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def error_from_code(data: bytes, limits: ImageLimits = LIMITS) -> str:
    with pytest.raises(ImageError) as caught:
        decode(data, limits)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def summary(header: Header) -> tuple[str, int, int]:
    return header.kind, header.width, header.height


@pytest.mark.parametrize("kind", KINDS)
def test_the_accepted_formats_are_decoded(kind: str) -> None:
    data = fakes.image_file(kind)
    assert summary(read_header(data)) == (KINDS[kind], 320, 180)
    image = decode(data, LIMITS)
    assert image.shape == (180, 320, 3)
    assert abs(int(image[90, 0, 0]) - 30) <= 3
    assert abs(int(image[90, -1, 2]) - 220) <= 3


@pytest.mark.parametrize("options", ["progressive", "restarts", "lossy"])
def test_variants_of_the_formats_are_decoded(options: str) -> None:
    import cv2
    import numpy as np

    image = np.full((100, 130, 3), 77, np.uint8)
    kind, flags = {
        "progressive": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        "restarts": (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
        "lossy": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 60]),
    }[options]
    data = cv2.imencode(kind, image, flags)[1].tobytes()
    assert summary(read_header(data)) == (KINDS[kind], 130, 100)
    assert decode(data, LIMITS).shape == (100, 130, 3)


def test_the_size_of_an_extended_webp_is_read() -> None:
    size = (1280 - 1).to_bytes(3, "little") + (720 - 1).to_bytes(3, "little")
    data = b"RIFF" + (22).to_bytes(4, "little") + b"WEBPVP8X" + (10).to_bytes(4, "little") + bytes(4) + size
    assert summary(read_header(data)) == ("WebP", 1280, 720)


JPEG_VARIANTS = {
    "baseline": [],
    "progressive": [cv2.IMWRITE_JPEG_PROGRESSIVE, 1],
    "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 3],
    "4:2:0": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420],
}


@pytest.mark.parametrize("variant", JPEG_VARIANTS)
@pytest.mark.parametrize("bottom", [128, 0, 255])
def test_a_jpeg_without_its_end_marker_is_read_if_it_has_all_pixels(variant: str, bottom: int) -> None:
    picture = np.full((96, 160, 3), bottom, np.uint8)
    picture[:64] = np.random.default_rng(4).integers(0, 255, (64, 160, 3), np.uint8)
    data = cv2.imencode(".jpg", picture, JPEG_VARIANTS[variant])[1].tobytes()
    expected = decode(data, LIMITS)
    for end in (data[:-2], data[:-1], data[:-1] + b"\xff"):
        np.testing.assert_array_equal(decode(end, LIMITS), expected)
        np.testing.assert_array_equal(decode_reduced(end, LIMITS, 80).image, decode_reduced(data, LIMITS, 80).image)
    for size in range(len(data) // 2, len(data) - 8, 1 + len(data) // 400):
        with pytest.raises(ImageError, match="cut short"):
            decode(data[:size], LIMITS)


def test_a_turned_jpeg_without_its_end_is_refused_if_pixels_are_missing() -> None:
    picture = np.random.default_rng(4).integers(0, 255, (96, 160, 3), np.uint8)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    for turn in range(1, 9):
        exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([turn]) + bytes(6)
        turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]
        assert decode(turned[:-2], LIMITS).shape == ((96, 160, 3) if turn < 5 else (160, 96, 3))
        with pytest.raises(ImageError, match="cut short"):
            decode(turned[:-500], LIMITS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_file_is_refused(kind: str) -> None:
    data = fakes.image_file(kind)
    for size in {*range(12, 60), *range(60, len(data) - 12, 41)}:
        with pytest.raises(ImageError, match=r"cut short|corrupt|format is unknown"):
            decode(data[:size], LIMITS)
    assert "its end is missing" in error_from_code(data[:-13])


def test_bytes_after_the_end_are_ignored() -> None:
    assert decode(fakes.image_file() + bytes(500), LIMITS).shape == (180, 320, 3)


def test_an_end_marker_in_a_preview_is_not_the_end() -> None:
    data = fakes.image_file()
    preview = b"\xff\xe1" + struct.pack(">H", 2 + len(data)) + data
    whole = data[:2] + preview + data[2:]
    assert decode(whole, LIMITS).shape == (180, 320, 3)
    assert "cut short" in error_from_code(whole[: 2 + len(preview) + 300])


@pytest.mark.parametrize(
    "data",
    [
        fakes.image_file()[:700] + bytes([255, 7]) * 100 + fakes.image_file()[900:],
        b"\xff\xd8\xff\xd9",
        b"\x89PNG\r\n\x1a\n" + bytes(40),
        png(320, 180),
        b"RIFF" + bytes(4) + b"WEBPnone" + bytes(30),
        fakes.image_file(".webp")[:40] + bytes(len(fakes.image_file(".webp")) - 40),
    ],
)
def test_corrupt_files_are_reported_as_corrupt(data: bytes) -> None:
    assert "is corrupt" in error_from_code(data)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "it is empty"),
        (b"hello\n", "it looks like text"),
        ("größe".encode(), "it looks like text"),
        (b'{"type": "frame"}', "it looks like text"),
        (b"\x00\x00\x00\x1cftypheic", "its format is HEIC"),
        (b"GIF89a\x01\x00\x01\x00", "its format is GIF"),
        (b"RIFF\x00\x00\x00\x00WAVE", "its format is unknown"),
    ],
)
def test_the_error_for_other_files_names_the_accepted_formats(data: bytes, why: str) -> None:
    assert error_from_code(data) == f"not an image: {why} (JPEG, PNG or WebP are accepted)"


def test_sizes_are_checked_before_anything_is_decoded() -> None:
    assert "1 x 1" in error_from_code(png(1, 1))
    assert "63 x 5000" in error_from_code(png(63, 5000))
    with pytest.raises(ImageTooLargeError, match="30000 x 30000, 900,000,000 pixels; at most 9,437,184"):
        decode(png(30_000, 30_000), LIMITS)
    with pytest.raises(ImageTooLargeError, match="1,001 bytes; at most 1,000"):
        decode(bytes(1001), ImageLimits(max_bytes=1000))


@pytest.mark.parametrize(("width", "height"), [(320, 180), (3840, 2160), (4096, 2160), (64, 64)])
def test_the_documented_sizes_are_accepted(width: int, height: int) -> None:
    assert decode(fakes.image_file(".jpg", width, height), LIMITS).shape == (height, width, 3)


def test_a_jpeg_with_too_many_scans_is_refused() -> None:
    data = fakes.image_file()
    scan = b"\xff\xda" + struct.pack(">H", 8) + bytes(6)
    assert "more than 100 scans" in error_from_code(data[:-2] + 101 * scan + data[-2:])


def rotated(data: bytes) -> bytes:
    """A JPEG file with the EXIF orientation of a camera that was rotated by 90 degrees."""
    tags = b"Exif\x00\x00MM\x00*" + struct.pack(">IH", 8, 1) + struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0) + bytes(4)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(tags)) + tags + data[2:]


def test_the_exif_orientation_is_applied() -> None:
    assert decode(rotated(fakes.image_file()), LIMITS).shape == (320, 180, 3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("size", "reduction"),
    [((1280, 720), 2), ((1278, 720), 1), ((2560, 1440), 4), ((1920, 1080), 2), ((1282, 721), 1), ((320, 180), 1)],
)
def test_large_images_are_reduced_if_their_sides_divide(kind: str, size: tuple[int, int], reduction: int) -> None:
    decoded = decode_reduced(fakes.image_file(kind, *size), LIMITS, 640)
    assert (decoded.size, decoded.reduction) == (size, reduction)
    assert decoded.image.shape == (size[1] // reduction, size[0] // reduction, 3)


def test_a_reduced_image_is_averaged_and_a_rotated_one_is_not_reduced() -> None:
    import cv2

    data = fakes.image_file(".jpg", 1280, 720)
    halves = cv2.resize(decode(data, LIMITS), (640, 360), interpolation=cv2.INTER_AREA)
    assert cv2.norm(decode_reduced(data, LIMITS, 640).image, halves, cv2.NORM_INF) <= 3
    decoded = decode_reduced(rotated(data), LIMITS, 640)
    assert (decoded.size, decoded.reduction) == ((720, 1280), 1)


def test_decode_reduced_refuses_the_same_files() -> None:
    data = fakes.image_file(".jpg", 1280, 720)
    with pytest.raises(ImageError, match="JPEG"):
        decode_reduced(data[: len(data) // 2], LIMITS, 640)
    with pytest.raises(ImageTooLargeError):
        decode_reduced(data, ImageLimits(max_pixels=640 * 360), 640)


def test_opencvs_own_limit_is_set_before_it_is_imported() -> None:
    script = (
        "import lanestream.images.decoding, cv2, numpy, sys; data = sys.stdin.buffer.read();"
        "cv2.imdecode(numpy.frombuffer(data, 'u1'), 1)"
    )
    result = subprocess.run([sys.executable, "-c", script], input=png(30_000, 30_000), capture_output=True, check=False)
    assert b"CV_IO_MAX_IMAGE_PIXELS" in result.stderr or b"pixels <=" in result.stderr


def test_an_elongated_image_is_refused() -> None:
    for width, height in ((64, 321), (321, 64)):
        with pytest.raises(ImageError, match="too elongated"):
            decode(fakes.image_file(".png", width, height), ImageLimits())
    assert decode(fakes.image_file(".png", 320, 64), ImageLimits()).shape == (64, 320, 3)
