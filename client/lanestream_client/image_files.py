"""Image files: which a folder has, and how those are read whose format the service does not accept."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from lanestream.errors import SourceError, needs_extra

# What the service accepts, and what is converted to JPEG before.
IMAGE_SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif", ".heic", ".heif")
_CONVERTED: Final = re.compile(rb"BM|II\*\0|MM\0\*|....ftypavi[fs]", re.DOTALL)
_JPEG_QUALITY: Final = 95
NO_JPEG_END: Final = "the JPEG has no end marker; if it was cut short, its last pixels are missing"


def image_files(folder: Path, notify: Callable[[str], object] | None = None) -> list[Path]:
    """Returns the image files in `folder` in natural order, 2.jpg before 10.jpg. Raises SourceError if it has none.

    If the folder holds anything else, except hidden files, `notify` is called with a line that counts it.
    """
    entries = [path for path in folder.iterdir() if not path.name.startswith(".")]
    files = [path for path in entries if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    others = Counter(_kind(path) for path in set(entries) - set(files))
    passed_over = ", ".join(f"{kind}: {number}" for kind, number in sorted(others.items()))
    if not files:
        holds = f" (it holds {passed_over})" if passed_over else ""
        raise SourceError(
            f"no images in the folder {folder}{holds}", f"accepted file types: {', '.join(IMAGE_SUFFIXES)}"
        )
    if passed_over and notify is not None:
        notify(f"{folder}: skipped everything but image files ({passed_over})")
    return sorted(files, key=lambda path: natural_key(path.name))


def read_image_file(path: Path) -> bytes:
    """Returns the content of an image file. A BMP, TIFF or AVIF file, which no service accepts, is made a JPEG.

    Raises SourceError if it can't be read. A file that can't be decoded is returned as it is.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"can't read {path}: {(error.strerror or str(error)).lower()}") from None
    return _converted(data) if _CONVERTED.match(data) else data


def lacks_jpeg_end(data: bytes) -> bool:
    """Returns whether an image file is a JPEG without its end marker: it was cut off, perhaps with pixels."""
    return data.startswith(b"\xff\xd8\xff") and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")


def _converted(data: bytes) -> bytes:
    with needs_extra("video"):
        import cv2
        import numpy as np
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        return data
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _kind(path: Path) -> str:
    return "folders" if path.is_dir() else path.suffix.lower() or "files without a suffix"


def natural_key(name: str) -> list[tuple[int, str]]:
    """Returns the key by which names are in natural order, 2.jpg before 10.jpg."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name.lower())]
