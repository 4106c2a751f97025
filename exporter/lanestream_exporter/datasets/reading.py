"""Reads labeled frames of every known format together with their images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from lanestream.errors import LabelError, LanestreamError
from lanestream.road.view import Image
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry
from lanestream_exporter.datasets.files import DataFolder, error_at
from lanestream_exporter.datasets.formats import AUTO, FORMATS, format_of
from lanestream_exporter.datasets.images import ImageReader
from lanestream_exporter.datasets.labels import (
    PARTIAL,
    Coverage,
    LabeledFrame,
    LabeledImages,
    LabeledLane,
    checked_points,
    points_inside,
)


@dataclass(frozen=True)
class LabeledSample:
    """A usable labeled frame: its record, its labels and its image, BGR (H, W, 3) uint8."""

    entry: LabelEntry
    frame: LabeledFrame
    image: Image


def read_dataset(path: Path, format: str = AUTO) -> LabeledImages:  # noqa: A002
    """Yields the labeled frames of the data set at `path`, a folder or a label file, with their images.

    Images are BGR (H, W, 3) uint8 and decoded one at a time. `frame.group` names the drive or clip. `format` is one of
    `formats.FORMATS`, or "auto". Raises LabelError at the first unusable record, with its file and line.
    """
    for sample in scan_dataset(path, format):
        if isinstance(sample, LabelError):
            raise sample
        yield sample.frame, sample.image


def scan_dataset(path: Path, format: str = AUTO) -> Iterator[LabeledSample | LabelError]:  # noqa: A002
    """Yields the samples of the data set at `path`, and every fault of an unusable record instead of raising it.

    Raises LabelError if there is no data set at `path`, or if its format can't be recognized.
    """
    with ImageReader() as images:
        for entry in read_entries(path, format):
            yield from [entry] if isinstance(entry, LabelError) else open_entry(entry, images)


def read_entries(path: Path, format: str = AUTO) -> LabelEntries:  # noqa: A002
    """Yields the records of the data set at `path` without opening its images, and unusable ones as their errors.

    Raises LabelError if there is no data set at `path`, or if its format can't be recognized.
    """
    folder = DataFolder.at(path)
    name = format_of(folder, format)
    empty = True
    for entry in FORMATS[name].read(folder):
        empty = False
        yield entry
    if empty:
        raise LabelError(f"no labeled frames of format {name} in {path}")


def open_entry(
    entry: LabelEntry, images: ImageReader, coverage: Coverage = PARTIAL
) -> Iterator[LabeledSample | LabelError]:
    """Yields the sample of an entry, or everything that is wrong with it."""
    faults: list[LabelError] = []
    image, size = None, entry.size
    try:
        image = images.open(entry.image)
    except LanestreamError as error:
        faults.append(error_at(f"{entry.location}: {entry.source}", error))
    else:
        actual = image.shape[1], image.shape[0]
        size = size or actual
        if size != actual:
            one, other = (" x ".join(map(str, pair)) for pair in (actual, size))
            faults.append(LabelError(f"{entry.location}: {entry.source} is {one}, but its labels are for {other}"))
    frame, lane_faults = labeled_frame(entry, size, coverage) if size is not None else (None, [])
    faults += lane_faults
    yield from faults
    if image is not None and frame is not None and not faults:
        yield LabeledSample(entry, frame, image)


def labeled_frame(
    entry: LabelEntry, size: tuple[int, int], coverage: Coverage
) -> tuple[LabeledFrame, list[LabelError]]:
    """Returns the labels of an entry for an image of `size` (width, height), and what is wrong with its lanes."""
    lanes: list[LabeledLane] = []
    faults = []
    for name, lane in entry.lanes.items():
        points = lane.points
        if entry.extends_beyond_image and len(points) >= 2:
            points = points_inside(points, *size)
            if len(points) < 2:
                continue
        try:
            lanes.append(replace(lane, points=checked_points(points, *size)))
        except ValueError as error:
            faults.append(LabelError(f"{entry.location}: {name}: {error}"))
    return LabeledFrame(*size, tuple(lanes), entry.group, entry.source, coverage), faults
