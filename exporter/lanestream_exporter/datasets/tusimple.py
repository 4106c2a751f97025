"""TuSimple's labels: columns of each lane at fixed rows, -2 where it is absent.

Format: github.com/TuSimple/tusimple-benchmark, lane detection challenge.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np

from lanestream.errors import LabelError
from lanestream.road.view import Image
from lanestream_exporter.datasets.entries import Entries, Entry, numbered
from lanestream_exporter.datasets.folder import DataFolder, drive_of, relative
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.datasets.pictures import Picture
from lanestream_exporter.datasets.records import all_records, placed, records, unusable

_WIDTH, _HEIGHT = 1280, 720
_NEEDED = "raw_file, h_samples and lanes"


def read_tusimple(root: Path, split: str | None = None) -> Iterator[tuple[LabelledFrame, Image]]:
    """Labelled frames below `root` with their BGR images (720, 1280, 3); `split` picks train, val or test.

    Labels are not exhaustive: what lies outside the outermost one is unknown. Raises LabelError that names the file and
    the line.
    """
    for place, record in records(root / "labels.jsonl"):
        try:
            if split is not None and record["split"] != split:
                continue
            lanes, source = tuple(_lanes(record)), str(record["raw_file"])
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise unusable(place, error, f"split, {_NEEDED}") from error
        image = cv2.imread(str(root / source))
        if image is None:
            raise LabelError(f"{place}: {source} can't be read as an image")
        yield LabelledFrame(_WIDTH, _HEIGHT, lanes, "tusimple 0313-1", source), np.asarray(image, dtype=np.uint8)


def tusimple_entries(folder: DataFolder) -> Entries:
    """The frames of TuSimple's files of JSON lines; a group is a drive, as in clips/0313-1/6040/20.jpg."""
    for path in folder.with_suffix(".json", ".jsonl"):
        for place, record in all_records(path):
            if isinstance(record, LabelError):
                yield record
                continue
            try:
                yield _entry(record, place, path, folder)
            except (ValueError, KeyError, TypeError, OverflowError) as error:
                yield unusable(place, error, _NEEDED)
            except LabelError as error:
                yield placed(place, error)


def _entry(record: dict[str, Any], place: str, path: Path, folder: DataFolder) -> Entry:
    name = relative(record["raw_file"])
    lanes = numbered(_lanes(record))
    image = folder.find(path.parent / name, folder.root / name)
    official = PurePosixPath(str(record.get("source", name.as_posix()))).parts
    group = f"tusimple {official[1]}" if official[:1] == ("clips",) and len(official) > 3 else drive_of(image.parent)
    return Entry(place, folder.name(image), group, Picture(image), lanes)


def _lanes(record: dict[str, Any]) -> Iterator[LabelledLane]:
    """The lanes that are there: a column below zero is absent, and what is left at one row alone is no boundary."""
    rows = np.asarray(record["h_samples"], dtype=float)
    for number, columns in enumerate(record["lanes"], start=1):
        x = np.asarray(columns, dtype=float)
        if rows.ndim != 1 or x.shape != rows.shape:
            raise ValueError(f"lane {number} has {x.size} columns, but there are {rows.size} h_samples")
        present = ~(x < 0)
        if present.sum() >= 2:
            yield LabelledLane(np.stack([x[present], rows[present]], axis=1)[::-1].copy())
