"""Writes the formats of two benchmarks, TuSimple and CULane. They hold points only: no kinds, types, colors or ids."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from lanestream_exporter.datasets.labels import LabeledLane
from lanestream_exporter.labeling.tasks import IMAGES, LabelImage

_ROW_STEP: Final = 10  # pixels between the rows of TuSimple
_ABSENT: Final = -2


def write_tusimple(images: Sequence[LabelImage], out: Path) -> Path:
    """Writes the pre-labels of `images` to the folder `out` and returns the file with one JSON object per image."""
    path = out / "label_data.json"
    with path.open("w", encoding="utf-8") as file:
        for image in images:
            rows = np.arange(0, image.height, _ROW_STEP)
            columns = [[_column(lane, float(row)) for row in rows] for lane in image.lanes]
            record = {"lanes": columns, "h_samples": rows.tolist(), "raw_file": f"{IMAGES}/{image.name}"}
            file.write(json.dumps(record) + "\n")
    return path


def write_culane(images: Sequence[LabelImage], out: Path) -> Path:
    """Writes the pre-labels of `images` next to them, and returns the list of the images in the folder `out`."""
    for image in images:
        lines = [" ".join(f"{x:g} {y:g}" for x, y in lane.points.round(2).tolist()) for lane in image.lanes]
        path = (out / IMAGES / image.name).with_suffix(".lines.txt")
        path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    listed = out / "list.txt"
    listed.write_text("".join(f"/{IMAGES}/{image.name}\n" for image in images), encoding="utf-8")
    return listed


def _column(lane: LabeledLane, row: float) -> float:
    """Returns the column of a lane at a row, -2 where it is absent."""
    columns, rows = lane.points[::-1].T
    return round(float(np.interp(row, rows, columns)), 2) if rows[0] <= row <= rows[-1] else _ABSENT
