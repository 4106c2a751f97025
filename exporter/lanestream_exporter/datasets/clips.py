"""Reads this project's own labels of video clips: one JSON object per key frame, as `lanestream scene` writes them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry, numbered, size_of
from lanestream_exporter.datasets.files import (
    DataFolder,
    drive_of,
    error_at,
    field_error,
    path_in_labels,
    read_json_lines,
    scan_json_lines,
)
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import PARTIAL, Coverage, LabeledFrame, LabeledLane, points_of

_NEEDED: Final = "frame, width, height and lanes"
# The optional fields of a lane, in the order of LabeledLane's fields.
_LANE_FIELDS: Final[Mapping[str, type]] = {"id": int, "position": int, "type": str, "color": str}


def is_clip_labels(path: Path, start: bytes) -> bool:
    """Whether the file at `path` holds clip labels, by its first bytes."""
    has_lanes = b'"lanes"' in start and (b'"frame"' in start or b'"image"' in start)
    return path.suffix.lower() in (".json", ".jsonl") and has_lanes


def clip_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames of all files of clip labels. An image comes from a record's `image`, else from the video.

    A group is a clip. Its video is looked for next to the labels and in the folders `clips` and `videos`.
    """
    for path in folder.with_suffix(".jsonl"):
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
            yield _entry(record, location, path, folder)
        except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
            yield field_error(location, error, _NEEDED)
        except LabelError as error:
            yield error_at(location, error)


def _video_index(found: LabelEntry | LabelError) -> int:
    return 0 if isinstance(found, LabelError) else found.image.index or 0


def _entry(record: dict[str, Any], location: str, path: Path, folder: DataFolder) -> LabelEntry:
    size = size_of(record["width"], record["height"])
    lanes = numbered(_lanes(record))
    clip = path_in_labels(record.get("clip") or f"{path.stem}.mp4")
    split = record.get("split")
    if "image" not in record:
        index = int(record["frame"])
        video = folder.find_video(clip, path)
        source = f"{video.name}#{index}"
        return LabelEntry(location, source, clip.stem, ImageLocation(video, index), lanes, size, video, index, split)
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
        yield LabeledLane(points, *(_field(lane, name, kind) for name, kind in _LANE_FIELDS.items()))


def _field(lane: dict[str, Any], name: str, kind: type) -> Any:
    """Returns the optional field `name` of a lane, or None. Raises ValueError if it has another type than `kind`."""
    value = lane.get(name)
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"its {name} {value!r} is not of type {kind.__name__}")
    return value
