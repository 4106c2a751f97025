"""Sampling what stands around the road: walls, trees, bridges, traffic, sky."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lanestream_exporter.scenes.backdrop import Backdrop, Ridge
from lanestream_exporter.scenes.ground import grey
from lanestream_exporter.scenes.light import BandShadow, LineShadow, Shadow, TreeShadow
from lanestream_exporter.scenes.roadside import Bridge, Item, ItemKind, Wall, WallKind
from lanestream_exporter.scenes.traffic import Vehicle, VehicleKind

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import Layout, Style
    from lanestream_exporter.scenes.random_sampler import RandomSampler
    from lanestream_exporter.scenes.surface import Colour

LEAVES: tuple[Colour, ...] = (
    (0.12, 0.27, 0.2),
    (0.1, 0.2, 0.17),
    (0.14, 0.32, 0.3),
    (0.18, 0.3, 0.36),
    (0.08, 0.17, 0.12),
)
BODIES: tuple[Colour, ...] = (
    (0.85, 0.86, 0.86),
    (0.6, 0.6, 0.58),
    (0.1, 0.1, 0.1),
    (0.25, 0.25, 0.25),
    (0.15, 0.12, 0.5),
    (0.5, 0.3, 0.12),
    (0.35, 0.45, 0.5),
)

HIGHWAY_WALLS: dict[WallKind, float] = {"jersey": 0.5, "rail": 0.5}
OTHER_WALLS: dict[WallKind, float] = {"rail": 0.5, "fence": 0.3, "hedge": 0.2}
WALL_HEIGHTS: dict[WallKind, tuple[float, float, float]] = {  # lowest, highest, and how far off the pavement; metres
    "jersey": (0.8, 1.3, 0.0),
    "rail": (0.7, 0.85, 0.0),
    "fence": (0.9, 1.4, 1.5),
    "hedge": (0.8, 2.0, 1.2),
}
VEHICLES: dict[VehicleKind, float] = {"car": 0.68, "van": 0.18, "truck": 0.14}
VEHICLE_SIZES: dict[VehicleKind, tuple[float, float, float]] = {  # length, width, height; metres
    "car": (4.5, 1.8, 1.45),
    "van": (5.0, 1.95, 2.0),
    "truck": (11.0, 2.45, 3.6),
}
SPEEDS: dict[Style, float] = {"highway": 27.0, "country": 20.0, "street": 11.0, "lane": 10.0}  # metres a second


@dataclass(frozen=True)
class Stage:
    """What throws shadows on the road: walls and bridges on `length` metres of it."""

    walls: tuple[Wall, ...]
    bridges: tuple[Bridge, ...]
    length: float


def sample_walls(dice: RandomSampler, layout: Layout) -> tuple[Wall, ...]:
    """Barriers, rails and kerbs at the edges of the pavement."""
    right, left = layout.paved
    if layout.style == "street":
        colour, height = grey(dice, dice.between(0.45, 0.8)), dice.between(0.1, 0.16)
        return (Wall("kerb", left, height, colour), Wall("kerb", right, height, colour))
    highway = layout.style == "highway"
    kinds = HIGHWAY_WALLS if highway else OTHER_WALLS
    places = ((left + dice.between(0.0, 0.8), 1.0), (right - dice.between(0.0, 1.2), -1.0))
    return tuple(
        _wall(dice, dice.weighed(kinds), u, outwards)
        for u, outwards in places
        if dice.chance(0.75 if highway else 0.22)
    )


def _wall(dice: RandomSampler, kind: WallKind, u: float, outwards: float) -> Wall:
    low, high, away = WALL_HEIGHTS[kind]
    # The face of a wall away from the sun is darker than the road.
    shade = dice.between(0.2, 0.7) if dice.chance(0.45) else 1.0
    colour = dice.pick(LEAVES) if kind == "hedge" else grey(dice, shade * dice.between(0.4, 0.75))
    return Wall(kind, u + outwards * away, dice.between(low, high), colour)


def sample_items(dice: RandomSampler, layout: Layout, length: float) -> tuple[Item, ...]:
    """Trees, posts, signs and houses along `length` metres of road."""
    items: list[Item] = []
    woods = dice.between(0.0, 0.12) if dice.chance(0.75) else 0.0
    town = dice.between(0.02, 0.06) if layout.style == "street" else 0.004 * float(dice.chance(0.25))
    for side, edge in ((1.0, layout.paved[1]), (-1.0, -layout.paved[0])):
        # The other carriageway lies between us and the trees on its far side.
        margin = 16.0 if layout.opposite == side else 4.0
        trees = int(woods * length * dice.between(0.2, 1.0))
        items += [_tree(dice, length, side, edge + margin) for _ in range(trees)]
        items += [_house(dice, length, side, edge + 12.0) for _ in range(int(town * length))]
        items += _posts(dice, side, edge, length)
    return tuple(items)


def _tree(dice: RandomSampler, length: float, side: float, away: float) -> Item:
    u = side * (away + dice.between(0.0, 26.0))
    s, colour = dice.between(0.0, length), dice.pick(LEAVES)
    if dice.chance(0.7):
        tall = dice.between(3.5, 15.0)
        return Item("tree", s, u, tall, tall * dice.between(0.7, 1.1), colour, dice.seed())
    tall = dice.between(1.0, 2.5)
    return Item("bush", s, u, tall, 1.6 * tall, colour, dice.seed())


def _house(dice: RandomSampler, length: float, side: float, away: float) -> Item:
    u = side * (away + dice.between(0.0, 14.0))
    colour = grey(dice, dice.between(0.3, 0.8))
    tint = dice.between(0.75, 1.0)
    walls: Colour = (colour[0] * tint, colour[1] * (0.5 + 0.5 * tint), colour[2])
    return Item("house", dice.between(20.0, length), u, dice.between(3.0, 15.0), dice.between(8.0, 18.0), walls, 0)


def _posts(dice: RandomSampler, side: float, edge: float, length: float) -> list[Item]:
    """A row of posts or lamps, and a few signs."""
    items: list[Item] = []
    if dice.chance(0.4):
        kind: ItemKind = "lamp" if dice.chance(0.5) else "post"
        spacing, away = dice.between(18.0, 45.0), edge + dice.between(1.2, 3.5)
        height = dice.between(6.0, 10.0) if kind == "lamp" else dice.pick((1.0, 1.0, 7.5))
        colour = grey(dice, dice.between(0.2, 0.7))
        places = [(k + 0.5) * spacing for k in range(int(length / spacing))]
        items = [Item(kind, place, side * away, height, 0.2, colour, 0) for place in places]
    for _ in range(int(length / 150.0) + 1):
        if dice.chance(0.4):
            size, place = dice.between(0.6, 2.5), dice.between(15.0, length)
            items.append(Item("sign", place, side * (edge + 2.0), 2.0 + size, size, (0.5, 0.5, 0.5), dice.seed()))
    return items


def sample_bridges(dice: RandomSampler, layout: Layout, length: float) -> tuple[Bridge, ...]:
    """Bridges and sign gantries over the road."""
    bridges = []
    chance = 0.22 if layout.style == "highway" else 0.04
    for start in range(0, max(1, int(length)), 250):
        if dice.chance(chance):
            deck = dice.chance(0.7)
            bridges.append(
                Bridge(
                    s=start + dice.between(15.0, 220.0),
                    length=dice.between(8.0, 25.0) if deck else 0.5,
                    clearance=dice.between(5.0, 7.0),
                    depth=dice.between(1.2, 2.2),
                    reach=max(layout.paved[1], -layout.paved[0]) + dice.between(4.0, 20.0),
                    color=grey(dice, dice.between(0.4, 0.65)) if deck else (0.25, 0.35, 0.1),
                )
            )
    return tuple(bridges)


def sample_shadows(dice: RandomSampler, layout: Layout, stage: Stage) -> tuple[Shadow, ...]:
    """Shadows on the road: of bridges, walls, trees, posts and houses."""
    lean = dice.around(0.7)
    shadows: list[Shadow] = [
        BandShadow(bridge.s + bridge.length / 2.0 + dice.around(5.0), bridge.length, 0.2 * lean)
        for bridge in stage.bridges
    ]
    for wall in stage.walls:
        if wall.kind != "kerb" and dice.chance(0.4):
            wide = dice.between(0.3, 2.0)
            shadows.append(LineShadow(wall.u - math.copysign(wide / 2.0, wall.u), wide))
    if dice.chance(0.35):
        shadows += _tree_shadows(dice, layout, stage.length)
    if dice.chance(0.2):
        spacing, wide = dice.between(8.0, 40.0), dice.between(0.15, 0.5)
        shadows += [BandShadow(k * spacing, wide, lean) for k in range(1, int(stage.length / spacing))]
    if dice.chance(0.08):
        shadows.append(BandShadow(dice.between(0.0, 60.0), dice.between(6.0, 40.0), lean))
    return tuple(shadows)


def _tree_shadows(dice: RandomSampler, layout: Layout, length: float) -> list[Shadow]:
    """Shade of trees on one side of the road, in stretches."""
    side = dice.pick((-1.0, 1.0))
    return [
        TreeShadow(
            s=start + dice.between(-10.0, 30.0),
            length=dice.between(8.0, 50.0),
            edge=dice.between(*layout.paved),
            side=side,
            density=dice.between(0.3, 0.75),
            blotch=dice.between(0.8, 5.0),
            slant=dice.between(0.5, 2.0),
            seed=dice.seed(),
        )
        for start in range(0, int(length), 60)
        if dice.chance(0.7)
    ]


def sample_traffic(dice: RandomSampler, layout: Layout, start: float, length: float) -> tuple[Vehicle, ...]:
    """Vehicles in the lanes from `start` on, at least a few car lengths apart, and parked ones in streets."""
    vehicles: list[Vehicle] = []
    density = dice.pick((0.0, 0.008, 0.015, 0.03))
    fast = SPEEDS[layout.style]
    for lane in layout.ahead:
        first = start + (dice.between(14.0, 60.0) if lane == 0.0 else dice.between(2.0, 40.0))
        speed = fast * dice.between(0.9, 1.1)
        vehicles += _queue(dice, lane, (first, start + length), density, speed)
    edge = layout.paved[1] if layout.opposite > 0.0 else layout.paved[0]
    far = [edge + layout.opposite * away for away in (4.0, 8.0)] if layout.opposite else []
    for lane in (*layout.oncoming, *far):
        vehicles += _queue(dice, lane, (start + dice.between(5.0, 60.0), start + length), density, -fast)
    if layout.style == "street" and dice.chance(0.5):
        vehicles += _queue(dice, layout.paved[0] + 1.1, (start + 6.0, start + length), 0.06, 0.0)
    return tuple(vehicles)


def _queue(dice: RandomSampler, lane: float, reach: tuple[float, float], density: float, speed: float) -> list[Vehicle]:
    """Vehicles of one lane, which all go at the same speed and so keep their distances."""
    vehicles: list[Vehicle] = []
    s = reach[0]
    while density > 0.0 and s < reach[1]:
        vehicle = sample_vehicle(dice, s, lane + dice.around(0.2), speed)
        vehicles.append(vehicle)
        s += vehicle.length + 4.0 + float(dice.rng.exponential(1.0 / density))
    return vehicles


def sample_vehicle(dice: RandomSampler, s: float, u: float, speed: float) -> Vehicle:
    """One vehicle of a usual size."""
    kind = dice.weighed(VEHICLES)
    length, width, height = VEHICLE_SIZES[kind]
    size = dice.between(0.92, 1.08)
    return Vehicle(
        kind=kind,
        s=s,
        u=u,
        speed=speed,
        length=length * size,
        width=width * size,
        height=height * size,
        color=dice.pick(BODIES),
        braking=dice.chance(0.15),
    )


def sample_backdrop(dice: RandomSampler, *, night: bool, dull: bool) -> Backdrop:
    """Sky and horizon."""
    if dull:
        level = dice.between(0.6, 0.9)
        zenith: Colour = (level, level, level * 0.98)
        skyline: Colour = (level * 1.05, level * 1.04, level * 1.02)
    else:
        blue = dice.between(0.6, 0.95)
        zenith = (blue, blue * dice.between(0.66, 0.8), blue * dice.between(0.3, 0.52))
        blue, pale = dice.between(0.85, 1.0), dice.between(0.88, 0.99)
        skyline = (blue, blue * pale, blue * pale**2)
    ridges = []
    if dice.chance(0.6):
        hills: Colour = (dice.between(0.3, 0.55), dice.between(0.3, 0.45), dice.between(0.25, 0.42))
        ridges.append(Ridge(dice.between(0.02, 0.09), dice.between(0.005, 0.03), 60.0, hills, 0.08, dice.seed()))
    if dice.chance(0.85):
        tall = dice.between(0.005, 0.06) if dice.chance(0.7) else dice.between(0.06, 0.2)
        ridges.append(
            Ridge(tall, 0.2 * tall, dice.between(150.0, 600.0), dice.pick(LEAVES), dice.between(0.1, 0.3), dice.seed())
        )
    clouds = dice.between(0.1, 0.8) if dice.chance(0.5) and not night else 0.0
    return Backdrop(zenith, skyline, clouds, tuple(ridges), dice.seed())
