"""Mask images as labels: PNG files in which the pixels of lane boundaries are not black.

In a binary mask (one value besides zero) every connected piece is a boundary, a dash as well as a line; pieces that
touch are taken apart where they meet. In an instance mask every value, or colour, is one boundary with all its dashes.
A boundary's points are the centroids of its pixels, row by row.

A mask is masks/NAME.png for images/NAME.jpg (or .png, .webp), sub-folders alike, or NAME_mask.png beside NAME.jpg.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes

from lanestream.errors import ImageError, LabelError
from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.entries import Entries, Entry
from lanestream_exporter.datasets.folder import IMAGE_FOLDERS, DataFolder, drive_of
from lanestream_exporter.datasets.labels import LabelledLane
from lanestream_exporter.datasets.pictures import Picture, checked_header, file_bytes
from lanestream_exporter.datasets.records import placed

_MASK_FOLDERS: Final = frozenset({"mask", "masks", "segmentation"})
_BESIDE: Final = "_mask"
_MOST_INSTANCES: Final = 32
_LEAST_ROWS: Final = 3  # fewer are a speck


def is_mask(path: Path) -> bool:
    """Whether `path` is where masks are kept."""
    in_folder = not _MASK_FOLDERS.isdisjoint(path.absolute().parent.parts[-3:])
    return path.suffix.lower() == ".png" and (in_folder or path.stem.endswith(_BESIDE))


def mask_entries(folder: DataFolder) -> Entries:
    """The frames that have a mask; a group is the folder of the images."""
    for path in filter(is_mask, folder.files):
        try:
            image = _image_of(path, folder)
            mask = _read(path)
            lanes = dict(_lanes(mask))
        except (LabelError, ImageError) as error:
            yield placed(str(path), error)
            continue
        height, width = mask.shape
        yield Entry(str(path), folder.name(image), drive_of(image.parent), Picture(image), lanes, (width, height))


def _image_of(mask: Path, folder: DataFolder) -> Path:
    if mask.stem.endswith(_BESIDE):
        return folder.picture_of(mask.with_name(mask.stem[: -len(_BESIDE)]))
    parts = mask.absolute().with_suffix("").parts
    at = max(number for number, part in enumerate(parts[:-1]) if part in _MASK_FOLDERS)
    for name in IMAGE_FOLDERS:
        if Path(*parts[:at], name).is_dir():
            return folder.picture_of(Path(*parts[:at], name, *parts[at + 1 :]))
    raise LabelError("there is no folder images beside its own", "masks/NAME.png belongs to images/NAME.jpg")


def _read(path: Path) -> NDArray[np.int64]:
    """The mask as one number a pixel (H, W). Raises ImageError where it can't be decoded, or is no PNG file."""
    data = file_bytes(path)
    if checked_header(data).kind != "PNG":
        raise ImageError("a mask has to be a PNG file: other kinds smear its values")
    try:
        mask = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        mask = None
    if mask is None:
        raise ImageError("the PNG image is corrupt and can't be decoded")
    if mask.ndim == 2:
        return mask.astype(np.int64)
    packed: NDArray[np.int64] = mask[:, :, :3].astype(np.int64) @ np.array([1 << 32, 1 << 16, 1])
    return packed


def _lanes(mask: NDArray[np.int64]) -> Iterator[tuple[str, LabelledLane]]:
    values = [value for value in np.unique(mask) if value]
    if len(values) > _MOST_INSTANCES:
        raise LabelError(
            f"it has {len(values)} different values", "a mask has one value, or one a boundary, with hard edges"
        )
    if len(values) == 1:
        for number, points in enumerate(_pieces(mask != 0), start=1):
            yield f"piece {number}", LabelledLane(points)
        return
    for number, value in enumerate(values, start=1):
        yield f"instance {number}", LabelledLane(_centroids(mask == value), number)


def _centroids(pixels: NDArray[np.bool_]) -> FloatArray:
    """The mean column of the pixels in each row that has some, from below upwards (N, 2)."""
    counts = pixels.sum(axis=1)
    rows = np.flatnonzero(counts)[::-1]
    means = (pixels @ np.arange(pixels.shape[1]))[rows] / counts[rows]
    return np.stack([means, rows], axis=1).astype(np.float64)


@dataclass(eq=False)
class _Piece:
    """Runs of pixels one above the other: a boundary as far as it is traced."""

    start: int = 0
    end: int = 0
    points: list[tuple[float, float]] = field(default_factory=list)
    merged: bool = False  # begun where several met: no single boundary any more

    def extend(self, start: int, end: int, row: int) -> None:
        """Goes on with the run [start, end) of a row."""
        self.start, self.end = start, end
        self.points.append(((start + end - 1) / 2.0, float(row)))

    def heir(self, runs: list[tuple[int, int]]) -> int | None:
        """Which of the next row's runs goes on with this one: the one that touches it most, be it by a corner."""
        shared = [min(end, self.end) - max(start, self.start) for start, end in runs]
        best = int(np.argmax(shared)) if shared else None
        return best if best is not None and shared[best] >= 0 else None

    @property
    def grown(self) -> bool:
        """Whether it is more than a speck."""
        return len(self.points) >= _LEAST_ROWS


def _pieces(pixels: NDArray[np.bool_]) -> Iterator[FloatArray]:
    """Connected pieces as points from below upwards; pieces that meet end there, and what follows is left out."""
    filled = binary_fill_holes(pixels)
    alive: list[_Piece] = []
    for row in range(len(filled) - 1, -1, -1):
        runs = _runs(filled[row])
        heirs = [piece.heir(runs) for piece in alive]
        above = []
        for number, run in enumerate(runs):
            below = [piece for piece, heir in zip(alive, heirs, strict=True) if heir == number]
            # Specks at a ragged edge don't count as something that is met.
            below = [piece for piece in below if piece.grown] or below[:1]
            piece = below[0] if len(below) == 1 else _Piece(merged=bool(below))
            piece.extend(*run, row)
            above.append(piece)
        yield from _finished([piece for piece in alive if piece not in above])
        alive = above
    yield from _finished(alive)


def _runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """(start, end) of each run of set pixels in a row, the end exclusive."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [(int(start), int(end)) for start, end in steps.reshape(-1, 2)]


def _finished(pieces: list[_Piece]) -> Iterator[FloatArray]:
    for piece in pieces:
        if piece.grown and not piece.merged:
            yield np.array(piece.points)
