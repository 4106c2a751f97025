"""Which real frames may be trained on, which choose and calibrate, and which are for reporting alone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from lanestream.errors import LabelError
from lanestream.lanes import Image
from lanestream_exporter.datasets.clips import read_clip, read_clip_labels
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.records import records
from lanestream_exporter.datasets.tusimple import read_tusimple

Split = Literal["train", "val", "test"]

_CLIPS: dict[Split, tuple[str, ...]] = {
    "train": ("highway_project_8s", "highway_concrete"),
    "val": (),
    "test": ("highway_white_right",),
}

# The country road is one drive: cut by time, with the stretch between two parts left out of neither but never shared.
_COUNTRY_FRAMES: dict[Split, range] = {"train": range(2000), "val": range(2000, 2400), "test": range(2400, 2800)}


def data_root(given: Path | None = None) -> Path:
    """The folder of real frames: the `given` one, else `$LANESTREAM_DATA`, else `../shared/data`.

    Raises LabelError where no labelled frames are in it.
    """
    root = given or Path(os.environ.get("LANESTREAM_DATA", "../shared/data"))
    if not (root / "tusimple" / "labels.jsonl").is_file():
        raise LabelError(f"no labelled frames in {root}", "give the data folder with --data or in LANESTREAM_DATA")
    return root


def real_frames(root: Path, split: Split) -> Iterator[tuple[LabelledFrame, Image]]:
    """All labelled real frames of a split with their BGR images, drive after drive."""
    yield from read_tusimple(root / "tusimple", split)
    for name in _CLIPS[split]:
        clip = highway_clip(root, name)
        yield from read_clip(clip.video, clip.labels)
    yield from _country_frames(root / "udacity_ch2", _COUNTRY_FRAMES[split])


@dataclass(frozen=True)
class LabelledClip:
    """A video with key-frame labels, and the stretch of its frames that belongs to a split."""

    name: str
    video: Path
    labels: Path
    frames: range


def highway_clip(root: Path, name: str) -> LabelledClip:
    """One of the labelled highway clips, whole."""
    folder = root / "udacity"
    return LabelledClip(name, folder / "clips" / f"{name}.mp4", folder / "labels" / f"{name}.jsonl", range(1_000_000))


def labelled_clips(root: Path, split: Split) -> list[LabelledClip]:
    """The clips of a split: highways and the country road's stretch."""
    country = root / "udacity_ch2"
    video, labels = country / "country_road_140s.mp4", country / "labels.jsonl"
    return [
        *(highway_clip(root, name) for name in _CLIPS[split]),
        LabelledClip("country_road", video, labels, _COUNTRY_FRAMES[split]),
    ]


def _country_frames(root: Path, wanted: range) -> Iterator[tuple[LabelledFrame, Image]]:
    """Labelled frames of the country road from the original JPEGs, which the video has compressed once more."""
    labels = root / "labels.jsonl"
    images = {int(record["frame"]): str(record["image"]) for _, record in records(labels)}
    for index, frame in read_clip_labels(labels, exhaustive=True).items():
        if index in wanted:
            image = cv2.imread(str(root / images[index]))
            if image is None:
                raise LabelError(f"{labels}: {images[index]} can't be read as an image")
            yield frame, np.asarray(image, dtype=np.uint8)
