"""Reads TuSimple's labels: the columns of each lane at fixed rows, -2 where a lane is absent.

Format: github.com/TuSimple/tusimple-benchmark, lane detection challenge. A record may have a `split`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry, numbered
from lanestream_exporter.datasets.files import (
    DataFolder,
    drive_of,
    error_at,
    field_error,
    path_in_labels,
    scan_json_lines,
)
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LabeledLane

_NEEDED: Final = "raw_file, h_samples and lanes"


def is_tusimple(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds TuSimple labels, by its first bytes."""
    return path.suffix.lower() in (".json", ".jsonl") and b'"h_samples"' in start


def tusimple_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames of TuSimple's JSON lines files. A group is a drive: 0313-1 of clips/0313-1/6040/20.jpg."""
    for path in folder.with_suffix(".json", ".jsonl"):
        for location, record in scan_json_lines(path):
            if isinstance(record, LabelError):
                yield record
                continue
            try:
                yield _entry(record, location, path, folder)
            except (ValueError, KeyError, TypeError, OverflowError) as error:
                yield field_error(location, error, _NEEDED)
            except LabelError as error:
                yield error_at(location, error)


def _entry(record: dict[str, Any], location: str, path: Path, folder: DataFolder) -> LabelEntry:
    name = path_in_labels(record["raw_file"])
    lanes = numbered(_lanes(record))
    image = folder.find(path.parent / name, folder.root / name)
    official = PurePosixPath(str(record.get("source", name.as_posix()))).parts
    group = f"tusimple {official[1]}" if official[:1] == ("clips",) and len(official) > 3 else drive_of(image.parent)
    return LabelEntry(location, folder.name(image), group, ImageLocation(image), lanes, split=record.get("split"))


def _lanes(record: dict[str, Any]) -> Iterator[LabeledLane]:
    """Yields the lanes that are present. A column below zero is absent; a lane with one row left is dropped."""
    rows = np.asarray(record["h_samples"], dtype=float)
    for number, columns in enumerate(record["lanes"], start=1):
        x = np.asarray(columns, dtype=float)
        if rows.ndim != 1 or x.shape != rows.shape:
            raise ValueError(f"lane {number} has {x.size} columns, but there are {rows.size} h_samples")
        present = ~(x < 0)
        if present.sum() >= 2:
            yield LabeledLane(np.stack([x[present], rows[present]], axis=1)[::-1].copy())
