"""What the readers of label files yield: labeled frames whose points are unchecked and whose images are unopened."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from lanestream.errors import LabelError
from lanestream.road.appearance import MARKING_COLORS, BoundaryKind
from lanestream_exporter.datasets.images import ImageLocation
from lanestream_exporter.datasets.labels import LANE_TYPES, PARTIAL, ROAD_EDGE_TYPES, Coverage, LabeledLane

# The words that label files use for the types of boundaries.
_TYPES: Final[Mapping[str, str]] = {
    **{name: name for name in LANE_TYPES},
    "broken": "dashed",
    "dash": "dashed",
    "continuous": "solid",
    "botts": "dots",
    "curb": "kerb",
}
_OTHER_COLORS: Final = frozenset(
    {"blue", "red", "orange", "green"}
)  # of paint that counts as a marking without a color
_UNPAINTED: Final = "none"
_MARKING: Final = "marking"
UNKNOWN: Final = "unknown"
_LONGEST_SIDE: Final = 1 << 20  # pixels

FieldValue = str | bool | int | float
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class LabelEntry:
    """A labeled frame as its label file describes it.

    `location` is where the record stands, `file:line` or `file: element`; the keys of `lanes` are locations within it.
    `size` is the (width, height) of the image if the labels give it. `video` and `index` name the video that the frame
    was taken from and its number there, if known. `split` is the record's own split. `extends_beyond_image` is true
    for formats whose boundaries run on outside the image. `converted` names the tools of the boundaries that were not
    drawn as lines, `others` names labeled shapes that are not boundaries, and `unknown` has the labels of lines that
    may be some. `fields` has the record's own words and numbers, such as the light.

    The manifest adds what it says about the whole data set: its name, the `coverage` of its labels, the `horizon` as a
    share of the height, and `masks`, boxes (left, top, right, bottom) in shares of width and height that are not road.
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
    converted: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    fields: Mapping[str, FieldValue] = field(default_factory=dict)
    dataset: str = ""
    coverage: Coverage = PARTIAL
    horizon: float | None = None
    masks: tuple[Box, ...] = ()


LabelEntries = Iterator[LabelEntry | LabelError]


def numbered(lanes: Iterable[LabeledLane], noun: str = "lane") -> dict[str, LabeledLane]:
    """Returns lanes by their number in a list, counted from one."""
    return {f"{noun} {number}": lane for number, lane in enumerate(lanes, start=1)}


@dataclass(frozen=True)
class LabeledLook:
    """The type, color and default kind of a labeled boundary, as LabeledLane explains them."""

    type: str | None = None
    color: str | None = None
    default_kind: BoundaryKind | None = None

    @classmethod
    def of(cls, type_words: Iterable[str], color_words: Iterable[str]) -> LabeledLook:
        """Returns the look that lower-case words describe, which may be the same for type and color.

        An edge of the road has no paint: the color "none" makes a boundary of unknown type an edge. An edge whose color
        is unknown may be painted, so nothing is known about it. The type "marking" is any painted line.
        """
        types, colors = list(type_words), set(color_words)
        named = next((_TYPES[word] for word in types if word in _TYPES), None)
        if named in ROAD_EDGE_TYPES:
            return cls() if UNKNOWN in colors else cls(named)
        if named is None and _UNPAINTED in colors:
            return cls("edge")
        color = next((name for name in MARKING_COLORS if name in colors), None)
        is_painted = _MARKING in types or not colors.isdisjoint(_OTHER_COLORS)
        return cls(named, color, "marking" if is_painted else None)


def is_type(word: str) -> bool:
    """Whether `word` names the type of a boundary, or says that it is unknown."""
    return word in _TYPES or word == UNKNOWN


def boundary_type(word: str) -> str | None:
    """Returns the type of a boundary, one of LANE_TYPES, that a lower-case word names; None if it names none."""
    return _TYPES.get(word)


def size_of(width: Any, height: Any) -> tuple[int, int]:
    """Returns an image size from the labels. Raises ValueError or TypeError if it is not a valid one."""
    size = int(width), int(height)
    if not all(0 < side < _LONGEST_SIDE for side in size):
        raise ValueError(f"{str(width)[:12]} x {str(height)[:12]} is not a valid image size")
    return size
