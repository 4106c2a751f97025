"""What the readers of label files give: labelled frames whose points are unchecked and whose pictures are unopened."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream_exporter.datasets.folder import DataFolder
from lanestream_exporter.datasets.labels import LabelledLane
from lanestream_exporter.datasets.pictures import Picture

_KINDS: Final[Mapping[str, str]] = {
    **{kind: kind for kind in ("solid", "dashed", "double", "botts", "edge")},
    "broken": "dashed",
    "dash": "dashed",
    "continuous": "solid",
    "curb": "edge",
    "kerb": "edge",
}
_LONGEST_SIDE: Final = 1 << 20  # pixels
_COLOURS: Final = frozenset({"white", "yellow", "blue", "red", "orange"})


@dataclass(frozen=True)
class Entry:
    """A labelled frame as its file gives it.

    `place` is where it stands, `file:line` or `file: element`; `lanes` go by their place within it. `size` is the
    picture's (width, height) where the labels tell it. `overdrawn` says that the format draws boundaries on beyond the
    picture. `others` names the kinds of things that are labelled too and are no lines.
    """

    place: str
    source: str
    group: str
    picture: Picture
    lanes: Mapping[str, LabelledLane]
    size: tuple[int, int] | None = None
    overdrawn: bool = False
    others: tuple[str, ...] = ()


Entries = Iterator[Entry | LabelError]
Reader = Callable[[DataFolder], Entries]


def numbered(lanes: Iterable[LabelledLane], noun: str = "lane") -> dict[str, LabelledLane]:
    """Lanes by their place in a list, counted from one."""
    return {f"{noun} {number}": lane for number, lane in enumerate(lanes, start=1)}


def kind_in(words: Iterable[str]) -> str | None:
    """The kind of marking that one of `words` names, as this project calls it."""
    return next((_KINDS[word] for word in words if word in _KINDS), None)


def colour_in(words: Iterable[str]) -> str | None:
    """The colour that one of `words` names."""
    return next((word for word in words if word in _COLOURS), None)


def size_of(width: Any, height: Any) -> tuple[int, int]:
    """A picture's size as labels tell it. Raises ValueError or TypeError where it is none."""
    size = int(width), int(height)
    if not all(0 < side < _LONGEST_SIDE for side in size):
        raise ValueError(f"{str(width)[:12]} x {str(height)[:12]} is no size of a picture")
    return size
