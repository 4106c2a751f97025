"""Reads labeled frames of every known format together with their images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from lanestream.errors import LabelError, LanestreamError
from lanestream.road.view import Image
from lanestream_exporter.datasets.entries import Box, LabelEntries, LabelEntry
from lanestream_exporter.datasets.files import DataFolder, error_at
from lanestream_exporter.datasets.formats import AUTO, FORMATS, format_of
from lanestream_exporter.datasets.images import ImageReader
from lanestream_exporter.datasets.label_map import BY_WORDS, LabelMap
from lanestream_exporter.datasets.labels import (
    PARTIAL,
    Coverage,
    LabeledFrame,
    LabeledImages,
    LabeledLane,
    checked_points,
    points_inside,
)
from lanestream_exporter.datasets.shapes import no_boundaries, unknown_label

# The fields of a record that figures are given by.
_CONDITIONS: Final = ("scene", "light", "wet", "markings")
_YES_NO: Final[Mapping[bool, str]] = {True: "yes", False: "no"}
_INPAINT_RADIUS: Final = 3.0  # pixels around a masked one whose colors are continued


@dataclass(frozen=True)
class LabeledSample:
    """A usable labeled frame: its record, its labels and its image, BGR (H, W, 3) uint8."""

    entry: LabelEntry
    frame: LabeledFrame
    image: Image


def read_dataset(path: Path, format: str = AUTO, labels: LabelMap = BY_WORDS) -> LabeledImages:  # noqa: A002
    """Yields the labeled frames of the data set at `path`, a folder or a label file, with their images.

    Images are BGR (H, W, 3) uint8 and decoded one at a time. `frame.group` names the drive or clip. `format` is one of
    `formats.FORMATS`, or "auto"; `labels` says what labels mean. Raises LabelError at the first unusable record, with
    its file and line.
    """
    for sample in scan_dataset(path, format, labels):
        if isinstance(sample, LabelError):
            raise sample
        yield sample.frame, sample.image


def scan_dataset(
    path: Path,
    format: str = AUTO,  # noqa: A002
    labels: LabelMap = BY_WORDS,
) -> Iterator[LabeledSample | LabelError]:
    """Yields the samples of the data set at `path`, and every fault of an unusable record instead of raising it.

    Raises LabelError if there is no data set at `path`, or if its format can't be recognized.
    """
    with ImageReader() as images:
        for entry in read_entries(path, format, labels):
            yield from [entry] if isinstance(entry, LabelError) else open_entry(entry, images)


def read_entries(path: Path, format: str = AUTO, labels: LabelMap = BY_WORDS) -> LabelEntries:  # noqa: A002
    """Yields the records of the data set at `path` without opening its images, and unusable ones as their errors.

    A label of a line that means nothing is an error where it is used first. A data set with shapes but without a single
    boundary is an error, which comes last. Raises LabelError if there is no data set at `path`, if its format can't be
    recognized, or if `labels` are given for a format without any.
    """
    folder = DataFolder.at(path)
    name = format_of(folder, format)
    empty, without_lanes = True, True
    others: Counter[str] = Counter()
    unknown: set[str] = set()
    for entry in FORMATS[name].entries(folder, labels):
        empty = False
        if isinstance(entry, LabelError):
            without_lanes = False  # such a record may have some
        else:
            without_lanes = without_lanes and not entry.lanes and not entry.unknown
            others.update(entry.others)
            for label in entry.unknown:
                if label not in unknown:
                    unknown.add(label)
                    yield unknown_label(entry.location, label)
        yield entry
    if empty:
        raise LabelError(f"no labeled frames of format {name} in {path}")
    if without_lanes and others:
        yield no_boundaries(path, others)


def open_entry(entry: LabelEntry, images: ImageReader) -> Iterator[LabeledSample | LabelError]:
    """Yields the sample of an entry, its masked boxes painted over, or everything that is wrong with it."""
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
    frame, lane_faults = labeled_frame(entry, size) if size is not None else (None, [])
    faults += lane_faults
    yield from faults
    if image is not None and frame is not None and not faults:
        yield LabeledSample(entry, frame, without_boxes(image, entry.masks))


def labeled_frame(entry: LabelEntry, size: tuple[int, int]) -> tuple[LabeledFrame, list[LabelError]]:
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
    horizon = None if entry.horizon is None else entry.horizon * size[1]
    frame = LabeledFrame(
        *size, tuple(lanes), entry.group, entry.source, _coverage(entry), entry.dataset, horizon, _conditions(entry)
    )
    return frame, faults


def without_boxes(image: Image, boxes: Sequence[Box]) -> Image:
    """Returns an image (H, W, 3) uint8 whose `boxes`, in shares of its size, continue what surrounds them.

    For stamps and logos, which a network could learn. Method: A. Telea, An image inpainting technique based on the fast
    marching method, 2004.
    """
    if not boxes:
        return image
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    for left, top, right, bottom in boxes:
        mask[round(top * height) : round(bottom * height), round(left * width) : round(right * width)] = 255
    return np.asarray(cv2.inpaint(image, mask, _INPAINT_RADIUS, cv2.INPAINT_TELEA), dtype=np.uint8)


def _coverage(entry: LabelEntry) -> Coverage:
    """Returns what the labels of a record cover, which may be less than its data set's labels do."""
    coverage = entry.coverage
    if entry.fields.get("complete") is False:
        coverage = replace(PARTIAL, markings=coverage.markings)
    return replace(coverage, markings=False) if entry.fields.get("markings") is False else coverage


def _conditions(entry: LabelEntry) -> dict[str, str]:
    found = {name: entry.fields[name] for name in _CONDITIONS if name in entry.fields}
    words = {name: _YES_NO[value] if isinstance(value, bool) else value for name, value in found.items()}
    return {name: word for name, word in words.items() if isinstance(word, str)}
