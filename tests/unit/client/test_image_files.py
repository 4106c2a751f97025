"""Image files of all formats, and what else is in a folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError, SourceError
from lanestream.images.decoding import ImageLimits, decode
from lanestream_client.image_files import image_files, lacks_jpeg_end, read_image_file
from lanestream_client.sources import open_source

HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100)


def picture() -> np.ndarray:
    return np.asarray(cv2.imdecode(np.frombuffer(fakes.image_file(), np.uint8), cv2.IMREAD_COLOR))


@pytest.mark.parametrize("suffix", [".bmp", ".tif", ".TIFF", ".avif", ".jpg", ".png", ".webp"])
@pytest.mark.parametrize("named", [True, False])
def test_every_format_is_read_by_its_content(suffix: str, named: bool, tmp_path: Path) -> None:
    path = tmp_path / ("picture" + (suffix if named else ".jpg"))
    path.write_bytes(cv2.imencode(suffix.lower(), picture())[1].tobytes())
    expected = decode(fakes.image_file(), ImageLimits())
    with open_source(str(path)) as source:
        (frame,) = source.frames
    for data in (read_image_file(path), frame.encoded()):
        assert np.abs(decode(data, ImageLimits()).astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (HEIC, "its format is HEIC"),
        (b"\0\0\0\x1cftypavif" + bytes(50), "its format is AVIF"),
        (b"II*\0" + bytes(50), "its format is TIFF"),
        (b"BM" + bytes(50), "its format is BMP"),
        (b"GIF89a" + bytes(50), "its format is GIF"),
        (b"<?xml version='1.0'?><svg>", "its format is SVG"),
        (b"some text", "it looks like text"),
    ],
)
def test_what_cannot_be_read_has_one_message(data: bytes, reason: str, tmp_path: Path) -> None:
    (tmp_path / "x.heic").write_bytes(data)
    with open_source(str(tmp_path / "x.heic")) as source:
        (frame,) = source.frames
    for each in (data, frame.encoded(), read_image_file(tmp_path / "x.heic")):
        with pytest.raises(ImageError) as caught:
            decode(each, ImageLimits())
        assert str(caught.value) == f"not an image: {reason} (JPEG, PNG or WebP are accepted)"


def test_what_a_folder_holds_beside_images_is_counted(tmp_path: Path) -> None:
    for name in ("10.jpg", "2.JPG", "a.txt", "b.txt", "README", ".hidden.jpg", ".DS_Store", "c.mp4"):
        (tmp_path / name).touch()
    (tmp_path / "more.jpg").mkdir()
    lines: list[str] = []
    assert [path.name for path in image_files(tmp_path, lines.append)] == ["2.JPG", "10.jpg"]
    assert lines == [
        f"{tmp_path}: skipped everything but image files (.mp4: 1, .txt: 2, files without a suffix: 1, folders: 1)"
    ]
    with open_source(str(tmp_path), notify=lines.append) as source:
        assert source.length == 2
    assert lines[1:] == lines[:1]


def test_a_folder_without_images_says_what_it_holds(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no images in the folder \S+ \(accepted file types: \.jpg"):
        image_files(tmp_path)
    (tmp_path / "a.raw").touch()
    with pytest.raises(SourceError, match=r"no images in the folder \S+ \(it holds \.raw: 1\) \(accepted"):
        image_files(tmp_path)


def test_a_jpeg_without_its_end_marker_is_recognized() -> None:
    data = fakes.image_file()
    thumbnail = data[:2] + b"\xff\xe1\x00\x10" + b"\xff\xda-------\xff\xd9---" + data[2:]
    assert [
        lacks_jpeg_end(each) for each in (data, data + bytes(100), thumbnail, fakes.image_file(".png"), b"")
    ] == 5 * [False]
    assert [lacks_jpeg_end(each) for each in (data[:-2], data[:-1], thumbnail[:-2])] == 3 * [True]
