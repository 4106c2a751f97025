"""TuSimple's labels: columns of each lane at fixed rows, -2 where it is absent."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lanestream.errors import LabelError
from lanestream.lanes import Image
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.datasets.records import records, unusable

_WIDTH, _HEIGHT = 1280, 720


def read_tusimple(root: Path, split: str | None = None) -> Iterator[tuple[LabelledFrame, Image]]:
    """Labelled frames below `root` with their BGR images (720, 1280, 3); `split` picks train, val or test.

    Labels are not exhaustive: what lies outside the outermost one is unknown. Raises LabelError that names the file and
    the line.
    """
    for place, record in records(root / "labels.jsonl"):
        try:
            if split is not None and record["split"] != split:
                continue
            frame = _frame(record)
        except (ValueError, KeyError, TypeError) as error:
            raise unusable(place, error, "raw_file, split, h_samples and lanes") from error
        image = cv2.imread(str(root / frame.source))
        if image is None:
            raise LabelError(f"{place}: {frame.source} can't be read as an image")
        yield frame, np.asarray(image, dtype=np.uint8)


def _frame(record: dict[str, Any]) -> LabelledFrame:
    rows = np.asarray(record["h_samples"], dtype=float)
    lanes = []
    for columns in record["lanes"]:
        x = np.asarray(columns, dtype=float)
        present = x >= 0
        if present.sum() >= 2:
            lanes.append(LabelledLane(np.stack([x[present], rows[present]], axis=1)[::-1].copy()))
    return LabelledFrame(_WIDTH, _HEIGHT, tuple(lanes), "tusimple 0313-1", record["raw_file"])
