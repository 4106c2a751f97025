"""Reads LabelMe's labels: one JSON file per image. Line strips and lines among its `shapes` are lane boundaries.

Their labels mean what `label_map` says. Polygons and points are converted as `shapes` explains. A shape's `group_id` is
the boundary's id; words of its `flags` and its `label` may name type and color ("dashed", "white"). The image is at
`imagePath`, next to the JSON file under that name, or inside it as `imageData`. Coordinates are taken as written.
"""

from __future__ import annotations

import base64
import binascii
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry, size_of
from lanestream_exporter.datasets.files import (
    DataFolder,
    drive_of,
    error_at,
    field_error,
    json_object,
    path_in_labels,
    read_text,
)
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.label_map import LabelMap, words_of
from lanestream_exporter.datasets.labels import LabeledLane, points_of
from lanestream_exporter.datasets.shapes import DrawnBoundaries, DrawnShape, meaning_of

_ACCEPTED: Final = "a JSON file of LabelMe is accepted"


def is_labelme(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds LabelMe labels, by its first bytes."""
    keys = (b'"shapes"', b'"imagePath"', b'"imageData"')
    return path.suffix.lower() in (".json", ".jsonl") and any(key in start for key in keys)


def labelme_entries(folder: DataFolder, labels: LabelMap) -> LabelEntries:
    """Yields the frames of all JSON files. A group is the folder of the images."""
    for path in folder.with_suffix(".json"):
        try:
            record = json_object(read_text(path, _ACCEPTED), str(path), _ACCEPTED)
        except LabelError as error:
            yield error
            continue
        try:
            yield _entry(record, path, folder, labels)
        except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
            yield field_error(str(path), error, "imagePath and shapes, each with label, shape_type and points")
        except LabelError as error:
            yield error_at(str(path), error)


def _entry(record: dict[str, Any], path: Path, folder: DataFolder, labels: LabelMap) -> LabelEntry:
    image = _image(record, path, folder)
    width, height = record.get("imageWidth"), record.get("imageHeight")
    size = size_of(width, height) if width and height else None
    shapes = [_shape(shape, f"shape {number}", labels) for number, shape in enumerate(record["shapes"], start=1)]
    drawn = DrawnBoundaries.of(shapes, "LabelMe", size[0] if size else None)
    source, group = folder.name(image.path), drive_of(image.path.parent)
    return LabelEntry(
        str(path), source, group, image, drawn.lanes, size,
        converted=drawn.converted, others=drawn.others, unknown=drawn.unknown,
    )  # fmt: skip


def _shape(shape: dict[str, Any], where: str, labels: LabelMap) -> DrawnShape:
    tool, label = str(shape.get("shape_type") or "polygon"), str(shape.get("label") or "")
    meaning = meaning_of(tool, label, labels)
    try:
        points = points_of([] if meaning == "ignore" else shape["points"])
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    flags = words_of(" ".join(name for name, is_set in (shape.get("flags") or {}).items() if is_set))
    look = labels.look(label, flags, flags)
    group = shape.get("group_id")
    lane_id = None if group is None else int(group)
    lane = LabeledLane(points, lane_id, None, look.type, look.color, look.default_kind)
    return DrawnShape(where, tool, label, meaning, lane, lane_id)


def _image(record: dict[str, Any], path: Path, folder: DataFolder) -> ImageLocation:
    """Returns the image file, or else the copy of it inside the JSON file."""
    name = path_in_labels(record["imagePath"])
    try:
        return ImageLocation(folder.find(path.parent / name, path.with_name(name.name)))
    except LabelError:
        if not record.get("imageData"):
            raise
    try:
        return ImageLocation(path, data=base64.b64decode(record["imageData"], validate=True))
    except binascii.Error:
        raise ValueError("its imageData is not base64") from None
