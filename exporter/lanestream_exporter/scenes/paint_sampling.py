"""Sampling of the paint that isn't a lane boundary: remains of old markings, words, arrows, bars and parking bays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lanestream_exporter.scenes.markings import Bars, GhostMarking, Paintwork, ParkingBays, Stencil
from lanestream_exporter.scenes.road import Marking
from lanestream_exporter.scenes.surface import PavementRepair

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import Layout
    from lanestream_exporter.scenes.random_sampler import RandomSampler
    from lanestream_exporter.scenes.surface import Color

WORDS = ("SLOW", "STOP", "BUS", "ONLY", "50", "30", "SCHOOL", "XING", "^", "^", "<", ">")


def sample_paintwork(sampler: RandomSampler, layout: Layout, length: float) -> Paintwork:
    """Samples ghost markings, words, arrows, bars and parking bays on `length` meters of road."""
    ghosts = []
    if sampler.bernoulli(0.22):
        ghosts = [_ghost(sampler, layout) for _ in range(sampler.integer(1, 3))]
    share = {"street": 0.6, "highway": 0.12, "country": 0.12, "lane": 0.05, "campus": 0.1, "square": 0.3}[layout.style]
    stencils, bars = [], []
    for _ in range(max(1, int(length / 120.0))):
        if sampler.bernoulli(share):
            stencils.append(_stencil(sampler, layout, length))
        if sampler.bernoulli(0.6 * share):
            bars.append(_bars(sampler, layout, length))
    return Paintwork(tuple(ghosts), tuple(stencils), tuple(bars), _bays(sampler.branch(), layout))


def _ghost(sampler: RandomSampler, layout: Layout) -> GhostMarking:
    """Samples an old line well away from the current ones; close to one, detecting it would not be an error."""
    u = sampler.choice(layout.ahead) + sampler.normal(0.25) * layout.lane_width
    marking = Marking(
        type=sampler.choice(("solid", "dashed")),
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
    right, left = layout.roadside
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


def _bays(sampler: RandomSampler, layout: Layout) -> tuple[ParkingBays, ...]:
    """Samples white or blue lines between the bays of a car park or of some streets."""
    shade = min(0.95, layout.tone + sampler.uniform(0.15, 0.45))
    color: Color = (shade, shade, shade) if sampler.bernoulli(0.75) else (0.65, 0.4, 0.2)
    wear, seed = sampler.uniform(0.1, 0.6), sampler.seed()
    if layout.style == "square":
        if sampler.bernoulli(0.4):
            return ()
        near, deep = sampler.uniform(3.0, 8.0), sampler.uniform(4.5, 6.0)
        spans = [(near, near + deep), (-near - deep, -near), (near + deep + 7.0, near + 2.0 * deep + 7.0)]
        return tuple(ParkingBays(low, high, 2.5, 0.12, color, wear, seed) for low, high in spans)
    if layout.style == "street" and layout.edges[0] and sampler.bernoulli(0.08):
        right = layout.paved[0]
        return (ParkingBays(right, right + 2.2, sampler.uniform(5.0, 6.5), 0.12, color, wear, seed),)
    return ()


def sample_humps(
    sampler: RandomSampler, layout: Layout, length: float
) -> tuple[tuple[PavementRepair, ...], tuple[Bars, ...]]:
    """Samples speed bumps on small roads: the light and the dark slope of each, and the bars painted on most."""
    share = {"campus": 0.3, "lane": 0.15, "street": 0.1, "square": 0.15}.get(layout.style, 0.0)
    if not sampler.bernoulli(share):
        return (), ()
    right, left = layout.roadside
    slopes, bars = [], []
    for _ in range(sampler.integer(1, 2)):
        s, deep = sampler.uniform(25.0, min(length, 90.0)), sampler.choice((0.35, 0.6, 1.5, 3.0))
        slopes += [
            PavementRepair(s, deep / 2.0, right, left, sampler.uniform(1.0, 1.3), 0.0),
            PavementRepair(s + deep / 2.0, deep / 2.0, right, left, sampler.uniform(0.6, 0.9), 0.0),
        ]
        if sampler.bernoulli(0.8):
            period = sampler.uniform(0.5, 1.2)
            shade, wear = min(0.95, layout.tone + sampler.uniform(0.2, 0.5)), sampler.uniform(0.1, 0.7)
            yellow = sampler.bernoulli(0.5)
            bars.append(Bars(s, deep, right, left, period, period / 2.0, shade, wear, sampler.seed(), yellow))
    return tuple(slopes), tuple(bars)
