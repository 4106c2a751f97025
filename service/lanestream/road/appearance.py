"""What a boundary is, a marking or an edge of the road, and how its marking is painted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

BoundaryKind = Literal["marking", "road_edge"]
MarkingType = Literal["solid", "dashed", "double", "dots"]
MarkingColor = Literal["white", "yellow"]

BOUNDARY_KINDS: Final[tuple[BoundaryKind, ...]] = get_args(BoundaryKind)
MARKING_TYPES: Final[tuple[MarkingType, ...]] = get_args(MarkingType)
MARKING_COLORS: Final[tuple[MarkingColor, ...]] = get_args(MarkingColor)


@dataclass(frozen=True)
class Appearance:
    """How a boundary looks, as probabilities.

    `road_edge` is the probability that it is an edge of the road rather than a marking. If it is a marking, it is of
    each of MARKING_TYPES with the probabilities `types` (4,), and has each of MARKING_COLORS with the probabilities
    `colors` (2,). Both are None if the model does not classify markings.
    """

    road_edge: float = 0.0
    types: tuple[float, ...] | None = None
    colors: tuple[float, ...] | None = None

    @property
    def kind(self) -> BoundaryKind:
        """The more probable kind."""
        return "road_edge" if self.road_edge > 0.5 else "marking"
