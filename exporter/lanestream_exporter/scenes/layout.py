"""Sampling the cross-section of a road: its lanes, boundaries and paved width."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from lanestream_exporter.scenes.road import Boundary, Marking, MarkingKind, PaintColour, Stripe

if TYPE_CHECKING:
    from lanestream_exporter.scenes.random_sampler import RandomSampler

Style = Literal["highway", "country", "street", "lane"]

# Metres of period and of dash, as painted in different countries and cities.
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

# How often each marking stands where.
BETWEEN_LANES: dict[MarkingKind, float] = {"dashed": 0.65, "botts": 0.32, "solid": 0.03}
MEDIAN: dict[MarkingKind, float] = {"solid": 0.93, "double": 0.07}
AMERICAN_CENTRE: dict[MarkingKind, float] = {"double": 0.6, "dashed": 0.25, "solid": 0.15}
EUROPEAN_CENTRE: dict[MarkingKind, float] = {"dashed": 0.6, "solid": 0.3, "double": 0.1}
STREET_CENTRE: dict[MarkingKind, float] = {"double": 0.5, "solid": 0.25, "dashed": 0.25}
ROAD_SIDE: dict[MarkingKind | None, float] = {"solid": 0.72, None: 0.2, "dashed": 0.08}
BROKEN_STRIPE: dict[Stripe, float] = {"neither": 0.75, "left": 0.13, "right": 0.12}
COLOURS: tuple[PaintColour, ...] = ("yellow", "white")
MIXED_SHARE = 0.08  # of motorways, whose lanes are divided by markings of several kinds


@dataclass(frozen=True)
class Layout:
    """A road's cross-section. Lateral positions u in metres, left positive; the ego lane's middle is u = 0."""

    style: Style
    boundaries: tuple[Boundary, ...]
    ahead: tuple[float, ...]  # middles of the lanes in our direction
    oncoming: tuple[float, ...]  # middles of the lanes towards us
    lane_width: float
    paved: tuple[float, float]  # right and left edge of the pavement
    concrete: bool
    tone: float  # brightness of the driving surface
    opposite: float = 0.0  # +1 where another carriageway lies beyond the left edge, -1 the right, 0 neither

    def mirrored(self) -> Layout:
        """The same road where people drive on the left."""
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
    """Makes the markings of one road, which share their paint, age and dash pattern."""

    dice: RandomSampler
    tone: float
    period: float
    dash: float
    phase: float
    wear: float
    brightness: float
    width: float

    @classmethod
    def of(cls, dice: RandomSampler, tone: float) -> _Painter:
        """A painter for a road whose surface has this brightness."""
        period, dash = dice.pick(DASHES)
        faint = dice.chance(0.4)  # old paint on pale concrete is only a little lighter than the road
        brightness = min(0.98, tone + (dice.between(0.09, 0.22) if faint else dice.between(0.2, 0.6)))
        wear = dice.between(0.0, 0.25) if dice.chance(0.5) else dice.between(0.2, 0.78)
        return cls(dice, tone, period, dash, dice.between(0.0, period), wear, brightness, dice.between(0.1, 0.2))

    def line(self, kind: MarkingKind, color: PaintColour) -> Marking:
        """A marking of this kind, a little different from the road's others."""
        dice = self.dice
        common = Marking(
            kind=kind,
            color=color,
            width=min(0.3, self.width * dice.between(0.9, 1.4)),
            brightness=min(0.98, max(self.tone + 0.07, self.brightness + dice.around(0.04))),
            wear=min(0.8, max(0.0, self.wear + dice.around(0.08))),
            period=self.period,
            dash=self.dash,
            phase=self.phase + dice.around(0.3),
            gap=dice.between(0.09, 0.2),
            seed=dice.seed(),
        )
        if kind == "botts":
            return self._dotted(common)
        if kind == "double":
            return replace(common, width=min(0.15, common.width), broken=dice.weighed(BROKEN_STRIPE))
        return common

    def _dotted(self, common: Marking) -> Marking:
        """Dots in groups, or evenly spaced; some are missing."""
        dice = self.dice
        spacing = dice.between(0.9, 1.6)
        dots = dice.pick((1, 3, 4, 4, 5))
        return replace(
            common,
            width=dice.between(0.1, 0.15),
            dots=dots,
            dash=spacing * (dots - 1),
            period=dice.between(2.0, 7.3) if dots == 1 else max(self.period, spacing * dots + 2.0),
            wear=dice.between(0.0, 0.45),
            brightness=min(1.0, common.brightness + dice.between(0.0, 0.15)),
        )


def sample_layout(dice: RandomSampler, style: Style) -> Layout:
    """A cross-section of the given style; one in eight for driving on the left."""
    maker = {"highway": _highway, "country": _country, "street": _street, "lane": _bare_lane}[style]
    layout = maker(dice)
    return layout.mirrored() if dice.chance(0.12) else layout


def _tone(dice: RandomSampler, *, concrete: bool) -> float:
    return dice.between(0.42, 0.64) if concrete else dice.between(0.22, 0.5)


def _highway(dice: RandomSampler) -> Layout:
    lanes, width = dice.weighed({2: 0.3, 3: 0.3, 4: 0.27, 5: 0.13}), dice.between(3.35, 3.9)
    ego = dice.whole(0, lanes - 1)
    concrete = dice.chance(0.45)
    tone = _tone(dice, concrete=concrete)
    paint = _Painter.of(dice, tone)
    mixed, between = dice.chance(MIXED_SHARE), dice.weighed(BETWEEN_LANES)
    boundaries = []
    for index in range(lanes + 1):
        u = (ego + 0.5 - index) * width
        if index == 0:
            marking = paint.line(dice.weighed(MEDIAN), dice.weighed({"yellow": 0.65, "white": 0.35}))
        elif index == lanes:
            marking = paint.line("solid", "white")
        elif index == 1 and lanes > 2 and dice.chance(0.07):
            marking = paint.line("double", dice.pick(COLOURS))
        else:
            marking = paint.line(dice.weighed(BETWEEN_LANES) if mixed else between, "white")
        boundaries.append(Boundary(u, marking))
    left, right = dice.between(0.4, 3.2), dice.between(0.6, 3.6)
    paved = (boundaries[-1].u - right, boundaries[0].u + left)
    ahead = tuple((ego - index) * width for index in range(lanes))
    return Layout("highway", tuple(boundaries), ahead, (), width, paved, concrete, tone, float(dice.chance(0.7)))


def _country(dice: RandomSampler) -> Layout:
    width = dice.between(2.8, 3.7)
    tone = _tone(dice, concrete=False)
    paint = _Painter.of(dice, tone)
    american = dice.chance(0.6)
    centre = paint.line(
        dice.weighed(AMERICAN_CENTRE if american else EUROPEAN_CENTRE), "yellow" if american else "white"
    )
    side = dice.weighed(ROAD_SIDE)
    shoulder = dice.between(0.15, 1.2)
    sides = []
    for u, outwards in ((1.5 * width, 1.0), (-0.5 * width, -1.0)):
        if side is None:
            sides.append(Boundary(u + outwards * shoulder * 0.3, None))
        else:
            sides.append(Boundary(u, paint.line(side, "white")))
    boundaries = (sides[0], Boundary(0.5 * width, centre), sides[1])
    margin = 0.0 if side is None else shoulder
    paved = (sides[1].u - margin, sides[0].u + margin)
    return Layout("country", boundaries, (0.0,), (width,), width, paved, False, tone)


def _street(dice: RandomSampler) -> Layout:
    """A street between kerbs; where its sides carry no paint they carry no label either."""
    width, lanes = dice.between(2.8, 3.5), dice.whole(1, 3)
    towards = dice.pick((0, 1, 1, 2))
    concrete = dice.chance(0.12)
    tone = _tone(dice, concrete=concrete)
    paint = _Painter.of(dice, tone)
    ego = dice.whole(0, lanes - 1)
    left = (ego + 0.5) * width
    boundaries = []
    if towards:
        if dice.chance(0.5):
            far = paint.line("solid", "white")
            boundaries.append(Boundary(left + towards * width, far))
        boundaries += [Boundary(left + (towards - k) * width, paint.line("dashed", "white")) for k in range(1, towards)]
        boundaries.append(Boundary(left, paint.line(dice.weighed(STREET_CENTRE), dice.pick(COLOURS))))
    elif dice.chance(0.6):
        boundaries.append(Boundary(left, paint.line("solid", dice.pick(COLOURS))))
    boundaries += [Boundary(left - k * width, paint.line("dashed", "white")) for k in range(1, lanes)]
    if dice.chance(0.6):
        boundaries.append(Boundary(left - lanes * width, paint.line("solid", "white")))
    parking = dice.pick((0.4, 0.8, 2.4))
    paved = (left - lanes * width - parking, left + towards * width + dice.pick((0.4, 2.4)))
    ahead = tuple(left - (k + 0.5) * width for k in range(lanes))
    oncoming = tuple(left + (k + 0.5) * width for k in range(towards))
    return Layout("street", tuple(boundaries), ahead, oncoming, width, paved, concrete, tone)


def _bare_lane(dice: RandomSampler) -> Layout:
    """A small road whose edges are its boundaries, now and then with a painted middle."""
    width = dice.between(2.6, 3.4)
    tone = _tone(dice, concrete=dice.chance(0.15))
    paint = _Painter.of(dice, tone)
    two_way = dice.chance(0.55)
    reach = dice.between(0.55, 0.7) * width
    left = 1.5 * width if two_way else reach
    boundaries = [Boundary(left, None), Boundary(-reach, None)]
    if two_way and dice.chance(0.5):
        boundaries.insert(1, Boundary(0.5 * width, paint.line("dashed", dice.pick(COLOURS))))
    oncoming = (width,) if two_way else ()
    return Layout("lane", tuple(boundaries), (0.0,), oncoming, width, (-reach, left), False, tone)
