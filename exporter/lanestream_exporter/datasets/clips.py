"""Reads this project's own labels of video clips: one JSON object per key frame, as `lanestream scene` writes them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import (
    UNKNOWN,
    FieldValue,
    LabeledLook,
    LabelEntries,
    LabelEntry,
    is_type,
    numbered,
    size_of,
)
from lanestream_exporter.datasets.files import (
    DataFolder,
    drive_of,
    error_at,
    field_error,
    path_in_labels,
    read_json_lines,
    scan_json_lines,
    start_of,
)
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LANE_TYPES, PARTIAL, Coverage, LabeledFrame, LabeledLane, points_of

_NEEDED: Final = "frame, width, height and lanes"


def is_clip_labels(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds clip labels, by its first bytes."""
    # As keys: other programs may have labels of these names.
    has_lanes, has_image = (re.search(rb'"(%s)"\s*:' % keys, start) is not None for keys in (b"lanes", b"frame|image"))
    return path.suffix.lower() in (".json", ".jsonl") and has_lanes and has_image


def clip_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames of all files of clip labels. An image comes from a record's `image`, else from the video.

    A group is a clip. Its video is looked for next to the labels and in the folders `clips` and `videos`.
    """
    for path in folder.with_suffix(".jsonl", ".json"):
        # A folder may hold JSON files of another kind, such as a camera's calibration.
        if path.suffix.lower() == ".json" and not is_clip_labels(path, start_of(path)):
            continue
        # In order, because a video is decoded from its start.
        yield from sorted(_file_entries(path, folder), key=_video_index)


def read_clip_labels(path: Path, coverage: Coverage = PARTIAL) -> dict[int, LabeledFrame]:
    """Returns the labeled frames of a clip by their index in the video, without looking for the video.

    `coverage` says what the labels cover. Raises LabelError that names the file and the line.
    """
    frames: dict[int, LabeledFrame] = {}
    for location, record in read_json_lines(path):
        try:
            frames[int(record["frame"])] = _frame(record, path, coverage)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise field_error(location, error, _NEEDED) from error
    return frames


def _frame(record: dict[str, Any], path: Path, coverage: Coverage) -> LabeledFrame:
    lanes = tuple(_lanes(record))
    clip = str(record.get("clip", path.stem))
    source = f"{clip}#{record['frame']}"
    return LabeledFrame(int(record["width"]), int(record["height"]), lanes, Path(clip).stem, source, coverage)


def _file_entries(path: Path, folder: DataFolder) -> LabelEntries:
    for location, record in scan_json_lines(path):
        if isinstance(record, LabelError):
            yield record
            continue
        try:
            yield replace(_entry(record, location, path, folder), fields=_fields(record))
        except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
            yield field_error(location, error, _NEEDED)
        except LabelError as error:
            yield error_at(location, error)


def _video_index(found: LabelEntry | LabelError) -> int:
    return 0 if isinstance(found, LabelError) else found.image.index or 0


def _entry(record: dict[str, Any], location: str, path: Path, folder: DataFolder) -> LabelEntry:
    size = size_of(record["width"], record["height"])
    lanes = numbered(_lanes(record))
    clip = path_in_labels(record.get("clip") or path.with_suffix("").name)
    split = record.get("split")
    if "image" not in record:
        index = int(record["frame"])
        video = folder.find_video(clip, path)
        source = f"{video.name}#{index}"
        return LabelEntry(location, source, video.stem, ImageLocation(video, index), lanes, size, video, index, split)
    image = folder.find(path.parent / path_in_labels(record["image"]))
    if "clip" not in record or "frame" not in record:
        group = clip.stem if "clip" in record else drive_of(image.parent)
        return LabelEntry(location, folder.name(image), group, ImageLocation(image), lanes, size, split=split)
    index = int(record["frame"])
    video_or_none = _video_if_there(clip, path, folder)
    source = f"{clip.name}#{index}"
    return LabelEntry(location, source, clip.stem, ImageLocation(image), lanes, size, video_or_none, index, split)


def _video_if_there(clip: Path, path: Path, folder: DataFolder) -> Path | None:
    """Returns the video that an image was taken from; the labels can be used without it."""
    try:
        return folder.find_video(clip, path)
    except LabelError:
        return None


def _lanes(record: dict[str, Any]) -> Iterator[LabeledLane]:
    for number, lane in enumerate(record["lanes"], start=1):
        try:
            points = points_of(lane["points"])
        except ValueError as error:
            raise ValueError(f"lane {number}: {error}") from None
        look = _look(_field(lane, "type", str), _field(lane, "color", str))
        where = _field(lane, "id", int), _field(lane, "position", int)
        yield LabeledLane(points, *where, look.type, look.color, look.default_kind)


def _look(type_name: str | None, color: str | None) -> LabeledLook:
    if type_name is not None and not is_type(type_name):
        accepted = f"accepted are {', '.join(LANE_TYPES)} and {UNKNOWN}"
        raise ValueError(f"its type {type_name!r} is not known; {accepted}")
    return LabeledLook.of([type_name] if type_name else [], [color] if color else [])


def _fields(record: dict[str, Any]) -> dict[str, FieldValue]:
    return {name: value for name, value in record.items() if isinstance(value, FieldValue)}


def _field(lane: dict[str, Any], name: str, kind: type) -> Any:
    """Returns the optional field `name` of a lane, or None. Raises ValueError if it has another type than `kind`."""
    value = lane.get(name)
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"its {name} {value!r} is not of type {kind.__name__}")
    return value
