"""What the readers of label files yield: labeled frames whose points are unchecked and whose images are unopened."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.files import DataFolder
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LabeledLane

_KINDS: Final[Mapping[str, str]] = {
    **{kind: kind for kind in ("solid", "dashed", "double", "botts", "edge")},
    "broken": "dashed",
    "dash": "dashed",
    "continuous": "solid",
    "curb": "edge",
    "kerb": "edge",
}
_LONGEST_SIDE: Final = 1 << 20  # pixels
_COLORS: Final = frozenset({"white", "yellow", "blue", "red", "orange"})


@dataclass(frozen=True)
class LabelEntry:
    """A labeled frame as its label file describes it.

    `location` is where the record stands, `file:line` or `file: element`; the keys of `lanes` are locations within it.
    `size` is the (width, height) of the image if the labels give it. `video` and `index` name the video that the frame
    was taken from and its number there, if known. `split` is the record's own split. `extends_beyond_image` is true
    for formats whose boundaries run on outside the image. `others` names labeled shapes that are not lines.
    """

    location: str
    source: str
    group: str
    image: ImageLocation
    lanes: Mapping[str, LabeledLane]
    size: tuple[int, int] | None = None
    video: Path | None = None
    index: int | None = None
    split: str | None = None
    extends_beyond_image: bool = False
    others: tuple[str, ...] = ()


LabelEntries = Iterator[LabelEntry | LabelError]


@dataclass(frozen=True)
class LabelFormat:
    """A label format: `read` yields the entries of a data set.

    `recognizes` says whether a file holds such labels, by its path and the first bytes of a JSON or XML file.
    """

    read: Callable[[DataFolder], LabelEntries]
    recognizes: Callable[[Path, bytes], bool]


def numbered(lanes: Iterable[LabeledLane], noun: str = "lane") -> dict[str, LabeledLane]:
    """Returns lanes by their number in a list, counted from one."""
    return {f"{noun} {number}": lane for number, lane in enumerate(lanes, start=1)}


def kind_in(words: Iterable[str]) -> str | None:
    """Returns the kind of marking, in this project's terms, that one of `words` names."""
    return next((_KINDS[word] for word in words if word in _KINDS), None)


def color_in(words: Iterable[str]) -> str | None:
    """Returns the color that one of `words` names."""
    return next((word for word in words if word in _COLORS), None)


def size_of(width: Any, height: Any) -> tuple[int, int]:
    """Returns an image size from the labels. Raises ValueError or TypeError if it is not a valid one."""
    size = int(width), int(height)
    if not all(0 < side < _LONGEST_SIDE for side in size):
        raise ValueError(f"{str(width)[:12]} x {str(height)[:12]} is not a valid image size")
    return size
