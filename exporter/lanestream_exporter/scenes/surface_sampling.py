"""Sampling of the ground: pavement, its flaws, and paint that isn't a lane boundary."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lanestream_exporter.scenes.markings import Bars, GhostMarking, Paintwork, Stencil
from lanestream_exporter.scenes.road import Marking
from lanestream_exporter.scenes.surface import Color, Joint, PavementRepair, Seam, Surface, SurfaceMaterial, WheelTrack

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import Layout
    from lanestream_exporter.scenes.random_sampler import RandomSampler

VERGES: dict[str, Color] = {
    "grass": (0.16, 0.38, 0.29),
    "meadow": (0.16, 0.41, 0.32),
    "dry grass": (0.3, 0.46, 0.52),
    "sand": (0.42, 0.54, 0.62),
    "gravel": (0.4, 0.43, 0.45),
    "earth": (0.2, 0.27, 0.34),
}
WORDS = ("SLOW", "STOP", "BUS", "ONLY", "50", "30", "SCHOOL", "XING", "^", "^", "<", ">")


def gray(sampler: RandomSampler, tone: float) -> Color:
    """Samples a gray of the brightness `tone` with a slight color cast."""
    warmth = sampler.normal(0.025)
    return (tone * (1.0 - warmth), tone * (1.0 + sampler.normal(0.01)), tone * (1.0 + warmth))


def sample_surface(sampler: RandomSampler, layout: Layout) -> Surface:
    """Samples the ground of a road: materials, wear and flaws, but no repairs."""
    texture = sampler.uniform(0.4, 1.3)
    asphalt = not layout.concrete
    return Surface(
        materials=_materials(sampler, layout),
        tracks=_tracks(sampler, layout),
        seams=_seams(sampler, layout),
        joints=_joints(sampler, layout),
        grain=sampler.uniform(0.02, 0.09) if asphalt else sampler.uniform(0.01, 0.05),
        mottle=texture * sampler.uniform(0.02, 0.06),
        streaks=texture * sampler.uniform(0.02, 0.06),
        cracks=sampler.uniform(0.15, 0.6) if asphalt and sampler.bernoulli(0.2) else 0.0,
        pits=sampler.uniform(0.2, 0.8) if sampler.bernoulli(0.45) else 0.0,
        seed=sampler.seed(),
    )


def _materials(sampler: RandomSampler, layout: Layout) -> tuple[SurfaceMaterial, ...]:
    right, left = layout.paved
    verges = [sampler.choice(list(VERGES)) for _ in range(2)]
    if sampler.bernoulli(0.6):
        verges[1] = verges[0]
    light = sampler.uniform(0.7, 1.2)
    parts = []
    for verge, low, high in ((verges[0], left, 70.0), (verges[1], -70.0, right)):
        blue, green, red = VERGES[verge]
        parts.append(SurfaceMaterial(low, high, (blue * light, green * light, red * light), sampler.uniform(2.5, 5.0)))
    if layout.style == "street":
        pavement = gray(sampler, sampler.uniform(0.4, 0.65))
        parts += [SurfaceMaterial(left, left + 3.0, pavement, 0.7), SurfaceMaterial(right - 3.0, right, pavement, 0.7)]
    elif sampler.bernoulli(0.5):
        gravel = gray(sampler, sampler.uniform(0.35, 0.55))
        width = sampler.uniform(0.3, 2.0)
        parts += [SurfaceMaterial(left, left + width, gravel, 2.5), SurfaceMaterial(right - width, right, gravel, 2.5)]
    if layout.opposite > 0.0:
        parts.append(SurfaceMaterial(left + 1.0, left + 14.0, gray(sampler, layout.tone), 1.0))
    elif layout.opposite < 0.0:
        parts.append(SurfaceMaterial(right - 14.0, right - 1.0, gray(sampler, layout.tone), 1.0))
    shoulder = gray(sampler, _other_tone(sampler, layout)) if sampler.bernoulli(0.55) else gray(sampler, layout.tone)
    parts.append(SurfaceMaterial(right, left, shoulder, 1.2))
    parts += _lanes(sampler, layout)
    return tuple(parts)


def _other_tone(sampler: RandomSampler, layout: Layout) -> float:
    """Samples the brightness of pavement of another age or kind."""
    if layout.concrete and sampler.bernoulli(0.7):
        return sampler.uniform(0.2, 0.4)
    return min(0.65, max(0.16, layout.tone * sampler.uniform(0.65, 1.4)))


def _lanes(sampler: RandomSampler, layout: Layout) -> list[SurfaceMaterial]:
    """Samples lanes of one tone, or of several if they were laid or resurfaced one by one."""
    base, uneven = gray(sampler, layout.tone), sampler.bernoulli(0.35)
    parts = []
    for center in (*layout.ahead, *layout.oncoming):
        color = gray(sampler, layout.tone * sampler.uniform(0.8, 1.2)) if uneven else base
        if sampler.bernoulli(0.06):
            color = gray(sampler, _other_tone(sampler, layout))
        half = layout.lane_width / 2.0 + (0.12 if sampler.bernoulli(0.5) else sampler.normal(0.1))
        low, high = max(layout.paved[0], center - half), min(layout.paved[1], center + half)
        parts.append(SurfaceMaterial(low, high, color, 1.0))
    return parts


def _tracks(sampler: RandomSampler, layout: Layout) -> tuple[WheelTrack, ...]:
    """Samples two wheel tracks and an oil stripe for every lane."""
    wheels = sampler.uniform(-0.08, 0.16)
    oil = sampler.uniform(-0.04, 0.22) if sampler.bernoulli(0.6) else 0.0
    tracks = []
    for center in (*layout.ahead, *layout.oncoming):
        drift = sampler.normal(0.15)
        gauge = sampler.uniform(0.72, 0.9)
        width = sampler.uniform(0.16, 0.34)
        tracks += [
            WheelTrack(center + drift + side * gauge, width, wheels * sampler.uniform(0.6, 1.3)) for side in (-1.0, 1.0)
        ]
        tracks.append(WheelTrack(center + drift, sampler.uniform(0.2, 0.5), oil))
    return tuple(tracks)


def _seams(sampler: RandomSampler, layout: Layout) -> tuple[Seam, ...]:
    """Samples lines along the road that a detector must learn to ignore."""
    seams: list[Seam] = []
    positions = [
        boundary.u + sampler.choice((-1.0, 1.0)) * sampler.uniform(0.12, 0.45) for boundary in layout.boundaries
    ]
    positions += [center + sampler.normal(0.5) for center in layout.ahead]
    if layout.concrete:
        offset = sampler.normal(0.15)
        edges = [boundary.u + offset for boundary in layout.boundaries]
        seams = [Seam(edge, sampler.uniform(0.015, 0.05), sampler.uniform(0.2, 0.6)) for edge in edges]
    for position in positions:
        if sampler.bernoulli(0.22):
            tar = sampler.bernoulli(0.7)
            seams.append(
                Seam(
                    u=position,
                    width=sampler.uniform(0.03, 0.16) if tar else sampler.uniform(0.02, 0.06),
                    depth=sampler.uniform(0.25, 0.75) if tar else sampler.uniform(-0.35, 0.4),
                    wander=sampler.uniform(0.0, 0.07) if sampler.bernoulli(0.6) else 0.0,
                    breaks=sampler.uniform(0.2, 0.8) if sampler.bernoulli(0.4) else 0.0,
                    seed=sampler.seed(),
                )
            )
    return tuple(seams)


def _joints(sampler: RandomSampler, layout: Layout) -> tuple[Joint, ...]:
    right, left = layout.paved
    if layout.concrete:
        return (Joint(right, left, sampler.uniform(4.0, 6.5), sampler.uniform(0.01, 0.03), sampler.uniform(0.25, 0.7)),)
    if sampler.bernoulli(0.12):
        return (Joint(right, left, sampler.uniform(7.0, 18.0), sampler.uniform(0.02, 0.09), sampler.uniform(0.2, 0.6)),)
    return ()


def sample_repairs(sampler: RandomSampler, layout: Layout, length: float) -> tuple[PavementRepair, ...]:
    """Samples repairs, and sometimes a long stretch of different pavement, on `length` meters of road."""
    right, left = layout.paved
    repairs = []
    if sampler.bernoulli(0.15):
        tone = sampler.uniform(1.25, 1.8) if layout.tone < 0.38 else sampler.uniform(0.5, 0.75)
        repairs.append(
            PavementRepair(sampler.uniform(0.0, length), sampler.uniform(15.0, 120.0), right, left, tone, 0.0)
        )
    rate = sampler.uniform(0.0, 0.03) if sampler.bernoulli(0.4) else 0.0
    for _ in range(int(rate * length)):
        center, half = sampler.uniform(right, left), sampler.uniform(0.2, 1.6)
        gain = sampler.uniform(0.55, 0.9) if sampler.bernoulli(0.8) else sampler.uniform(1.05, 1.25)
        low, high = max(right, center - half), min(left, center + half)
        repairs.append(
            PavementRepair(
                sampler.uniform(0.0, length), sampler.uniform(0.6, 14.0), low, high, gain, sampler.uniform(0, 0.5)
            )
        )
    return tuple(repairs)


def sample_paintwork(sampler: RandomSampler, layout: Layout, length: float) -> Paintwork:
    """Samples ghost markings, words, arrows and bars on `length` meters of road."""
    ghosts = []
    if sampler.bernoulli(0.22):
        ghosts = [_ghost(sampler, layout) for _ in range(sampler.integer(1, 3))]
    share = {"street": 0.6, "highway": 0.12, "country": 0.12, "lane": 0.05}[layout.style]
    stencils, bars = [], []
    for _ in range(max(1, int(length / 120.0))):
        if sampler.bernoulli(share):
            stencils.append(_stencil(sampler, layout, length))
        if sampler.bernoulli(0.6 * share):
            bars.append(_bars(sampler, layout, length))
    return Paintwork(tuple(ghosts), tuple(stencils), tuple(bars))


def _ghost(sampler: RandomSampler, layout: Layout) -> GhostMarking:
    """Samples an old line well away from the current ones; close to one, detecting it would not be an error."""
    u = sampler.choice(layout.ahead) + sampler.normal(0.25) * layout.lane_width
    marking = Marking(
        kind=sampler.choice(("solid", "dashed")),
        color="white",
        width=sampler.uniform(0.1, 0.22),
        brightness=0.5,
        wear=sampler.uniform(0.35, 0.7),
        period=sampler.uniform(6.0, 18.0),
        dash=sampler.uniform(2.0, 4.0),
        phase=sampler.uniform(0.0, 12.0),
        seed=sampler.seed(),
    )
    gain = sampler.uniform(1.12, 1.35) if sampler.bernoulli(0.6) else sampler.uniform(0.55, 0.85)
    return GhostMarking(
        u, marking, sampler.uniform(0.0, 0.4), sampler.uniform(60.0, 200.0), min(0.75, layout.tone * gain)
    )


def _stencil(sampler: RandomSampler, layout: Layout, length: float) -> Stencil:
    return Stencil(
        text=sampler.choice(WORDS),
        s=sampler.uniform(25.0, length),
        u=sampler.choice((*layout.ahead, *layout.oncoming)),
        length=sampler.uniform(2.4, 6.0),
        width=sampler.uniform(1.0, 2.4),
        brightness=min(0.95, layout.tone + sampler.uniform(0.2, 0.5)),
        wear=sampler.uniform(0.1, 0.6),
        seed=sampler.seed(),
    )


def _bars(sampler: RandomSampler, layout: Layout, length: float) -> Bars:
    right, left = layout.paved
    crossing = sampler.bernoulli(0.6)
    spacing = sampler.uniform(0.8, 1.3)
    return Bars(
        s=sampler.uniform(28.0, length),
        length=sampler.uniform(2.5, 4.0) if crossing else sampler.uniform(0.3, 0.6),
        low=right + 0.2,
        high=left - 0.2 if crossing else layout.lane_width / 2.0,
        period=spacing if crossing else 0.0,
        bar=0.5 * spacing,
        brightness=min(0.95, layout.tone + sampler.uniform(0.2, 0.5)),
        wear=sampler.uniform(0.1, 0.6),
        seed=sampler.seed(),
    )
