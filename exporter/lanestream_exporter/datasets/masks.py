"""Reads masks: PNG files in which the pixels of lane boundaries are not black.

In a binary mask (one value other than zero) every connected piece is a boundary, whether a dash or a whole line; pieces
that touch are separated where they meet. In an instance mask every value or color is one boundary with all its dashes.
The points of a boundary are the centroids of its pixels, row by row.

A mask is masks/NAME.png for images/NAME.jpg (or .png, .webp), with the same subfolders, or NAME_mask.png next to
NAME.jpg.
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
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry
from lanestream_exporter.datasets.files import IMAGE_FOLDERS, DataFolder, drive_of, error_at
from lanestream_exporter.datasets.images import ImageLocation, checked_header, file_bytes
from lanestream_exporter.datasets.labels import LabeledLane

_MASK_FOLDERS: Final = frozenset({"mask", "masks", "segmentation"})
_STEM_END: Final = "_mask"  # of a mask next to its image
_MOST_INSTANCES: Final = 32
_LEAST_ROWS: Final = 3  # a smaller piece is a speck


def is_mask(path: Path, _start: bytes = b"") -> bool:
    """Whether the file at `path` is a mask, by its folder and name."""
    in_folder = not _MASK_FOLDERS.isdisjoint(part.lower() for part in path.absolute().parent.parts[-3:])
    return path.suffix.lower() == ".png" and (in_folder or path.stem.lower().endswith(_STEM_END))


def mask_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames that have a mask. A group is the folder of the images."""
    for path in filter(is_mask, folder.files):
        try:
            image = _image_of(path, folder)
            mask = _read(path)
            lanes = dict(_lanes(mask))
        except (LabelError, ImageError) as error:
            yield error_at(str(path), error)
            continue
        height, width = mask.shape
        group, size = drive_of(image.parent), (width, height)
        yield LabelEntry(str(path), folder.name(image), group, ImageLocation(image), lanes, size)


def _image_of(mask: Path, folder: DataFolder) -> Path:
    if mask.stem.lower().endswith(_STEM_END):
        return folder.find_image(mask.with_name(mask.stem[: -len(_STEM_END)]))
    parts = mask.absolute().with_suffix("").parts
    at = max(number for number, part in enumerate(parts[:-1]) if part.lower() in _MASK_FOLDERS)
    for name in (*IMAGE_FOLDERS, *map(str.capitalize, IMAGE_FOLDERS)):
        if Path(*parts[:at], name).is_dir():
            return folder.find_image(Path(*parts[:at], name, *parts[at + 1 :]))
    raise LabelError("there is no folder images next to its own", "the mask of images/NAME.jpg is masks/NAME.png")


def _read(path: Path) -> NDArray[np.int64]:
    """Returns the mask as one number per pixel (H, W). Raises ImageError if it can't be decoded or is not PNG."""
    data = file_bytes(path)
    if checked_header(data).kind != "PNG":
        raise ImageError("a mask must be a PNG file: other formats blur its values")
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


def _lanes(mask: NDArray[np.int64]) -> Iterator[tuple[str, LabeledLane]]:
    values = [value for value in np.unique(mask) if value]
    if len(values) > _MOST_INSTANCES:
        raise LabelError(
            f"it has {len(values)} different values", "a mask has one value, or one value per boundary, with hard edges"
        )
    if len(values) == 1:
        for number, points in enumerate(_pieces(mask != 0), start=1):
            yield f"piece {number}", LabeledLane(points)
        return
    for number, value in enumerate(values, start=1):
        yield f"instance {number}", LabeledLane(_centroids(mask == value), number)


def _centroids(pixels: NDArray[np.bool_]) -> FloatArray:
    """Returns the mean column of the pixels in each row that has some, from the lowest row upwards (N, 2)."""
    counts = pixels.sum(axis=1)
    rows = np.flatnonzero(counts)[::-1]
    means = (pixels @ np.arange(pixels.shape[1]))[rows] / counts[rows]
    return np.stack([means, rows], axis=1).astype(np.float64)


@dataclass(eq=False)
class _Piece:
    """A boundary as far as it has been traced upwards, one run of pixels per row; [start, end) is the top run."""

    start: int = 0
    end: int = 0
    points: list[tuple[float, float]] = field(default_factory=list)
    merged: bool = False  # starts where several pieces met, so it is not a single boundary

    def extend(self, start: int, end: int, row: int) -> None:
        """Adds the run [start, end) of the next row."""
        self.start, self.end = start, end
        self.points.append(((start + end - 1) / 2.0, float(row)))

    def next_run(self, runs: list[tuple[int, int]]) -> int | None:
        """Returns the index of the run in the next row that touches this piece most, at least by a corner."""
        shared = [min(end, self.end) - max(start, self.start) for start, end in runs]
        best = int(np.argmax(shared)) if shared else None
        return best if best is not None and shared[best] >= 0 else None

    @property
    def is_large(self) -> bool:
        """Whether it is more than a speck."""
        return len(self.points) >= _LEAST_ROWS


def _pieces(pixels: NDArray[np.bool_]) -> Iterator[FloatArray]:
    """Yields connected pieces as points upwards. Pieces end where they meet, and what lies above is left out."""
    filled = binary_fill_holes(pixels)
    open_pieces: list[_Piece] = []
    for row in range(len(filled) - 1, -1, -1):
        runs = _runs(filled[row])
        next_runs = [piece.next_run(runs) for piece in open_pieces]
        above = []
        for number, run in enumerate(runs):
            below = [piece for piece, follows in zip(open_pieces, next_runs, strict=True) if follows == number]
            # Specks at a ragged edge are not pieces that meet.
            below = [piece for piece in below if piece.is_large] or below[:1]
            piece = below[0] if len(below) == 1 else _Piece(merged=bool(below))
            piece.extend(*run, row)
            above.append(piece)
        yield from _finished([piece for piece in open_pieces if piece not in above])
        open_pieces = above
    yield from _finished(open_pieces)


def _runs(line: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Returns (start, end) of each run of set pixels in a row, the end exclusive."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [(int(start), int(end)) for start, end in steps.reshape(-1, 2)]


def _finished(pieces: list[_Piece]) -> Iterator[FloatArray]:
    for piece in pieces:
        if piece.is_large and not piece.merged:
            yield np.array(piece.points)
