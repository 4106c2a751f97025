"""The road: its course, the boundaries of its lanes and their markings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from lanestream.road.curve import FloatArray

MarkingKind = Literal["solid", "dashed", "double", "botts"]
PaintColor = Literal["white", "yellow"]
Stripe = Literal["neither", "left", "right"]


@dataclass(frozen=True)
class Course:
    """The course of a road: curvature in 1/m, positive to the left, linear between knots (a chain of clothoids).

    `vertical_curvature` is in 1/m at the vehicle: positive in a sag, negative before a crest.
    """

    spacing: float  # meters of road between two knots; the first knot is at s = 0
    curvatures: tuple[float, ...]
    vertical_curvature: float = 0.0

    def curvature(self, s: FloatArray) -> FloatArray:
        """Returns the curvature in 1/m at the road positions s in meters."""
        knots = self.spacing * np.arange(len(self.curvatures))
        return np.interp(s, knots, self.curvatures)

    def bearing(self, s: float) -> float:
        """Returns the direction of the road at s in radians, counterclockwise from its direction at s = 0."""
        if s == 0.0:
            return 0.0
        along = np.linspace(0.0, s, max(2, math.ceil(abs(s))))
        return float(np.trapezoid(self.curvature(along), along))


@dataclass(frozen=True)
class Pose:
    """The pose of the vehicle in road coordinates: s along the road, u to the left of its reference line."""

    s: float  # meters
    u: float  # meters
    heading: float  # radians, counterclockwise from the road's direction at s


@dataclass(frozen=True)
class Marking:
    """Paint or dots on a lane boundary. Lengths in meters."""

    kind: MarkingKind
    color: PaintColor
    width: float  # of one stripe, or the diameter of a dot
    brightness: float  # of fresh paint in daylight, 0 to 1
    wear: float  # share of the paint that is missing, 0 to 1
    period: float = 12.0  # of dashes, or of groups of dots
    dash: float = 3.0
    phase: float = 0.0
    gap: float = 0.12  # between the stripes of a double line
    broken: Stripe = "neither"  # which stripe of a double line is dashed
    dots: int = 4  # in a group, over the length `dash`
    seed: int = 0


@dataclass(frozen=True)
class Boundary:
    """A lane boundary at lateral position u in meters; without a marking it is the unmarked edge of the road."""

    u: float
    marking: Marking | None

    @property
    def kind(self) -> str:
        """Returns the kind for the label: that of the marking, or "edge"."""
        return self.marking.kind if self.marking else "edge"


@dataclass(frozen=True)
class Road:
    """A road: its course and its boundaries from left to right. The index of a boundary is its lane id."""

    course: Course
    boundaries: tuple[Boundary, ...]
    lanes: tuple[float, ...]  # centers of the lanes in our direction, u in meters

    def positions(self, u: float) -> tuple[int, ...]:
        """Returns the position of every boundary for a vehicle at lateral position u; -1 and +1 bound its lane."""
        left = sum(boundary.u > u for boundary in self.boundaries)
        return tuple(i - left if i < left else i - left + 1 for i in range(len(self.boundaries)))
