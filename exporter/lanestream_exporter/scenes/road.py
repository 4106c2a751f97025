"""The road: its course, the boundaries of its lanes and their markings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from lanestream.road.appearance import MarkingColor, MarkingType
    from lanestream.road.curve import FloatArray

EdgeType = Literal["kerb", "edge"]
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

    type: MarkingType
    color: MarkingColor
    width: float  # of one stripe, or the diameter of a dot
    brightness: float  # of fresh paint in daylight, 0 to 1
    wear: float  # share of the paint that is missing, 0 to 1
    period: float = 12.0  # of dashes, or of groups of dots
    dash: float = 3.0
    phase: float = 0.0
    gap: float = 0.12  # between the stripes of a double line
    broken: Stripe = "neither"  # which stripe of a double line is dashed
    dots: int = 4  # in a group, over the length `dash`
    fade: float = 0.0  # how pale yellow paint has become: from 0, fresh, to 1, a whitish pink
    seed: int = 0


@dataclass(frozen=True)
class Taper:
    """A stretch of road on which a boundary moves to the side, because a lane ends or begins. Meters."""

    start: float  # s
    length: float
    shift: float  # to the left, from its start to its end

    def shift_at(self, s: FloatArray) -> FloatArray:
        """Returns the shift to the left at the road positions s."""
        share = np.clip((s - self.start) / self.length, 0.0, 1.0)
        return np.asarray(self.shift * share**2 * (3.0 - 2.0 * share))


@dataclass(frozen=True)
class Boundary:
    """A boundary at lateral position u in meters; without a marking it is an edge of the paved road.

    It reaches from s = `first` to s = `last`; a `taper` moves it to the side. `edge` is the type of an edge: the foot
    of a kerb, or any other place where the pavement ends.
    """

    u: float
    marking: Marking | None
    taper: Taper | None = None
    first: float = -math.inf
    last: float = math.inf
    edge: EdgeType = "edge"

    def u_at(self, s: FloatArray) -> FloatArray:
        """Returns the lateral positions at the road positions s, in meters."""
        return self.u + (self.taper.shift_at(s) if self.taper else np.zeros_like(s))

    def reaches(self, s: float) -> bool:
        """Returns whether the boundary exists at the road position s."""
        return self.first <= s <= self.last

    @property
    def type(self) -> MarkingType | EdgeType:
        """Returns the type for the label: that of the marking, or of the edge."""
        return self.marking.type if self.marking else self.edge


@dataclass(frozen=True)
class Road:
    """A road: its course and its boundaries from left to right, none of which cross. Their index is their lane id.

    Its edges, if it has any, are the outermost boundaries.
    """

    course: Course
    boundaries: tuple[Boundary, ...]
    lanes: tuple[float, ...]  # centers of the lanes in our direction, u in meters

    def beside(self, s: float, u: float) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Returns the indices of the boundaries left and right of a vehicle at (s, u), the nearest first."""
        here = [index for index, boundary in enumerate(self.boundaries) if boundary.reaches(s)]
        left = [index for index in here if self.boundaries[index].u_at(np.array(s)) > u]
        return tuple(reversed(left)), tuple(here[len(left) :])

    def positions(self, s: float, u: float) -> tuple[int | None, ...]:
        """Returns the position of every boundary for a vehicle at (s, u); -1 and +1 bound its lane.

        It is None for a boundary that has ended behind the vehicle or begins ahead of it.
        """
        left, right = self.beside(s, u)
        places = {index: -1 - place for place, index in enumerate(left)}
        places |= {index: 1 + place for place, index in enumerate(right)}
        return tuple(places.get(index) for index in range(len(self.boundaries)))
