"""Labelled frames of any form that is known, with their pictures: the way in for everything that learns or measures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from lanestream.errors import LabelError, LanestreamError
from lanestream.road.view import Image
from lanestream_exporter.datasets.entries import Entry
from lanestream_exporter.datasets.folder import DataFolder
from lanestream_exporter.datasets.formats import FORMATS, detect
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.datasets.pictures import Opener
from lanestream_exporter.datasets.polylines import sound, within
from lanestream_exporter.datasets.records import placed


@dataclass(frozen=True)
class Sample:
    """A labelled frame that can be used: its record, its labels and its picture, BGR (H, W, 3) uint8."""

    entry: Entry
    frame: LabelledFrame
    image: Image


def read_dataset(path: Path, format: str = "auto") -> Iterator[tuple[LabelledFrame, Image]]:  # noqa: A002
    """The labelled frames of the data set at `path`, a folder or a label file, each with its picture.

    Pictures are BGR (H, W, 3) uint8, decoded as they are asked for. Points of a lane go from the lowest row upwards, in
    pixels of the picture. `frame.group` names the drive or clip, which a split may not divide. `format` is one of
    `formats.FORMATS`, or "auto". Raises LabelError at the first record that can't be used, naming its file and line.
    """
    for sample in survey(path, format):
        if isinstance(sample, LabelError):
            raise sample
        yield sample.frame, sample.image


def survey(path: Path, format: str = "auto") -> Iterator[Sample | LabelError]:  # noqa: A002
    """As `read_dataset`, but what is wrong with a record is yielded, every fault of it, and the next one follows.

    Raises LabelError where there is no data set at `path`, or its form can't be told.
    """
    folder = DataFolder.at(path)
    name = form_of(folder, format)
    empty = True
    with Opener() as opener:
        for entry in FORMATS[name](folder):
            empty = False
            if isinstance(entry, LabelError):
                yield entry
            else:
                yield from _opened(entry, opener)
    if empty:
        raise LabelError(f"no labelled frames in {path} as {name}")


def form_of(folder: DataFolder, format: str) -> str:  # noqa: A002
    """The name of the form to read `folder` in. Raises LabelError where `format` is unknown or can't be told."""
    if format == "auto":
        return detect(folder)
    if format not in FORMATS:
        raise LabelError(f"the form of labels {format!r} is unknown", f"{', '.join(FORMATS)} or auto are accepted")
    return format


def _opened(entry: Entry, opener: Opener) -> Iterator[Sample | LabelError]:
    """The sample of an entry, or all that is wrong with it."""
    faults, lanes = [], []
    image, size = None, entry.size
    try:
        image = opener.open(entry.picture)
    except LanestreamError as error:
        faults.append(placed(f"{entry.place}: {entry.source}", error))
    else:
        real = image.shape[1], image.shape[0]
        size = size or real
        if size != real:
            are, told = (" x ".join(map(str, pair)) for pair in (real, size))
            faults.append(LabelError(f"{entry.place}: {entry.source} is {are}, but its labels are for {told}"))
    if size is not None:
        for where, lane in entry.lanes.items():
            try:
                lanes.append(_sound_lane(lane, size, entry.overdrawn))
            except ValueError as error:
                faults.append(LabelError(f"{entry.place}: {where}: {error}"))
    yield from faults
    if image is not None and size is not None and not faults:
        kept = tuple(lane for lane in lanes if lane is not None)
        yield Sample(entry, LabelledFrame(*size, kept, entry.group, entry.source), image)


def _sound_lane(lane: LabelledLane, size: tuple[int, int], overdrawn: bool) -> LabelledLane | None:
    """The lane with sound points; None where a form that draws on beyond the picture leaves nothing inside it."""
    points = lane.points
    if overdrawn and len(points) >= 2:
        points = within(points, *size)
        if len(points) < 2:
            return None
    return replace(lane, points=sound(points, *size))
