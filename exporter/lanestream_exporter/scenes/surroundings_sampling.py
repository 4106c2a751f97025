"""Sampling of the surroundings of a road: walls, trees, bridges, shadows, traffic, sky."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from lanestream_exporter.scenes.backdrop import Backdrop, Ridge
from lanestream_exporter.scenes.kerbs import Kerb
from lanestream_exporter.scenes.light import BandShadow, LineShadow, Shadow, TreeShadow
from lanestream_exporter.scenes.roadside import Bridge, ItemKind, RoadsideItem, Wall, WallKind
from lanestream_exporter.scenes.surface_sampling import gray
from lanestream_exporter.scenes.traffic import Vehicle, VehicleKind

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import Layout, RoadStyle
    from lanestream_exporter.scenes.random_sampler import RandomSampler
    from lanestream_exporter.scenes.surface import Color

LEAVES: tuple[Color, ...] = (
    (0.12, 0.27, 0.2),
    (0.1, 0.2, 0.17),
    (0.14, 0.32, 0.3),
    (0.18, 0.3, 0.36),
    (0.08, 0.17, 0.12),
)
BODIES: tuple[Color, ...] = (
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
WALL_HEIGHTS: dict[WallKind, tuple[float, float, float]] = {  # lowest, highest, distance from the pavement; meters
    "jersey": (0.8, 1.3, 0.0),
    "rail": (0.7, 0.85, 0.0),
    "fence": (0.9, 1.4, 1.5),
    "hedge": (0.8, 2.0, 1.2),
}
VEHICLES: dict[VehicleKind, float] = {"car": 0.68, "van": 0.18, "truck": 0.14}
VEHICLE_SIZES: dict[VehicleKind, tuple[float, float, float]] = {  # length, width, height; meters
    "car": (4.5, 1.8, 1.45),
    "van": (5.0, 1.95, 2.0),
    "truck": (11.0, 2.45, 3.6),
}
SPEEDS: dict[RoadStyle, float] = {
    "highway": 27.0,
    "country": 20.0,
    "street": 11.0,
    "lane": 10.0,
    "campus": 6.0,
    "square": 4.0,
}  # meters per second


KERB_PAINTS: tuple[tuple[Color, Color | None], ...] = (
    ((0.92, 0.94, 0.94), (0.08, 0.08, 0.08)),  # white and black
    ((0.2, 0.72, 0.9), (0.08, 0.08, 0.08)),  # yellow and black
    ((0.2, 0.18, 0.75), (0.92, 0.94, 0.94)),  # red and white
    ((0.92, 0.94, 0.94), None),
    ((0.2, 0.72, 0.9), None),
)
ROOM_TO_PASS: Final = 2.2  # meters between the middle of our lane and that of a parked vehicle
QUEUE_LENGTH: Final = 70.0  # of standing traffic, meters; what stands farther ahead is hidden


@dataclass(frozen=True)
class ShadowCasters:
    """Objects that cast shadows on the road: walls and bridges along `length` meters of it."""

    walls: tuple[Wall, ...]
    bridges: tuple[Bridge, ...]
    length: float


def sample_walls(sampler: RandomSampler, layout: Layout) -> tuple[Wall, ...]:
    """Samples barriers, rails, fences and hedges beyond the edges of the pavement, or right at them."""
    if layout.style in {"street", "square"}:
        return ()
    right, left = layout.paved
    highway = layout.style == "highway"
    kinds = HIGHWAY_WALLS if highway else OTHER_WALLS
    edges = ((left + sampler.uniform(0.0, 0.8), 1.0), (right - sampler.uniform(0.0, 1.2), -1.0))
    walls = [
        _wall(sampler, sampler.weighted_choice(kinds), u, outward)
        for u, outward in edges
        if sampler.bernoulli(0.75 if highway else 0.22)
    ]
    return tuple(_moved_to_the_edge(sampler.branch(), wall, layout) for wall in walls)


def _moved_to_the_edge(sampler: RandomSampler, wall: Wall, layout: Layout) -> Wall:
    """Moves some walls so that their foot is the edge of the pavement, and others beyond the sidewalk of a kerb."""
    left = wall.u > layout.paved[1] - 0.01
    edge, kind = (layout.paved[1], layout.edges[1]) if left else (layout.paved[0], layout.edges[0])
    if kind == "kerb":
        return replace(wall, u=wall.u + (1.0 if left else -1.0) * sampler.uniform(0.5, 4.0))
    return replace(wall, u=edge) if wall.kind in {"jersey", "hedge"} and sampler.bernoulli(0.4) else wall


def sample_kerbs(sampler: RandomSampler, layout: Layout) -> tuple[Kerb, ...]:
    """Samples the kerbs of a road, of bare stone or painted, plain or in blocks of two colors."""
    stone = gray(sampler, sampler.uniform(0.25, 0.8))
    color, other = (stone, None) if sampler.bernoulli(0.68) else sampler.choice(KERB_PAINTS)
    fade = sampler.uniform(0.55, 1.0)
    shade = sampler.uniform(0.5, 1.0)
    # A face that looks like the road would leave only the top to be seen.
    if other is None and abs(shade * sum(color) / 3.0 - layout.tone) < 0.08:
        shade *= 0.65
    height, width, block = sampler.uniform(0.08, 0.2), sampler.uniform(0.1, 0.3), sampler.uniform(0.5, 1.5)
    sides = ((layout.edges[1], layout.paved[1], 1.0), (layout.edges[0], layout.paved[0], -1.0))
    return tuple(
        Kerb(u, outward, height, width, _faded(color, fade), other and _faded(other, fade), block, shade)
        for edge, u, outward in sides
        if edge == "kerb"
    )


def _faded(color: Color, brightness: float) -> Color:
    return (color[0] * brightness, color[1] * brightness, color[2] * brightness)


def _wall(sampler: RandomSampler, kind: WallKind, u: float, outward: float) -> Wall:
    low, high, away = WALL_HEIGHTS[kind]
    # The face of a wall away from the sun is darker than the road.
    shade = sampler.uniform(0.2, 0.7) if sampler.bernoulli(0.45) else 1.0
    color = sampler.choice(LEAVES) if kind == "hedge" else gray(sampler, shade * sampler.uniform(0.4, 0.75))
    return Wall(kind, u + outward * away, sampler.uniform(low, high), color)


def sample_items(sampler: RandomSampler, layout: Layout, length: float) -> tuple[RoadsideItem, ...]:
    """Samples trees, posts, signs and houses along `length` meters of road."""
    items: list[RoadsideItem] = []
    woods = sampler.uniform(0.0, 0.12) if sampler.bernoulli(0.75) else 0.0
    woods *= 2.5 if layout.style == "campus" else 1.0
    if layout.style in {"street", "campus", "square"}:
        town = sampler.uniform(0.02, 0.06)
    else:
        town = 0.004 * float(sampler.bernoulli(0.25))
    for side, edge in ((1.0, layout.roadside[1]), (-1.0, -layout.roadside[0])):
        # The trees stand on the far side of the opposite roadway.
        margin = 16.0 if layout.opposite == side else 2.0 if layout.style == "campus" else 4.0
        trees = int(woods * length * sampler.uniform(0.2, 1.0))
        items += [_tree(sampler, length, side, edge + margin) for _ in range(trees)]
        items += [_house(sampler, length, side, edge + 12.0) for _ in range(int(town * length))]
        items += _posts(sampler, side, edge, length)
    return tuple(items)


def _tree(sampler: RandomSampler, length: float, side: float, away: float) -> RoadsideItem:
    u = side * (away + sampler.uniform(0.0, 26.0))
    s, color = sampler.uniform(0.0, length), sampler.choice(LEAVES)
    if sampler.bernoulli(0.7):
        tall = sampler.uniform(3.5, 15.0)
        return RoadsideItem("tree", s, u, tall, tall * sampler.uniform(0.7, 1.1), color, sampler.seed())
    tall = sampler.uniform(1.0, 2.5)
    return RoadsideItem("bush", s, u, tall, 1.6 * tall, color, sampler.seed())


def _house(sampler: RandomSampler, length: float, side: float, away: float) -> RoadsideItem:
    u = side * (away + sampler.uniform(0.0, 14.0))
    color = gray(sampler, sampler.uniform(0.3, 0.8))
    tint = sampler.uniform(0.75, 1.0)
    walls: Color = (color[0] * tint, color[1] * (0.5 + 0.5 * tint), color[2])
    return RoadsideItem(
        "house", sampler.uniform(20.0, length), u, sampler.uniform(3.0, 15.0), sampler.uniform(8.0, 18.0), walls, 0
    )


def _posts(sampler: RandomSampler, side: float, edge: float, length: float) -> list[RoadsideItem]:
    """Samples a row of posts or lamps, and a few signs."""
    items: list[RoadsideItem] = []
    if sampler.bernoulli(0.4):
        kind: ItemKind = "lamp" if sampler.bernoulli(0.5) else "post"
        spacing, away = sampler.uniform(18.0, 45.0), edge + sampler.uniform(1.2, 3.5)
        height = sampler.uniform(6.0, 10.0) if kind == "lamp" else sampler.choice((1.0, 1.0, 7.5))
        color = gray(sampler, sampler.uniform(0.2, 0.7))
        positions = [(k + 0.5) * spacing for k in range(int(length / spacing))]
        items = [RoadsideItem(kind, s, side * away, height, 0.2, color, 0) for s in positions]
    for _ in range(int(length / 150.0) + 1):
        if sampler.bernoulli(0.4):
            size, s = sampler.uniform(0.6, 2.5), sampler.uniform(15.0, length)
            items.append(
                RoadsideItem("sign", s, side * (edge + 2.0), 2.0 + size, size, (0.5, 0.5, 0.5), sampler.seed())
            )
    return items


def sample_bridges(sampler: RandomSampler, layout: Layout, length: float) -> tuple[Bridge, ...]:
    """Samples bridges and sign gantries over the road."""
    bridges = []
    probability = 0.22 if layout.style == "highway" else 0.04
    for start in range(0, max(1, int(length)), 250):
        if sampler.bernoulli(probability):
            deck = sampler.bernoulli(0.7)
            bridges.append(
                Bridge(
                    s=start + sampler.uniform(15.0, 220.0),
                    length=sampler.uniform(8.0, 25.0) if deck else 0.5,
                    clearance=sampler.uniform(5.0, 7.0),
                    depth=sampler.uniform(1.2, 2.2),
                    reach=max(layout.roadside[1], -layout.roadside[0]) + sampler.uniform(4.0, 20.0),
                    color=gray(sampler, sampler.uniform(0.4, 0.65)) if deck else (0.25, 0.35, 0.1),
                )
            )
    return tuple(bridges)


def sample_shadows(sampler: RandomSampler, layout: Layout, casters: ShadowCasters) -> tuple[Shadow, ...]:
    """Samples shadows on the road: of bridges, walls, trees, posts and houses."""
    slant = sampler.normal(0.7)
    shadows: list[Shadow] = [
        BandShadow(bridge.s + bridge.length / 2.0 + sampler.normal(5.0), bridge.length, 0.2 * slant)
        for bridge in casters.bridges
    ]
    for wall in casters.walls:
        if sampler.bernoulli(0.4):
            wide = sampler.uniform(0.3, 2.0)
            shadows.append(LineShadow(wall.u - math.copysign(wide / 2.0, wall.u), wide))
    if sampler.bernoulli(0.35):
        shadows += _tree_shadows(sampler, layout, casters.length)
    if sampler.bernoulli(0.2):
        spacing, wide = sampler.uniform(8.0, 40.0), sampler.uniform(0.15, 0.5)
        shadows += [BandShadow(k * spacing, wide, slant) for k in range(1, int(casters.length / spacing))]
    if sampler.bernoulli(0.08):
        shadows.append(BandShadow(sampler.uniform(0.0, 60.0), sampler.uniform(6.0, 40.0), slant))
    return tuple(shadows)


def _tree_shadows(sampler: RandomSampler, layout: Layout, length: float) -> list[Shadow]:
    """Samples tree shadows on one side of the road, in stretches."""
    side = sampler.choice((-1.0, 1.0))
    return [
        TreeShadow(
            s=start + sampler.uniform(-10.0, 30.0),
            length=sampler.uniform(8.0, 50.0),
            edge=sampler.uniform(*layout.roadside),
            side=side,
            density=sampler.uniform(0.3, 0.75),
            blotch=sampler.uniform(0.8, 5.0),
            slant=sampler.uniform(0.5, 2.0),
            seed=sampler.seed(),
        )
        for start in range(0, int(length), 60)
        if sampler.bernoulli(0.7)
    ]


def sample_traffic(sampler: RandomSampler, layout: Layout, start: float, length: float) -> tuple[Vehicle, ...]:
    """Samples vehicles in the lanes from s = `start`, at least 4 m apart, and parked vehicles."""
    vehicles: list[Vehicle] = []
    density = sampler.choice((0.0, 0.008, 0.015, 0.03))
    usual_speed = SPEEDS[layout.style]
    for lane in layout.ahead:
        first = start + (sampler.uniform(14.0, 60.0) if lane == 0.0 else sampler.uniform(2.0, 40.0))
        speed = usual_speed * sampler.uniform(0.9, 1.1)
        vehicles += _queue(sampler, lane, (first, start + length), density, speed)
    edge = layout.paved[1] if layout.opposite > 0.0 else layout.paved[0]
    opposite = [edge + layout.opposite * away for away in (4.0, 8.0)] if layout.opposite else []
    for lane in (*layout.oncoming, *opposite):
        vehicles += _queue(sampler, lane, (start + sampler.uniform(5.0, 60.0), start + length), density, -usual_speed)
    return (*vehicles, *_parked(sampler.branch(), layout, (start + 6.0, start + length)))


def _parked(sampler: RandomSampler, layout: Layout, reach: tuple[float, float]) -> list[Vehicle]:
    """Samples vehicles parked along either edge, some half on the sidewalk, or in rows on a square."""
    if layout.style == "square":
        rows = [side * sampler.uniform(5.0, 20.0) for side in (-1.0, 1.0, 1.0) if sampler.bernoulli(0.6)]
    else:
        share = {"street": 0.4, "campus": 0.2}.get(layout.style, 0.0)
        right, left = layout.paved
        rows = [
            edge - outward * sampler.uniform(-0.3, 1.2)
            for edge, outward in ((left, 1.0), (right, -1.0))
            if sampler.bernoulli(share)
        ]
    density = sampler.choice((0.03, 0.06, 0.3))
    vehicles: list[Vehicle] = []
    for row in rows:
        if abs(row) > ROOM_TO_PASS:
            vehicles += _queue(sampler, row, reach, density, 0.0)
    return vehicles


def sample_queues(sampler: RandomSampler, lanes: tuple[float, ...], start: float, length: float) -> tuple[Vehicle, ...]:
    """Samples standing traffic in the lanes from s = `start`, with gaps of 2 to 6 m."""
    vehicles: list[Vehicle] = []
    for lane in lanes:
        s = start + (sampler.uniform(6.0, 20.0) if lane == 0.0 else sampler.uniform(1.0, 9.0))
        while s < start + min(length, QUEUE_LENGTH):
            vehicle = sample_vehicle(sampler, s, lane + sampler.normal(0.15), 0.0)
            vehicles.append(vehicle)
            s += vehicle.length + sampler.uniform(2.0, 6.0)
    return tuple(vehicles)


def _queue(
    sampler: RandomSampler, lane: float, reach: tuple[float, float], density: float, speed: float
) -> list[Vehicle]:
    """Samples the vehicles of one lane, all at the same speed so that their gaps stay constant."""
    vehicles: list[Vehicle] = []
    s = reach[0]
    while density > 0.0 and s < reach[1]:
        vehicle = sample_vehicle(sampler, s, lane + sampler.normal(0.2), speed)
        vehicles.append(vehicle)
        s += vehicle.length + 4.0 + float(sampler.rng.exponential(1.0 / density))
    return vehicles


def sample_vehicle(sampler: RandomSampler, s: float, u: float, speed: float) -> Vehicle:
    """Samples one vehicle of a common size."""
    kind = sampler.weighted_choice(VEHICLES)
    length, width, height = VEHICLE_SIZES[kind]
    size = sampler.uniform(0.92, 1.08)
    return Vehicle(
        kind=kind,
        s=s,
        u=u,
        speed=speed,
        length=length * size,
        width=width * size,
        height=height * size,
        color=sampler.choice(BODIES),
        braking=sampler.bernoulli(0.15),
    )


def sample_backdrop(sampler: RandomSampler, *, night: bool, overcast: bool) -> Backdrop:
    """Samples the sky and the ridges on the horizon."""
    if overcast:
        level = sampler.uniform(0.6, 0.9)
        zenith: Color = (level, level, level * 0.98)
        skyline: Color = (level * 1.05, level * 1.04, level * 1.02)
    else:
        blue = sampler.uniform(0.6, 0.95)
        zenith = (blue, blue * sampler.uniform(0.66, 0.8), blue * sampler.uniform(0.3, 0.52))
        blue, pale = sampler.uniform(0.85, 1.0), sampler.uniform(0.88, 0.99)
        skyline = (blue, blue * pale, blue * pale**2)
    ridges = []
    if sampler.bernoulli(0.6):
        hills: Color = (sampler.uniform(0.3, 0.55), sampler.uniform(0.3, 0.45), sampler.uniform(0.25, 0.42))
        ridges.append(
            Ridge(sampler.uniform(0.02, 0.09), sampler.uniform(0.005, 0.03), 60.0, hills, 0.08, sampler.seed())
        )
    if sampler.bernoulli(0.85):
        tall = sampler.uniform(0.005, 0.06) if sampler.bernoulli(0.7) else sampler.uniform(0.06, 0.2)
        ridges.append(
            Ridge(
                tall,
                0.2 * tall,
                sampler.uniform(150.0, 600.0),
                sampler.choice(LEAVES),
                sampler.uniform(0.1, 0.3),
                sampler.seed(),
            )
        )
    clouds = sampler.uniform(0.1, 0.8) if sampler.bernoulli(0.5) and not night else 0.0
    return Backdrop(zenith, skyline, clouds, tuple(ridges), sampler.seed())
