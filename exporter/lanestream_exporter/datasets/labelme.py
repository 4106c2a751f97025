"""LabelMe's labels: a JSON file an image, with `shapes`, of which line strips and lines are lane boundaries.

A shape's `group_id` is the boundary's id; words of its `label` and its set `flags` may tell kind and colour ("dashed",
"white"). The image is at `imagePath`, beside the JSON file under that name, or inside it as `imageData`. Coordinates
are taken as written.
"""

from __future__ import annotations

import base64
import binascii
import re
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import Entries, Entry, colour_in, kind_in, size_of
from lanestream_exporter.datasets.folder import DataFolder, drive_of, relative
from lanestream_exporter.datasets.labels import LabelledLane
from lanestream_exporter.datasets.pictures import Picture
from lanestream_exporter.datasets.polylines import points_of
from lanestream_exporter.datasets.records import json_object, placed, text_of, unusable

_ACCEPTED: Final = "a JSON file of LabelMe is accepted"
_LINES: Final = ("linestrip", "line")


def labelme_entries(folder: DataFolder) -> Entries:
    """The frames of all JSON files; a group is the folder of the images."""
    for path in folder.with_suffix(".json"):
        try:
            record = json_object(text_of(path, _ACCEPTED), str(path), _ACCEPTED)
        except LabelError as error:
            yield error
            continue
        try:
            yield _entry(record, path, folder)
        except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
            yield unusable(str(path), error, "imagePath and shapes, each with label, shape_type and points")
        except LabelError as error:
            yield placed(str(path), error)


def _entry(record: dict[str, Any], path: Path, folder: DataFolder) -> Entry:
    lanes, others = {}, []
    for number, shape in enumerate(record["shapes"], start=1):
        form = shape.get("shape_type") or "polygon"
        if form in _LINES:
            lanes[f"shape {number}"] = _lane(shape, number)
        else:
            others.append(str(form))
    picture = _picture(record, path, folder)
    width, height = record.get("imageWidth"), record.get("imageHeight")
    size = size_of(width, height) if width and height else None
    source = folder.name(picture.path)
    return Entry(str(path), source, drive_of(picture.path.parent), picture, lanes, size, others=tuple(others))


def _lane(shape: dict[str, Any], number: int) -> LabelledLane:
    try:
        points = points_of(shape["points"])
    except ValueError as error:
        raise ValueError(f"shape {number}: {error}") from None
    flags = " ".join(name for name, is_set in (shape.get("flags") or {}).items() if is_set)
    words = re.findall(r"[a-z]+", f"{shape.get('label', '')} {flags}".lower())
    group = shape.get("group_id")
    return LabelledLane(points, None if group is None else int(group), None, kind_in(words), colour_in(words))


def _picture(record: dict[str, Any], path: Path, folder: DataFolder) -> Picture:
    """The image file, or else the copy of it in the JSON file."""
    name = relative(record["imagePath"])
    try:
        return Picture(folder.find(path.parent / name, path.with_name(name.name)))
    except LabelError:
        if not record.get("imageData"):
            raise
    try:
        return Picture(path, data=base64.b64decode(record["imageData"], validate=True))
    except binascii.Error:
        raise ValueError("its imageData is not base64") from None
