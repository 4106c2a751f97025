"""Reads CULane's labels: next to each image NAME.jpg a NAME.lines.txt, one lane per line, `x y x y ...` upwards.

Format: xingangpan.github.io/projects/CULane.html. Lanes run on outside the image; those points are left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import LabelEntries, LabelEntry
from lanestream_exporter.datasets.files import DataFolder, drive_of, error_at, read_lines
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LabeledLane, points_of

_SUFFIX: Final = ".lines.txt"
_ACCEPTED: Final = "one lane per line is accepted: x y x y ..."


def is_culane(path: Path, _start: bytes) -> bool:
    """Whether the file at `path` holds CULane labels."""
    return path.name.lower().endswith(_SUFFIX)


def culane_entries(folder: DataFolder) -> LabelEntries:
    """Yields the frames that have a `.lines.txt`. A group is a clip's folder: driver_23_30frame/05151640_0419.MP4."""
    for path in folder.with_suffix(_SUFFIX):
        try:
            image = folder.find_image(path.with_name(path.name[: -len(_SUFFIX)]))
        except LabelError as error:
            yield error_at(str(path), error)
            continue
        lanes, faults = _lanes(path)
        yield from faults
        if not faults:
            group = drive_of(image.parent)
            yield LabelEntry(
                str(path), folder.name(image), group, ImageLocation(image), lanes, extends_beyond_image=True
            )


def _lanes(path: Path) -> tuple[dict[str, LabeledLane], list[LabelError]]:
    lanes, faults = {}, []
    try:
        lines = read_lines(path, _ACCEPTED)
    except LabelError as error:
        return {}, [error]
    for number, line in enumerate(lines, start=1):
        try:
            values = [float(word) for word in line.split()]
            if len(values) % 2:
                raise ValueError(f"{len(values)} numbers are not pairs of x and y")
            if values:
                lanes[f"line {number}"] = LabeledLane(points_of(list(zip(values[::2], values[1::2], strict=True))))
        except ValueError as error:
            faults.append(LabelError(f"{path}:{number}: {error}", _ACCEPTED))
    return lanes, faults
