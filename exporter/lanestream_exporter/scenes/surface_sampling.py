"""Sampling of the ground: pavement and verges, their edges and flaws, and dust."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from lanestream_exporter.scenes.surface import (
    Color,
    Dust,
    Joint,
    PavementRepair,
    RaggedEdge,
    Seam,
    Surface,
    SurfaceMaterial,
    WheelTrack,
)

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import Layout
    from lanestream_exporter.scenes.random_sampler import RandomSampler
    from lanestream_exporter.scenes.road import EdgeType

VERGES: dict[str, Color] = {
    "grass": (0.16, 0.38, 0.29),
    "meadow": (0.16, 0.41, 0.32),
    "dry grass": (0.3, 0.46, 0.52),
    "sand": (0.42, 0.54, 0.62),
    "gravel": (0.4, 0.43, 0.45),
    "earth": (0.2, 0.27, 0.34),
}
FILMS: tuple[Color, ...] = ((0.3, 0.37, 0.5), (0.38, 0.46, 0.52), (0.42, 0.5, 0.56))  # reddish and sandy dust
_LEAST_CONTRAST: Final = 0.1  # of the pavement to what lies beyond its edge, of 1


def gray(sampler: RandomSampler, tone: float) -> Color:
    """Samples a gray of the brightness `tone` with a slight color cast."""
    warmth = sampler.normal(0.025)
    return (tone * (1.0 - warmth), tone * (1.0 + sampler.normal(0.01)), tone * (1.0 + warmth))


def sample_surface(sampler: RandomSampler, layout: Layout) -> Surface:
    """Samples the ground of a road: materials, wear and flaws, but no repairs."""
    texture = sampler.uniform(0.4, 1.3)
    asphalt = not layout.concrete
    extra = sampler.branch()
    return Surface(
        materials=_materials(sampler, layout),
        tracks=_tracks(sampler, layout),
        seams=(*_seams(sampler, layout), *_more_seams(extra, layout)),
        joints=_joints(sampler, layout),
        grain=sampler.uniform(0.02, 0.09) if asphalt else sampler.uniform(0.01, 0.05),
        mottle=texture * sampler.uniform(0.02, 0.06),
        streaks=texture * sampler.uniform(0.02, 0.06),
        cracks=sampler.uniform(0.15, 0.6) if asphalt and sampler.bernoulli(0.2) else 0.0,
        pits=sampler.uniform(0.2, 0.8) if sampler.bernoulli(0.45) else 0.0,
        ragged=_ragged(extra, layout),
        dust=_dust(extra, layout),
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
    extra = sampler.branch()
    if layout.style != "street" and sampler.bernoulli(0.5):
        gravel = gray(sampler, sampler.uniform(0.35, 0.55))
        width = sampler.uniform(0.3, 2.0)
        parts += [SurfaceMaterial(left, left + width, gravel, 2.5), SurfaceMaterial(right - width, right, gravel, 2.5)]
    parts += _sidewalks(extra, layout)
    if layout.opposite > 0.0:
        parts.append(SurfaceMaterial(left + 1.0, left + 14.0, gray(sampler, layout.tone), 1.0))
    elif layout.opposite < 0.0:
        parts.append(SurfaceMaterial(right - 14.0, right - 1.0, gray(sampler, layout.tone), 1.0))
    shoulder = gray(sampler, _other_tone(sampler, layout)) if sampler.bernoulli(0.55) else gray(sampler, layout.tone)
    parts.append(SurfaceMaterial(right, left, shoulder, 1.2))
    parts += _lanes(sampler, layout)
    parts += _gutters(extra, layout)
    return tuple(_with_contrast(parts, layout))


def _sides(layout: Layout, edge: EdgeType) -> list[tuple[float, float]]:
    """Returns the lateral positions of the edges of one type, each with the direction away from the road."""
    sides = ((layout.edges[1], layout.paved[1], 1.0), (layout.edges[0], layout.paved[0], -1.0))
    return [(u, outward) for kind, u, outward in sides if kind == edge]


def _strip(u: float, other: float, color: Color, roughness: float) -> SurfaceMaterial:
    return SurfaceMaterial(min(u, other), max(u, other), color, roughness)


def _sidewalks(sampler: RandomSampler, layout: Layout) -> list[SurfaceMaterial]:
    """Samples sidewalks beyond most kerbs; beyond the others grass grows up to the kerb."""
    share = {"street": 1.0, "campus": 0.65}.get(layout.style, 0.3)
    color = gray(sampler, sampler.uniform(0.35, 0.68))
    return [
        _strip(u, u + outward * sampler.uniform(1.2, 4.0), color, 0.7)
        for u, outward in _sides(layout, "kerb")
        if sampler.bernoulli(share)
    ]


def _gutters(sampler: RandomSampler, layout: Layout) -> list[SurfaceMaterial]:
    """Samples gutters of concrete beside some kerbs; half of them have a dark joint to the asphalt."""
    sides = _sides(layout, "kerb") if sampler.bernoulli(0.3) else []
    color, width = gray(sampler, sampler.uniform(0.42, 0.7)), sampler.uniform(0.2, 0.5)
    parts = [_strip(u, u - outward * width, color, 0.8) for u, outward in sides]
    if sampler.bernoulli(0.5):
        joint = gray(sampler, 0.4 * layout.tone)
        parts += [_strip(u - outward * width, u - outward * (width + 0.03), joint, 1.0) for u, outward in sides]
    return parts


def _with_contrast(parts: list[SurfaceMaterial], layout: Layout) -> list[SurfaceMaterial]:
    """Returns the materials, with those beyond edges without a kerb lighter or darker if they looked like the road."""
    parts = list(parts)
    for u, outward in _sides(layout, "edge"):
        inside = next(part for part in reversed(parts) if part.low <= u - 0.02 * outward < part.high)
        number = max(n for n, part in enumerate(parts) if part.low <= u + 0.02 * outward < part.high)
        beyond = parts[number]
        if max(abs(a - b) for a, b in zip(inside.color, beyond.color, strict=True)) < _LEAST_CONTRAST:
            gain = 1.5 if sum(inside.color) < 1.1 else 0.6
            blue, green, red = beyond.color
            parts[number] = replace(beyond, color=(gain * blue, gain * green, gain * red))
    return parts


def _ragged(sampler: RandomSampler, layout: Layout) -> tuple[RaggedEdge, ...]:
    """Samples how grass, sand or gravel runs into the pavement at edges without a kerb; some are straight."""
    return tuple(
        RaggedEdge(u, sampler.uniform(0.015, 0.09), sampler.uniform(0.06, 0.3), sampler.seed())
        for u, _ in _sides(layout, "edge")
        if sampler.bernoulli(0.75)
    )


def _dust(sampler: RandomSampler, layout: Layout) -> tuple[Dust, ...]:
    """Samples dust along the edges of some roads."""
    if not sampler.bernoulli(0.15):
        return ()
    color, reach = sampler.choice(FILMS), sampler.uniform(0.4, 2.2)
    sides = _sides(layout, "edge") + _sides(layout, "kerb")
    return tuple(
        Dust(u, reach, -outward, color, sampler.uniform(0.3, 0.85), sampler.seed())
        for u, outward in sides
        if sampler.bernoulli(0.8)
    )


def _other_tone(sampler: RandomSampler, layout: Layout) -> float:
    """Samples the brightness of pavement of another age or kind."""
    if layout.concrete and sampler.bernoulli(0.7):
        return sampler.uniform(0.2, 0.4)
    return min(0.65, max(0.16, layout.tone * sampler.uniform(0.65, 1.4)))


def _lanes(sampler: RandomSampler, layout: Layout) -> list[SurfaceMaterial]:
    """Samples lanes of one tone, or of several if they were laid or resurfaced one by one."""
    base, uneven = gray(sampler, layout.tone), sampler.bernoulli(0.35)
    if layout.style in {"campus", "square"}:
        return [SurfaceMaterial(*layout.paved, base, 1.0)]
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
    for center in (*layout.ahead, *layout.oncoming) if layout.style != "square" else ():
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
    positions = [boundary.u + sampler.choice((-1.0, 1.0)) * sampler.uniform(0.12, 0.45) for boundary in layout.markings]
    positions += [center + sampler.normal(0.5) for center in layout.ahead]
    if layout.concrete:
        offset = sampler.normal(0.15)
        edges = [boundary.u + offset for boundary in layout.markings]
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


def _more_seams(sampler: RandomSampler, layout: Layout) -> tuple[Seam, ...]:
    """Samples tram rails, dirt along kerbs, and winding tar lines on roads without markings."""
    seams: list[Seam] = []
    if layout.style == "street" and sampler.bernoulli(0.1):
        seams += _rails(sampler, layout)
    if sampler.bernoulli(0.5):
        depth = sampler.uniform(0.2, 0.6)
        seams += [Seam(u - outward * 0.04, 0.08, depth, 0.02, 0.3, 0) for u, outward in _sides(layout, "kerb")]
    if not layout.markings:
        for _ in range(sampler.integer(0, 3)):
            u, width = sampler.uniform(*layout.roadside), sampler.uniform(0.04, 0.12)
            wander, breaks = sampler.uniform(0.03, 0.2), sampler.uniform(0.0, 0.7)
            seams.append(Seam(u, width, sampler.uniform(0.2, 0.7), wander, breaks, sampler.seed()))
    return tuple(seams)


def _rails(sampler: RandomSampler, layout: Layout) -> list[Seam]:
    """Samples the rails of two tram tracks: bright or dark heads, each with a dark groove beside it."""
    gauge = sampler.choice((1.0, 1.435, 1.524))
    center, spacing = sampler.choice((*layout.ahead, *layout.oncoming)), sampler.uniform(2.8, 3.3)
    depth = -sampler.uniform(0.3, 1.2) if sampler.bernoulli(0.6) else sampler.uniform(0.3, 0.7)
    tracks = (center, center + spacing)
    heads = [track + side * gauge / 2.0 for track in tracks for side in (-1.0, 1.0)]
    return [Seam(u, 0.07, depth) for u in heads] + [Seam(u + 0.06, 0.05, 0.6) for u in heads]


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
        center, half = sampler.uniform(*layout.roadside), sampler.uniform(0.2, 1.6)
        gain = sampler.uniform(0.55, 0.9) if sampler.bernoulli(0.8) else sampler.uniform(1.05, 1.25)
        low, high = max(right, center - half), min(left, center + half)
        repairs.append(
            PavementRepair(
                sampler.uniform(0.0, length), sampler.uniform(0.6, 14.0), low, high, gain, sampler.uniform(0, 0.5)
            )
        )
    return tuple(repairs)
