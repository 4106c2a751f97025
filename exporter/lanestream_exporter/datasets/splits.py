"""Which real frames may be trained on, which choose and calibrate, and which are for reporting alone."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from lanestream.errors import LabelError
from lanestream.road.view import Image
from lanestream_exporter.datasets.clips import read_clip, read_clip_labels
from lanestream_exporter.datasets.label_propagation import Between
from lanestream_exporter.datasets.labels import EGO_LANE, PARTIAL, Coverage, LabelledFrame
from lanestream_exporter.datasets.records import records
from lanestream_exporter.datasets.tusimple import read_tusimple

Split = Literal["train", "val", "test"]

# Left of the yellow line of the first two is a barrier: what looks like a boundary there is none.
_CLIPS: dict[Split, dict[str, Coverage]] = {
    "train": {"highway_project_8s": Coverage(open_sides=(1,)), "highway_concrete": Coverage(open_sides=(1,))},
    "val": {},
    "test": {"highway_white_right": PARTIAL},
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
    for clip in _highway_clips(root, split):
        yield from read_clip(clip.video, clip.labels, clip.coverage)
    yield from _country_frames(root / "udacity_ch2", _COUNTRY_FRAMES[split])


def training_frames(root: Path, between: Between | None) -> Iterator[tuple[LabelledFrame, Image]]:
    """The frames of the training split, and those that `between` labels from them, drive after drive."""
    yield from real_frames(root, "train")
    if between is None:
        return
    for clip in labelled_clips(root, "train"):
        labelled = read_clip_labels(clip.labels, clip.coverage)
        yield from between.frames(clip.video, {i: frame for i, frame in labelled.items() if i in clip.frames})


@dataclass(frozen=True)
class LabelledClip:
    """A video with key-frame labels, what they cover, and the stretch of its frames that belongs to a split."""

    name: str
    video: Path
    labels: Path
    frames: range
    coverage: Coverage = PARTIAL


def highway_clip(root: Path, name: str, coverage: Coverage = PARTIAL) -> LabelledClip:
    """One of the labelled highway clips, whole."""
    video, labels = root / "udacity/clips" / f"{name}.mp4", root / "udacity/labels" / f"{name}.jsonl"
    return LabelledClip(name, video, labels, range(1_000_000), coverage)


def labelled_clips(root: Path, split: Split) -> list[LabelledClip]:
    """The clips of a split: highways and the country road's stretch."""
    country = root / "udacity_ch2"
    video, labels = country / "country_road_140s.mp4", country / "labels.jsonl"
    return [
        *_highway_clips(root, split),
        LabelledClip("country_road", video, labels, _COUNTRY_FRAMES[split], EGO_LANE),
    ]


def _highway_clips(root: Path, split: Split) -> list[LabelledClip]:
    return [highway_clip(root, name, coverage) for name, coverage in _CLIPS[split].items()]


def _country_frames(root: Path, wanted: range) -> Iterator[tuple[LabelledFrame, Image]]:
    """Labelled frames of the country road from the original JPEGs, which the video has compressed once more."""
    labels = root / "labels.jsonl"
    images = {int(record["frame"]): str(record["image"]) for _, record in records(labels)}
    for index, frame in read_clip_labels(labels, EGO_LANE).items():
        if index in wanted:
            image = cv2.imread(str(root / images[index]))
            if image is None:
                raise LabelError(f"{labels}: {images[index]} can't be read as an image")
            yield frame, np.asarray(image, dtype=np.uint8)


@dataclass(frozen=True)
class GroupSplit:
    """Which drives or clips are trained on, and which choose and calibrate."""

    train: frozenset[str]
    validation: frozenset[str]


def split_by_group(groups: Iterable[str], validation_share: float, seed: int = 0) -> GroupSplit:
    """Divides frames by drive or clip; `groups` has the `frame.group` of every frame, in any order.

    Whole groups in an order drawn with `seed` go to validation, as many as come nearest to `validation_share` (0 to 1)
    of all frames; each side has a group at least. The same frames and seed give the same split.
    Raises LabelError where there are fewer than two groups, because one can't be divided.
    """
    sizes = Counter(groups)
    if len(sizes) < 2:
        raise LabelError(
            f"there is no split of {len(sizes)} drive or clip by drive",
            "frames of two at least are needed: put each into a folder of its own",
        )
    wanted = validation_share * sizes.total()
    names = sorted(sizes)
    order = [names[number] for number in np.random.default_rng(seed).permutation(len(names))]
    validation: set[str] = set()
    taken = 0
    for name in order:
        if taken + sizes[name] <= wanted:
            validation.add(name)
            taken += sizes[name]
    # One more where a little too much is nearer than a little too few.
    left = [name for name in order if name not in validation]
    if left and abs(taken + (least := min(sizes[name] for name in left)) - wanted) < wanted - taken:
        validation.add(next(name for name in left if sizes[name] == least))
    if not validation:
        validation.add(min(order, key=lambda name: sizes[name]))
    if len(validation) == len(names):
        validation.remove(max(order, key=lambda name: sizes[name]))
    return GroupSplit(frozenset(names) - validation, frozenset(validation))


def refuse_leak(train: Iterable[str], validation: Iterable[str], test: Iterable[str] = ()) -> None:
    """Raises LabelError where a drive or clip is in more than one part; each part is the `frame.group` of its frames.

    Neighbouring frames look alike, so that a drive on both sides would be a test on what was learnt by heart.
    """
    parts = {"train": set(train), "validation": set(validation), "test": set(test)}
    for (one, left), (other, right) in combinations(parts.items(), 2):
        if shared := sorted(left & right):
            more = f" and {len(shared) - 1} more" if len(shared) > 1 else ""
            raise LabelError(
                f"{shared[0]!r}{more} is in both {one} and {other}",
                "a drive or clip may be on one side of a split only",
            )
