"""Labels of video clips: one JSON object a key frame, the form that `lanestream scene` writes too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from lanestream.errors import LabelError, SourceError
from lanestream.road.view import Image
from lanestream_exporter.datasets.entries import Entries, Entry, numbered, size_of
from lanestream_exporter.datasets.folder import DataFolder, drive_of, relative
from lanestream_exporter.datasets.labels import PARTIAL, Coverage, LabelledFrame, LabelledLane
from lanestream_exporter.datasets.pictures import Picture
from lanestream_exporter.datasets.polylines import points_of
from lanestream_exporter.datasets.records import all_records, placed, records, unusable

_NEEDED = "frame, width, height and lanes"
# What a lane may say of itself, in the order of LabelledLane's fields.
_TOLD: Final[Mapping[str, type]] = {"id": int, "position": int, "type": str, "color": str}


def read_clip_labels(path: Path, coverage: Coverage = PARTIAL) -> dict[int, LabelledFrame]:
    """Labelled frames by their index in the clip; `coverage` says what the labels may have left out.

    Raises LabelError that names the file and the line.
    """
    frames: dict[int, LabelledFrame] = {}
    for place, record in records(path):
        try:
            frames[int(record["frame"])] = _frame(record, path, coverage)
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise unusable(place, error, _NEEDED) from error
    return frames


def _frame(record: dict[str, Any], path: Path, coverage: Coverage) -> LabelledFrame:
    lanes = tuple(_lanes(record))
    clip = str(record.get("clip", path.stem))
    source = f"{clip}#{record['frame']}"
    return LabelledFrame(int(record["width"]), int(record["height"]), lanes, Path(clip).stem, source, coverage)


def _lanes(record: dict[str, Any]) -> Iterator[LabelledLane]:
    for number, lane in enumerate(record["lanes"], start=1):
        try:
            points = points_of(lane["points"])
        except ValueError as error:
            raise ValueError(f"lane {number}: {error}") from None
        told = (_told(lane, name, kind) for name, kind in _TOLD.items())
        yield LabelledLane(points, *told)


def _told(lane: dict[str, Any], name: str, kind: type) -> Any:
    """What a lane says of itself under `name`, or None. Raises ValueError where it is of another kind."""
    value = lane.get(name)
    if value is not None and not isinstance(value, kind):
        raise ValueError(f"its {name} {value!r} is of the wrong kind")
    return value


def read_clip(video: Path, labels: Path, coverage: Coverage = PARTIAL) -> Iterator[tuple[LabelledFrame, Image]]:
    """The labelled frames of a clip with their BGR images (H, W, 3), in order. Raises SourceError, LabelError."""
    wanted = read_clip_labels(labels, coverage)
    capture = cv2.VideoCapture(str(video))
    if not capture.isOpened():
        raise SourceError(f"{video} can't be read as a video", "give the path of a video file")
    try:
        for index in range(max(wanted, default=-1) + 1):
            if not capture.grab():
                raise LabelError(f"{labels}: frame {max(wanted)} is labelled, but {video} has {index} frames")
            if index in wanted:
                yield wanted[index], np.asarray(capture.retrieve()[1], dtype=np.uint8)
    finally:
        capture.release()


def clip_entries(folder: DataFolder) -> Entries:
    """The frames of all files of clip labels, from their `image` where one is named, else from the clip.

    A clip is looked for beside its labels and in the folders `clips` and `videos`; each is a group.
    """
    for path in folder.with_suffix(".jsonl"):
        # In order, because a video is decoded from its start.
        yield from sorted(_file_entries(path, folder), key=_frame_index)


def _file_entries(path: Path, folder: DataFolder) -> Entries:
    for place, record in all_records(path):
        if isinstance(record, LabelError):
            yield record
            continue
        try:
            yield _entry(record, place, path, folder)
        except (ValueError, KeyError, TypeError, OverflowError, AttributeError) as error:
            yield unusable(place, error, _NEEDED)
        except LabelError as error:
            yield placed(place, error)


def _frame_index(found: Entry | LabelError) -> int:
    return 0 if isinstance(found, LabelError) else found.picture.index or 0


def _entry(record: dict[str, Any], place: str, path: Path, folder: DataFolder) -> Entry:
    size = size_of(record["width"], record["height"])
    lanes = numbered(_lanes(record))
    clip = relative(record.get("clip") or f"{path.stem}.mp4")
    if "image" in record:
        image = folder.find(path.parent / relative(record["image"]))
        group = clip.stem if "clip" in record else drive_of(image.parent)
        return Entry(place, folder.name(image), group, Picture(image), lanes, size)
    index = int(record["frame"])
    root = folder.root
    video = folder.find(path.parent / clip, root / "clips" / clip, root / "videos" / clip, root / clip)
    return Entry(place, f"{video.name}#{index}", clip.stem, Picture(video, index), lanes, size)
