"""Sampling what lies on the ground: pavement, its flaws, and paint that is no lane boundary."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lanestream_exporter.scenes.markings import Bars, Ghost, Paintwork, Stencil
from lanestream_exporter.scenes.road import Marking
from lanestream_exporter.scenes.surface import Colour, Joint, Material, Patch, Seam, Surface, Track

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import Layout
    from lanestream_exporter.scenes.random_sampler import RandomSampler

VERGES: dict[str, Colour] = {
    "grass": (0.16, 0.38, 0.29),
    "meadow": (0.16, 0.41, 0.32),
    "dry grass": (0.3, 0.46, 0.52),
    "sand": (0.42, 0.54, 0.62),
    "gravel": (0.4, 0.43, 0.45),
    "earth": (0.2, 0.27, 0.34),
}
WORDS = ("SLOW", "STOP", "BUS", "ONLY", "50", "30", "SCHOOL", "XING", "^", "^", "<", ">")


def grey(dice: RandomSampler, tone: float) -> Colour:
    """A grey of this brightness with a slight cast."""
    warm = dice.around(0.025)
    return (tone * (1.0 - warm), tone * (1.0 + dice.around(0.01)), tone * (1.0 + warm))


def sample_surface(dice: RandomSampler, layout: Layout) -> Surface:
    """A ground for the road: materials, wear and flaws."""
    clean = dice.between(0.4, 1.3)
    asphalt = not layout.concrete
    return Surface(
        materials=_materials(dice, layout),
        tracks=_tracks(dice, layout),
        seams=_seams(dice, layout),
        joints=_joints(dice, layout),
        patches=(),
        grain=dice.between(0.02, 0.09) if asphalt else dice.between(0.01, 0.05),
        mottle=clean * dice.between(0.02, 0.06),
        streaks=clean * dice.between(0.02, 0.06),
        cracks=dice.between(0.15, 0.6) if asphalt and dice.chance(0.2) else 0.0,
        pits=dice.between(0.2, 0.8) if dice.chance(0.45) else 0.0,
        seed=dice.seed(),
    )


def _materials(dice: RandomSampler, layout: Layout) -> tuple[Material, ...]:
    right, left = layout.paved
    verges = [dice.pick(list(VERGES)) for _ in range(2)]
    if dice.chance(0.6):
        verges[1] = verges[0]
    light = dice.between(0.7, 1.2)
    parts = []
    for verge, low, high in ((verges[0], left, 70.0), (verges[1], -70.0, right)):
        blue, green, red = VERGES[verge]
        parts.append(Material(low, high, (blue * light, green * light, red * light), dice.between(2.5, 5.0)))
    if layout.style == "street":
        pavement = grey(dice, dice.between(0.4, 0.65))
        parts += [Material(left, left + 3.0, pavement, 0.7), Material(right - 3.0, right, pavement, 0.7)]
    elif dice.chance(0.5):
        gravel = grey(dice, dice.between(0.35, 0.55))
        width = dice.between(0.3, 2.0)
        parts += [Material(left, left + width, gravel, 2.5), Material(right - width, right, gravel, 2.5)]
    if layout.opposite > 0.0:
        parts.append(Material(left + 1.0, left + 14.0, grey(dice, layout.tone), 1.0))
    elif layout.opposite < 0.0:
        parts.append(Material(right - 14.0, right - 1.0, grey(dice, layout.tone), 1.0))
    shoulder = grey(dice, _other_tone(dice, layout)) if dice.chance(0.55) else grey(dice, layout.tone)
    parts.append(Material(right, left, shoulder, 1.2))
    parts += _lanes(dice, layout)
    return tuple(parts)


def _other_tone(dice: RandomSampler, layout: Layout) -> float:
    """The brightness of pavement laid at another time or of another kind."""
    if layout.concrete and dice.chance(0.7):
        return dice.between(0.2, 0.4)
    return min(0.65, max(0.16, layout.tone * dice.between(0.65, 1.4)))


def _lanes(dice: RandomSampler, layout: Layout) -> list[Material]:
    """Lanes of one tone, or of several where lanes were laid or resurfaced one by one."""
    base, uneven = grey(dice, layout.tone), dice.chance(0.35)
    parts = []
    for middle in (*layout.ahead, *layout.oncoming):
        colour = grey(dice, layout.tone * dice.between(0.8, 1.2)) if uneven else base
        if dice.chance(0.06):
            colour = grey(dice, _other_tone(dice, layout))
        half = layout.lane_width / 2.0 + (0.12 if dice.chance(0.5) else dice.around(0.1))
        low, high = max(layout.paved[0], middle - half), min(layout.paved[1], middle + half)
        parts.append(Material(low, high, colour, 1.0))
    return parts


def _tracks(dice: RandomSampler, layout: Layout) -> tuple[Track, ...]:
    """Two wheel tracks and an oil stripe in every lane."""
    wheels = dice.between(-0.08, 0.16)
    oil = dice.between(-0.04, 0.22) if dice.chance(0.6) else 0.0
    tracks = []
    for middle in (*layout.ahead, *layout.oncoming):
        drift = dice.around(0.15)
        gauge = dice.between(0.72, 0.9)
        width = dice.between(0.16, 0.34)
        tracks += [Track(middle + drift + side * gauge, width, wheels * dice.between(0.6, 1.3)) for side in (-1.0, 1.0)]
        tracks.append(Track(middle + drift, dice.between(0.2, 0.5), oil))
    return tuple(tracks)


def _seams(dice: RandomSampler, layout: Layout) -> tuple[Seam, ...]:
    """Lines along the road that a detector must learn to leave alone."""
    seams: list[Seam] = []
    spots = [boundary.u + dice.pick((-1.0, 1.0)) * dice.between(0.12, 0.45) for boundary in layout.boundaries]
    spots += [middle + dice.around(0.5) for middle in layout.ahead]
    if layout.concrete:
        offset = dice.around(0.15)
        edges = [boundary.u + offset for boundary in layout.boundaries]
        seams = [Seam(edge, dice.between(0.015, 0.05), dice.between(0.2, 0.6)) for edge in edges]
    for spot in spots:
        if dice.chance(0.22):
            tar = dice.chance(0.7)
            seams.append(
                Seam(
                    u=spot,
                    width=dice.between(0.03, 0.16) if tar else dice.between(0.02, 0.06),
                    depth=dice.between(0.25, 0.75) if tar else dice.between(-0.35, 0.4),
                    wander=dice.between(0.0, 0.07) if dice.chance(0.6) else 0.0,
                    breaks=dice.between(0.2, 0.8) if dice.chance(0.4) else 0.0,
                    seed=dice.seed(),
                )
            )
    return tuple(seams)


def _joints(dice: RandomSampler, layout: Layout) -> tuple[Joint, ...]:
    right, left = layout.paved
    if layout.concrete:
        return (Joint(right, left, dice.between(4.0, 6.5), dice.between(0.01, 0.03), dice.between(0.25, 0.7)),)
    if dice.chance(0.12):
        return (Joint(right, left, dice.between(7.0, 18.0), dice.between(0.02, 0.09), dice.between(0.2, 0.6)),)
    return ()


def sample_patches(dice: RandomSampler, layout: Layout, length: float) -> tuple[Patch, ...]:
    """Repairs, and now and then a whole stretch of other pavement, on `length` metres of road."""
    right, left = layout.paved
    patches = []
    if dice.chance(0.15):
        tone = dice.between(1.25, 1.8) if layout.tone < 0.38 else dice.between(0.5, 0.75)
        patches.append(Patch(dice.between(0.0, length), dice.between(15.0, 120.0), right, left, tone, 0.0))
    rate = dice.between(0.0, 0.03) if dice.chance(0.4) else 0.0
    for _ in range(int(rate * length)):
        middle, half = dice.between(right, left), dice.between(0.2, 1.6)
        gain = dice.between(0.55, 0.9) if dice.chance(0.8) else dice.between(1.05, 1.25)
        low, high = max(right, middle - half), min(left, middle + half)
        patches.append(Patch(dice.between(0.0, length), dice.between(0.6, 14.0), low, high, gain, dice.between(0, 0.5)))
    return tuple(patches)


def sample_paintwork(dice: RandomSampler, layout: Layout, length: float) -> Paintwork:
    """Ghosts, words, arrows and bars on `length` metres of road."""
    ghosts = []
    if dice.chance(0.22):
        ghosts = [_ghost(dice, layout) for _ in range(dice.whole(1, 3))]
    busy = {"street": 0.6, "highway": 0.12, "country": 0.12, "lane": 0.05}[layout.style]
    stencils, bars = [], []
    for _ in range(max(1, int(length / 120.0))):
        if dice.chance(busy):
            stencils.append(_stencil(dice, layout, length))
        if dice.chance(0.6 * busy):
            bars.append(_bars(dice, layout, length))
    return Paintwork(tuple(ghosts), tuple(stencils), tuple(bars))


def _ghost(dice: RandomSampler, layout: Layout) -> Ghost:
    """An old line at a clear distance from the present ones: beside them it would be no mistake to find it."""
    spot = dice.pick(layout.ahead) + dice.around(0.25) * layout.lane_width
    marking = Marking(
        kind=dice.pick(("solid", "dashed")),
        color="white",
        width=dice.between(0.1, 0.22),
        brightness=0.5,
        wear=dice.between(0.35, 0.7),
        period=dice.between(6.0, 18.0),
        dash=dice.between(2.0, 4.0),
        phase=dice.between(0.0, 12.0),
        seed=dice.seed(),
    )
    gain = dice.between(1.12, 1.35) if dice.chance(0.6) else dice.between(0.55, 0.85)
    return Ghost(spot, marking, dice.between(0.0, 0.4), dice.between(60.0, 200.0), min(0.75, layout.tone * gain))


def _stencil(dice: RandomSampler, layout: Layout, length: float) -> Stencil:
    return Stencil(
        text=dice.pick(WORDS),
        s=dice.between(25.0, length),
        u=dice.pick((*layout.ahead, *layout.oncoming)),
        length=dice.between(2.4, 6.0),
        width=dice.between(1.0, 2.4),
        brightness=min(0.95, layout.tone + dice.between(0.2, 0.5)),
        wear=dice.between(0.1, 0.6),
        seed=dice.seed(),
    )


def _bars(dice: RandomSampler, layout: Layout, length: float) -> Bars:
    right, left = layout.paved
    crossing = dice.chance(0.6)
    pitch = dice.between(0.8, 1.3)
    return Bars(
        s=dice.between(28.0, length),
        length=dice.between(2.5, 4.0) if crossing else dice.between(0.3, 0.6),
        low=right + 0.2,
        high=left - 0.2 if crossing else layout.lane_width / 2.0,
        period=pitch if crossing else 0.0,
        bar=0.5 * pitch,
        brightness=min(0.95, layout.tone + dice.between(0.2, 0.5)),
        wear=dice.between(0.1, 0.6),
        seed=dice.seed(),
    )
