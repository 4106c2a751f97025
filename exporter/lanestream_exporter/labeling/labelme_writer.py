"""Writes LabelMe's files: a JSON file next to each image, and labels.txt and flags.yaml for its command line.

Types and colors are flags of a shape, and the id of a boundary is its group_id.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from lanestream.road.appearance import BoundaryKind
from lanestream_exporter.datasets.labels import LabeledLane
from lanestream_exporter.labeling.tasks import COLORS, IMAGES, LABELS, TYPES, LabelImage, kind_of, type_of

_VERSION: Final = "5.5.0"  # of the format: the oldest LabelMe that these files were read with


def write_labelme(images: Sequence[LabelImage], out: Path) -> Path:
    """Writes the pre-labels of `images` to the folder `out` and returns the folder to open."""
    folder = out / IMAGES
    for image in images:
        record: dict[str, Any] = {
            "version": _VERSION, "flags": {}, "shapes": [_shape(lane) for lane in image.lanes],
            "imagePath": image.name, "imageData": None, "imageHeight": image.height, "imageWidth": image.width,
        }  # fmt: skip
        text = json.dumps(record, indent=2, ensure_ascii=False) + "\n"
        (folder / image.name).with_suffix(".json").write_text(text, encoding="utf-8")
    (out / "labels.txt").write_text("".join(f"{label}\n" for label in LABELS.values()), encoding="utf-8")
    flags = "".join(f"^{LABELS[kind]}$: [{', '.join(_flags(kind))}]\n" for kind in LABELS)
    (out / "flags.yaml").write_text(flags, encoding="utf-8")
    return folder


def _flags(kind: BoundaryKind) -> tuple[str, ...]:
    return TYPES[kind] + (COLORS if kind == "marking" else ())


def _shape(lane: LabeledLane) -> dict[str, Any]:
    kind = kind_of(lane)
    names = {type_of(lane), lane.color}
    return {
        "label": LABELS[kind], "points": lane.points.tolist(), "group_id": lane.lane_id, "description": "",
        "shape_type": "linestrip", "flags": {name: name in names for name in _flags(kind)},
    }  # fmt: skip
