"""Sampling of a road's cross-section: its lanes, boundaries, markings and paved width."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

from lanestream_exporter.scenes.road import Boundary, EdgeType, Marking, Stripe

if TYPE_CHECKING:
    from lanestream.road.appearance import MarkingColor, MarkingType
    from lanestream_exporter.scenes.random_sampler import RandomSampler

RoadStyle = Literal["highway", "country", "street", "lane", "campus", "square"]

# (period, dash length) in meters, as painted in different countries and cities.
DASHES = (
    (12.2, 3.05),
    (12.0, 3.0),
    (18.0, 6.0),
    (12.0, 6.0),
    (9.0, 3.0),
    (6.0, 3.0),
    (15.0, 4.5),
    (24.0, 8.0),
    (4.0, 2.0),
)

# How often each type of marking is used, by its place on the road.
LANE_DIVIDER: dict[MarkingType, float] = {"dashed": 0.65, "dots": 0.32, "solid": 0.03}
MEDIAN: dict[MarkingType, float] = {"solid": 0.93, "double": 0.07}
AMERICAN_CENTER: dict[MarkingType, float] = {"double": 0.6, "dashed": 0.25, "solid": 0.15}
EUROPEAN_CENTER: dict[MarkingType, float] = {"dashed": 0.6, "solid": 0.3, "double": 0.1}
STREET_CENTER: dict[MarkingType, float] = {"double": 0.5, "solid": 0.25, "dashed": 0.25}
ROAD_SIDE: dict[MarkingType | None, float] = {"solid": 0.72, None: 0.2, "dashed": 0.08}
BROKEN_STRIPE: dict[Stripe, float] = {"neither": 0.75, "left": 0.13, "right": 0.12}
PAINT_COLORS: tuple[MarkingColor, ...] = ("yellow", "white")
MIXED_DIVIDER_SHARE = 0.08  # share of highways whose lane dividers are of several types
FADED_SHARE: Final = 0.15  # share of roads whose yellow paint has become pale

KERB_SHARES: dict[RoadStyle, float] = {  # how often the edges of a road are kerbs
    "highway": 0.05,
    "country": 0.06,
    "street": 0.92,
    "lane": 0.2,
    "campus": 0.7,
    "square": 0.0,
}
PAVED_REACH: Final = 70.0  # how far pavement without an edge extends to the side, meters


@dataclass(frozen=True)
class Layout:
    """A road's cross-section. Lateral positions u in meters, left positive; the center of the ego lane is u = 0.

    `boundaries` are in order from left to right. They include the edges of the pavement, whose types `edges` repeats.
    """

    style: RoadStyle
    boundaries: tuple[Boundary, ...]
    ahead: tuple[float, ...]  # centers of the lanes in our direction
    oncoming: tuple[float, ...]  # centers of the oncoming lanes
    lane_width: float
    paved: tuple[float, float]  # right and left edge of the pavement
    concrete: bool
    tone: float  # brightness of the driving surface
    opposite: float = 0.0  # another roadway beyond the left edge (+1) or the right edge (-1); 0 for neither
    edges: tuple[EdgeType | None, EdgeType | None] = (None, None)  # right and left; None where the pavement goes on

    @property
    def markings(self) -> tuple[Boundary, ...]:
        """Returns the boundaries that are painted."""
        return tuple(boundary for boundary in self.boundaries if boundary.marking)

    @property
    def roadside(self) -> tuple[float, float]:
        """Returns where trees, posts and houses may begin on the right and the left: at the edges, or on a square."""
        return max(self.paved[0], -18.0), min(self.paved[1], 18.0)

    def mirrored(self) -> Layout:
        """Returns the same road for left-hand traffic."""
        flipped = []
        for boundary in reversed(self.boundaries):
            marking = boundary.marking
            if marking and marking.broken != "neither":
                marking = replace(marking, broken="right" if marking.broken == "left" else "left")
            flipped.append(replace(boundary, u=-boundary.u, marking=marking))
        return replace(
            self,
            boundaries=tuple(flipped),
            ahead=tuple(-u for u in self.ahead),
            oncoming=tuple(-u for u in self.oncoming),
            paved=(-self.paved[1], -self.paved[0]),
            opposite=-self.opposite,
            edges=(self.edges[1], self.edges[0]),
        )

    def with_edges(self, right: EdgeType | None, left: EdgeType | None) -> Layout:
        """Returns the same road with edges of these types at the limits of the pavement; without one it goes on."""
        paved = (self.paved[0] if right else -PAVED_REACH, self.paved[1] if left else PAVED_REACH)
        boundaries = self.boundaries
        if left:
            boundaries = (Boundary(paved[1], None, edge=left), *boundaries)
        if right:
            boundaries = (*boundaries, Boundary(paved[0], None, edge=right))
        return replace(self, boundaries=boundaries, paved=paved, edges=(right, left))


@dataclass(frozen=True)
class _Painter:
    """Samples the markings of one road, which share their paint, age and dash pattern."""

    sampler: RandomSampler
    tone: float
    period: float
    dash: float
    phase: float
    wear: float
    brightness: float
    width: float

    @classmethod
    def for_road(cls, sampler: RandomSampler, tone: float) -> _Painter:
        """Samples the paint for a road whose surface has the brightness `tone`."""
        period, dash = sampler.choice(DASHES)
        faint = sampler.bernoulli(0.4)  # old paint on pale concrete is only a little lighter than the road
        brightness = min(0.98, tone + (sampler.uniform(0.09, 0.22) if faint else sampler.uniform(0.2, 0.6)))
        wear = sampler.uniform(0.0, 0.25) if sampler.bernoulli(0.5) else sampler.uniform(0.2, 0.78)
        return cls(
            sampler, tone, period, dash, sampler.uniform(0.0, period), wear, brightness, sampler.uniform(0.1, 0.2)
        )

    def line(self, type_: MarkingType, color: MarkingColor) -> Marking:
        """Returns a marking of this type, slightly different from the road's other markings."""
        sampler = self.sampler
        common = Marking(
            type=type_,
            color=color,
            width=min(0.3, self.width * sampler.uniform(0.9, 1.4)),
            brightness=min(0.98, max(self.tone + 0.07, self.brightness + sampler.normal(0.04))),
            wear=min(0.8, max(0.0, self.wear + sampler.normal(0.08))),
            period=self.period,
            dash=self.dash,
            phase=self.phase + sampler.normal(0.3),
            gap=sampler.uniform(0.09, 0.2),
            seed=sampler.seed(),
        )
        if type_ == "dots":
            return self._dots(common)
        if type_ == "double":
            return replace(common, width=min(0.15, common.width), broken=sampler.weighted_choice(BROKEN_STRIPE))
        return common

    def _dots(self, common: Marking) -> Marking:
        """Returns dots in groups or evenly spaced, some of them missing."""
        sampler = self.sampler
        spacing = sampler.uniform(0.9, 1.6)
        dots = sampler.choice((1, 3, 4, 4, 5))
        return replace(
            common,
            width=sampler.uniform(0.1, 0.15),
            dots=dots,
            dash=spacing * (dots - 1),
            period=sampler.uniform(2.0, 7.3) if dots == 1 else max(self.period, spacing * dots + 2.0),
            wear=sampler.uniform(0.0, 0.45),
            brightness=min(1.0, common.brightness + sampler.uniform(0.0, 0.15)),
        )


def sample_layout(sampler: RandomSampler, style: RoadStyle) -> Layout:
    """Samples a cross-section of the given style; 12 % are for left-hand traffic."""
    maker = {
        "highway": _highway,
        "country": _country,
        "street": _street,
        "lane": _bare_lane,
        "campus": _campus,
        "square": _square,
    }[style]
    layout = maker(sampler)
    layout = layout.with_edges(*_edges(sampler.branch(), style))
    return _with_old_paint(sampler.branch(), layout.mirrored() if sampler.bernoulli(0.12) else layout)


def _edges(sampler: RandomSampler, style: RoadStyle) -> tuple[EdgeType | None, EdgeType | None]:
    """Samples the types of the right and the left edge, mostly equal; some small roads open into a yard."""
    if style == "square":
        return None, None
    kerbs: dict[EdgeType, float] = {"kerb": KERB_SHARES[style], "edge": 1.0 - KERB_SHARES[style]}
    right = sampler.weighted_choice(kerbs)
    left = right if sampler.bernoulli(0.75) else sampler.weighted_choice(kerbs)
    if style == "campus" and sampler.bernoulli(0.06):
        return right, None
    return right, left


def _with_old_paint(sampler: RandomSampler, layout: Layout) -> Layout:
    """Returns the same road, sometimes with yellow paint that is nearly white."""
    if not sampler.bernoulli(FADED_SHARE):
        return layout
    fade = sampler.uniform(0.4, 0.9)
    boundaries = tuple(
        replace(boundary, marking=replace(boundary.marking, fade=fade)) if boundary.marking else boundary
        for boundary in layout.boundaries
    )
    return replace(layout, boundaries=boundaries)


def _tone(sampler: RandomSampler, *, concrete: bool) -> float:
    return sampler.uniform(0.42, 0.64) if concrete else sampler.uniform(0.22, 0.5)


def _highway(sampler: RandomSampler) -> Layout:
    lanes, width = sampler.weighted_choice({2: 0.3, 3: 0.3, 4: 0.27, 5: 0.13}), sampler.uniform(3.35, 3.9)
    ego = sampler.integer(0, lanes - 1)
    concrete = sampler.bernoulli(0.45)
    tone = _tone(sampler, concrete=concrete)
    paint = _Painter.for_road(sampler, tone)
    mixed, usual_type = sampler.bernoulli(MIXED_DIVIDER_SHARE), sampler.weighted_choice(LANE_DIVIDER)
    boundaries = []
    for index in range(lanes + 1):
        u = (ego + 0.5 - index) * width
        if index == 0:
            marking = paint.line(
                sampler.weighted_choice(MEDIAN), sampler.weighted_choice({"yellow": 0.65, "white": 0.35})
            )
        elif index == lanes:
            marking = paint.line("solid", "white")
        elif index == 1 and lanes > 2 and sampler.bernoulli(0.07):
            marking = paint.line("double", sampler.choice(PAINT_COLORS))
        else:
            marking = paint.line(sampler.weighted_choice(LANE_DIVIDER) if mixed else usual_type, "white")
        boundaries.append(Boundary(u, marking))
    left, right = sampler.uniform(0.4, 3.2), sampler.uniform(0.6, 3.6)
    paved = (boundaries[-1].u - right, boundaries[0].u + left)
    ahead = tuple((ego - index) * width for index in range(lanes))
    return Layout("highway", tuple(boundaries), ahead, (), width, paved, concrete, tone, float(sampler.bernoulli(0.7)))


def _country(sampler: RandomSampler) -> Layout:
    width = sampler.uniform(2.8, 3.7)
    tone = _tone(sampler, concrete=False)
    paint = _Painter.for_road(sampler, tone)
    american = sampler.bernoulli(0.6)
    center = paint.line(
        sampler.weighted_choice(AMERICAN_CENTER if american else EUROPEAN_CENTER), "yellow" if american else "white"
    )
    side = sampler.weighted_choice(ROAD_SIDE)
    shoulder = sampler.uniform(0.15, 1.2)
    boundaries: tuple[Boundary, ...] = (Boundary(0.5 * width, center),)
    if side:
        left, right = (Boundary(u, paint.line(side, "white")) for u in (1.5 * width, -0.5 * width))
        boundaries = (left, *boundaries, right)
    margin = shoulder if side else 0.3 * shoulder
    paved = (-0.5 * width - margin, 1.5 * width + margin)
    return Layout("country", boundaries, (0.0,), (width,), width, paved, False, tone)


def _street(sampler: RandomSampler) -> Layout:
    """Samples a street, mostly between kerbs, with room to park on either side."""
    width, lanes = sampler.uniform(2.8, 3.5), sampler.integer(1, 3)
    oncoming_lanes = sampler.choice((0, 1, 1, 2))
    concrete = sampler.bernoulli(0.12)
    tone = _tone(sampler, concrete=concrete)
    paint = _Painter.for_road(sampler, tone)
    ego = sampler.integer(0, lanes - 1)
    left = (ego + 0.5) * width
    boundaries = []
    if oncoming_lanes:
        if sampler.bernoulli(0.5):
            far = paint.line("solid", "white")
            boundaries.append(Boundary(left + oncoming_lanes * width, far))
        boundaries += [
            Boundary(left + (oncoming_lanes - k) * width, paint.line("dashed", "white"))
            for k in range(1, oncoming_lanes)
        ]
        boundaries.append(
            Boundary(left, paint.line(sampler.weighted_choice(STREET_CENTER), sampler.choice(PAINT_COLORS)))
        )
    elif sampler.bernoulli(0.6):
        boundaries.append(Boundary(left, paint.line("solid", sampler.choice(PAINT_COLORS))))
    boundaries += [Boundary(left - k * width, paint.line("dashed", "white")) for k in range(1, lanes)]
    parking = sampler.choice((0.4, 0.8, 2.4))
    bays = parking > 2.0 and sampler.bernoulli(0.2)
    if bays or sampler.bernoulli(0.6):
        boundaries.append(Boundary(left - lanes * width, paint.line("dashed" if bays else "solid", "white")))
    paved = (left - lanes * width - parking, left + oncoming_lanes * width + sampler.choice((0.4, 2.4)))
    ahead = tuple(left - (k + 0.5) * width for k in range(lanes))
    oncoming = tuple(left + (k + 0.5) * width for k in range(oncoming_lanes))
    return Layout("street", tuple(boundaries), ahead, oncoming, width, paved, concrete, tone)


def _bare_lane(sampler: RandomSampler) -> Layout:
    """Samples a small road bounded by its unmarked edges, sometimes with a painted center line."""
    width = sampler.uniform(2.6, 3.4)
    tone = _tone(sampler, concrete=sampler.bernoulli(0.15))
    paint = _Painter.for_road(sampler, tone)
    two_way = sampler.bernoulli(0.55)
    reach = sampler.uniform(0.55, 0.7) * width
    left = 1.5 * width if two_way else reach
    boundaries: tuple[Boundary, ...] = ()
    if two_way and sampler.bernoulli(0.5):
        boundaries = (Boundary(0.5 * width, paint.line("dashed", sampler.choice(PAINT_COLORS))),)
    oncoming = (width,) if two_way else ()
    return Layout("lane", boundaries, (0.0,), oncoming, width, (-reach, left), False, tone)


def _campus(sampler: RandomSampler) -> Layout:
    """Samples a two-way road without any marking: on a campus or between houses."""
    width = sampler.uniform(4.0, 9.0)
    concrete = sampler.bernoulli(0.25)
    lane = width / 2.0
    paved = (-0.5 * lane, 1.5 * lane)
    layout = Layout("campus", (), (0.0,), (lane,), lane, paved, concrete, _tone(sampler, concrete=concrete))
    return layout.mirrored() if sampler.bernoulli(0.35) else layout


def _square(sampler: RandomSampler) -> Layout:
    """Samples a square or a car park, whose pavement has no edge nearby."""
    concrete = sampler.bernoulli(0.3)
    paved = (-PAVED_REACH, PAVED_REACH)
    return Layout("square", (), (0.0,), (), 3.5, paved, concrete, _tone(sampler, concrete=concrete))
