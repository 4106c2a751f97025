"""What the writers of label files get: the images of a labeling task, the hardest first, with their pre-labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES, BoundaryKind
from lanestream_exporter.datasets.labels import ROAD_EDGE_TYPES, LabeledLane

IMAGES: Final = "images"
# The label of each kind of boundary, and the types and colors that it may have. A line of type `marking` is painted,
# but of no known type.
LABELS: Final[Mapping[BoundaryKind, str]] = {"marking": "lane", "road_edge": "road_edge"}
UNCLASSIFIED: Final = "marking"
TYPES: Final[Mapping[BoundaryKind, tuple[str, ...]]] = {
    "marking": (UNCLASSIFIED, *MARKING_TYPES),
    "road_edge": tuple(reversed(ROAD_EDGE_TYPES)),
}
COLORS: Final = MARKING_COLORS


@dataclass(frozen=True)
class LabelImage:
    """One image of a task: the `name` of its file in the folder `images`, its size in pixels and its lanes."""

    name: str
    width: int
    height: int
    lanes: tuple[LabeledLane, ...]


def kind_of(lane: LabeledLane) -> BoundaryKind:
    """Returns the kind of a pre-label, which is always known."""
    return lane.kind or "marking"


def type_of(lane: LabeledLane) -> str:
    """Returns the type of a pre-label, one of TYPES."""
    return lane.type or UNCLASSIFIED
