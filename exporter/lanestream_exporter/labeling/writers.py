"""The table of formats that pre-labels are written in, and the folder of a labeling task."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from lanestream.errors import SourceError
from lanestream.writing import writing
from lanestream_exporter.labeling.benchmark_writers import write_culane, write_tusimple
from lanestream_exporter.labeling.cvat_writer import write_cvat
from lanestream_exporter.labeling.label_studio_writer import write_label_studio
from lanestream_exporter.labeling.labelme_writer import write_labelme
from lanestream_exporter.labeling.prelabels import PrelabeledFrame
from lanestream_exporter.labeling.tasks import IMAGES, LabelImage

# Each writes the labels of images, which are in the folder `images`, and returns the file or folder to open.
WRITERS: Final[Mapping[str, Callable[[Sequence[LabelImage], Path], Path]]] = {
    "cvat": write_cvat,
    "labelme": write_labelme,
    "label-studio": write_label_studio,
    "tusimple": write_tusimple,
    "culane": write_culane,
}
REPORT: Final = "difficulty.csv"


def require_new(out: Path) -> None:
    """Raises SourceError if the folder `out` has anything in it, such as labels that somebody has corrected."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise SourceError(f"{out} is not empty", "give a new folder, so that no labels are overwritten")


def hardest_first(frames: Sequence[PrelabeledFrame], most: int | None) -> list[PrelabeledFrame]:
    """Returns the frames in order of their difficulty, at most the `most` hardest ones."""
    return sorted(frames, key=lambda frame: -frame.difficulty.score)[:most]


def write_task(frames: Sequence[PrelabeledFrame], out: Path, format_name: str) -> Path:
    """Writes images, labels and difficulties of frames to the folder `out`, in their order.

    Image files begin with their rank, so that programs that sort by name show them in this order. Returns the file or
    folder to open. Raises SourceError if something can't be written.
    """
    digits = max(4, len(str(len(frames))))
    names = [f"{rank:0{digits}d}_{frame.stem}{frame.path.suffix}" for rank, frame in enumerate(frames, start=1)]
    with writing(out):
        (out / IMAGES).mkdir()
        for name, frame in zip(names, frames, strict=True):
            shutil.copyfile(frame.path, out / IMAGES / name)
        images = [
            LabelImage(name, frame.width, frame.height, frame.lanes) for name, frame in zip(names, frames, strict=True)
        ]
        with (out / REPORT).open("w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(("image", "source", "score", "reason"))
            for name, frame in zip(names, frames, strict=True):
                rows.writerow((name, frame.source, f"{frame.difficulty.score:.3f}", frame.difficulty.reason))
        return WRITERS[format_name](images, out)
