"""Labels of video clips: one JSON object a key frame, the form that `lanestream scene` writes too."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lanestream.errors import LabelError, SourceError
from lanestream.lanes import Image
from lanestream_exporter.datasets.labels import LabelledFrame, LabelledLane
from lanestream_exporter.datasets.records import records, unusable


def read_clip_labels(path: Path, exhaustive: bool = False) -> dict[int, LabelledFrame]:
    """Labelled frames by their index in the clip; `exhaustive` says that the labels name all that can be told.

    Raises LabelError that names the file and the line.
    """
    frames: dict[int, LabelledFrame] = {}
    for place, record in records(path):
        try:
            frames[int(record["frame"])] = _frame(record, path, exhaustive)
        except (ValueError, KeyError, TypeError) as error:
            raise unusable(place, error, "frame, width, height and lanes") from error
    return frames


def _frame(record: dict[str, Any], path: Path, exhaustive: bool) -> LabelledFrame:
    lanes = tuple(
        LabelledLane(
            points=np.asarray(lane["points"], dtype=float).reshape(-1, 2),
            lane_id=lane.get("id"),
            position=lane.get("position"),
            kind=lane.get("type"),
            color=lane.get("color"),
        )
        for lane in record["lanes"]
    )
    clip = str(record.get("clip", path.stem))
    source = f"{clip}#{record['frame']}"
    return LabelledFrame(int(record["width"]), int(record["height"]), lanes, Path(clip).stem, source, exhaustive)


def read_clip(video: Path, labels: Path) -> Iterator[tuple[LabelledFrame, Image]]:
    """The labelled frames of a clip with their BGR images (H, W, 3), in order. Raises SourceError, LabelError."""
    wanted = read_clip_labels(labels)
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
