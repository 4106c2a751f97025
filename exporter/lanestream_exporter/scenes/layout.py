"""Sampling of a road's cross-section: its lanes, boundaries, markings and paved width."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from lanestream_exporter.scenes.road import Boundary, Marking, MarkingKind, PaintColor, Stripe

if TYPE_CHECKING:
    from lanestream_exporter.scenes.random_sampler import RandomSampler

RoadStyle = Literal["highway", "country", "street", "lane"]

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

# How often each kind of marking is used, by its place on the road.
LANE_DIVIDER: dict[MarkingKind, float] = {"dashed": 0.65, "botts": 0.32, "solid": 0.03}
MEDIAN: dict[MarkingKind, float] = {"solid": 0.93, "double": 0.07}
AMERICAN_CENTER: dict[MarkingKind, float] = {"double": 0.6, "dashed": 0.25, "solid": 0.15}
EUROPEAN_CENTER: dict[MarkingKind, float] = {"dashed": 0.6, "solid": 0.3, "double": 0.1}
STREET_CENTER: dict[MarkingKind, float] = {"double": 0.5, "solid": 0.25, "dashed": 0.25}
ROAD_SIDE: dict[MarkingKind | None, float] = {"solid": 0.72, None: 0.2, "dashed": 0.08}
BROKEN_STRIPE: dict[Stripe, float] = {"neither": 0.75, "left": 0.13, "right": 0.12}
PAINT_COLORS: tuple[PaintColor, ...] = ("yellow", "white")
MIXED_DIVIDER_SHARE = 0.08  # share of highways whose lane dividers are of several kinds


@dataclass(frozen=True)
class Layout:
    """A road's cross-section. Lateral positions u in meters, left positive; the center of the ego lane is u = 0."""

    style: RoadStyle
    boundaries: tuple[Boundary, ...]
    ahead: tuple[float, ...]  # centers of the lanes in our direction
    oncoming: tuple[float, ...]  # centers of the oncoming lanes
    lane_width: float
    paved: tuple[float, float]  # right and left edge of the pavement
    concrete: bool
    tone: float  # brightness of the driving surface
    opposite: float = 0.0  # another roadway beyond the left edge (+1) or the right edge (-1); 0 for neither

    def mirrored(self) -> Layout:
        """Returns the same road for left-hand traffic."""
        flipped = []
        for boundary in reversed(self.boundaries):
            marking = boundary.marking
            if marking and marking.broken != "neither":
                marking = replace(marking, broken="right" if marking.broken == "left" else "left")
            flipped.append(Boundary(-boundary.u, marking))
        return replace(
            self,
            boundaries=tuple(flipped),
            ahead=tuple(-u for u in self.ahead),
            oncoming=tuple(-u for u in self.oncoming),
            paved=(-self.paved[1], -self.paved[0]),
            opposite=-self.opposite,
        )


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

    def line(self, kind: MarkingKind, color: PaintColor) -> Marking:
        """Returns a marking of this kind, slightly different from the road's other markings."""
        sampler = self.sampler
        common = Marking(
            kind=kind,
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
        if kind == "botts":
            return self._dots(common)
        if kind == "double":
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
    maker = {"highway": _highway, "country": _country, "street": _street, "lane": _bare_lane}[style]
    layout = maker(sampler)
    return layout.mirrored() if sampler.bernoulli(0.12) else layout


def _tone(sampler: RandomSampler, *, concrete: bool) -> float:
    return sampler.uniform(0.42, 0.64) if concrete else sampler.uniform(0.22, 0.5)


def _highway(sampler: RandomSampler) -> Layout:
    lanes, width = sampler.weighted_choice({2: 0.3, 3: 0.3, 4: 0.27, 5: 0.13}), sampler.uniform(3.35, 3.9)
    ego = sampler.integer(0, lanes - 1)
    concrete = sampler.bernoulli(0.45)
    tone = _tone(sampler, concrete=concrete)
    paint = _Painter.for_road(sampler, tone)
    mixed, usual_kind = sampler.bernoulli(MIXED_DIVIDER_SHARE), sampler.weighted_choice(LANE_DIVIDER)
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
            marking = paint.line(sampler.weighted_choice(LANE_DIVIDER) if mixed else usual_kind, "white")
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
    sides = []
    for u, outward in ((1.5 * width, 1.0), (-0.5 * width, -1.0)):
        if side is None:
            sides.append(Boundary(u + outward * shoulder * 0.3, None))
        else:
            sides.append(Boundary(u, paint.line(side, "white")))
    boundaries = (sides[0], Boundary(0.5 * width, center), sides[1])
    margin = 0.0 if side is None else shoulder
    paved = (sides[1].u - margin, sides[0].u + margin)
    return Layout("country", boundaries, (0.0,), (width,), width, paved, False, tone)


def _street(sampler: RandomSampler) -> Layout:
    """Samples a street between curbs; sides without paint have no label either."""
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
    if sampler.bernoulli(0.6):
        boundaries.append(Boundary(left - lanes * width, paint.line("solid", "white")))
    parking = sampler.choice((0.4, 0.8, 2.4))
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
    boundaries = [Boundary(left, None), Boundary(-reach, None)]
    if two_way and sampler.bernoulli(0.5):
        boundaries.insert(1, Boundary(0.5 * width, paint.line("dashed", sampler.choice(PAINT_COLORS))))
    oncoming = (width,) if two_way else ()
    return Layout("lane", tuple(boundaries), (0.0,), oncoming, width, (-reach, left), False, tone)
