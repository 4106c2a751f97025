"""The road: its course, and the boundaries of its lanes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from lanestream_exporter.scenes.camera import FloatArray

MarkingKind = Literal["solid", "dashed", "double", "botts"]
PaintColour = Literal["white", "yellow"]
Stripe = Literal["neither", "left", "right"]


@dataclass(frozen=True)
class Course:
    """Where the road goes: curvature in 1/m, positive to the left, linear between knots (a chain of clothoids).

    `bend` is the vertical curvature in 1/m seen from the vehicle: positive in a sag, negative before a crest.
    """

    spacing: float  # metres of road between two knots; the first knot is at s = 0
    curvatures: tuple[float, ...]
    bend: float = 0.0

    def curvature(self, s: FloatArray) -> FloatArray:
        """Curvature in 1/m at the road positions s in metres."""
        knots = self.spacing * np.arange(len(self.curvatures))
        return np.interp(s, knots, self.curvatures)

    def bearing(self, s: float) -> float:
        """Direction of the road at s in radians, anticlockwise from its direction at s = 0."""
        if s == 0.0:
            return 0.0
        along = np.linspace(0.0, s, max(2, math.ceil(abs(s))))
        return float(np.trapezoid(self.curvature(along), along))


@dataclass(frozen=True)
class Pose:
    """Where the vehicle is in road coordinates: s along the road, u to the left of its reference line."""

    s: float  # metres
    u: float  # metres
    heading: float  # radians, anticlockwise from the road's direction at s


@dataclass(frozen=True)
class Marking:
    """Paint or dots on a lane boundary. Lengths in metres."""

    kind: MarkingKind
    color: PaintColour
    width: float  # of one stripe, or the diameter of a dot
    brightness: float  # of fresh paint in daylight, 0 to 1
    wear: float  # share of the paint that is gone, 0 to 1
    period: float = 12.0  # of dashes, or of groups of dots
    dash: float = 3.0
    phase: float = 0.0
    gap: float = 0.12  # between the stripes of a double line
    broken: Stripe = "neither"  # which stripe of a double line is dashed
    dots: int = 4  # in a group, over the length `dash`
    seed: int = 0


@dataclass(frozen=True)
class Boundary:
    """A lane boundary at lateral position u in metres. Without a marking it is the bare edge of the road."""

    u: float
    marking: Marking | None

    @property
    def kind(self) -> str:
        """The label's kind: that of the marking, or "edge"."""
        return self.marking.kind if self.marking else "edge"


@dataclass(frozen=True)
class Road:
    """A road: its course and its boundaries from left to right. The index of a boundary is its identity."""

    course: Course
    boundaries: tuple[Boundary, ...]
    lanes: tuple[float, ...]  # middles of the lanes in our direction, u in metres

    def positions(self, u: float) -> tuple[int, ...]:
        """The position of every boundary seen from a vehicle at lateral position u: -1 and +1 bound its lane."""
        left = sum(boundary.u > u for boundary in self.boundaries)
        return tuple(i - left if i < left else i - left + 1 for i in range(len(self.boundaries)))
