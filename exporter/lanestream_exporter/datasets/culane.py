"""CULane's labels: beside each image NAME.jpg a NAME.lines.txt with a lane a line, `x y x y ...` from below upwards.

Format: xingangpan.github.io/projects/CULane.html. Lanes are drawn on beyond the picture; what lies there is left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.entries import Entries, Entry
from lanestream_exporter.datasets.folder import DataFolder, drive_of
from lanestream_exporter.datasets.labels import LabelledLane
from lanestream_exporter.datasets.pictures import Picture
from lanestream_exporter.datasets.polylines import points_of
from lanestream_exporter.datasets.records import placed, text_of

SUFFIX: Final = ".lines.txt"
_ACCEPTED: Final = "a lane a line is accepted: x y x y ..."


def culane_entries(folder: DataFolder) -> Entries:
    """The frames that have a `.lines.txt`; a group is a clip's folder, as driver_23_30frame/05151640_0419.MP4."""
    for path in folder.with_suffix(SUFFIX):
        try:
            image = folder.picture_of(path.with_name(path.name[: -len(SUFFIX)]))
        except LabelError as error:
            yield placed(str(path), error)
            continue
        lanes, faults = _lanes(path)
        yield from faults
        if not faults:
            source = folder.name(image)
            yield Entry(str(path), source, drive_of(image.parent), Picture(image), lanes, overdrawn=True)


def _lanes(path: Path) -> tuple[dict[str, LabelledLane], list[LabelError]]:
    lanes, faults = {}, []
    try:
        lines = text_of(path, _ACCEPTED).splitlines()
    except LabelError as error:
        return {}, [error]
    for number, line in enumerate(lines, start=1):
        try:
            values = [float(word) for word in line.split()]
            if len(values) % 2:
                raise ValueError(f"{len(values)} numbers are no pairs of x and y")
            if values:
                lanes[f"line {number}"] = LabelledLane(points_of(list(zip(values[::2], values[1::2], strict=True))))
        except ValueError as error:
            faults.append(LabelError(f"{path}:{number}: {error}", _ACCEPTED))
    return lanes, faults
