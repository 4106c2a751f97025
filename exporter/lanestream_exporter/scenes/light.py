"""Light on the road and what takes it away: shadows, night, haze."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lanestream_exporter.scenes.noise import noise_tiles, sample
from lanestream_exporter.scenes.view import Grid, Layer, coverage

if TYPE_CHECKING:
    from lanestream_exporter.scenes.surface import Colour


@dataclass(frozen=True)
class BandShadow:
    """A hard shadow across the road: of a bridge, a building, a pole. Metres."""

    s: float  # of its middle at u = 0
    length: float
    slant: float = 0.0  # metres along the road per metre to the left
    softness: float = 0.1


@dataclass(frozen=True)
class LineShadow:
    """A shadow along the road: of a barrier, a guard rail, a hedge. Metres."""

    u: float
    width: float
    softness: float = 0.05


@dataclass(frozen=True)
class TreeShadow:
    """Blotches of shade under trees from s to s + length, thinning out to the side away from the trees."""

    s: float
    length: float
    edge: float  # u where the shade has half its density
    side: float  # +1 where the trees are on the left, -1 on the right
    density: float  # 0 to 1
    blotch: float  # size of the blotches, metres
    slant: float  # how far they are drawn out along the road, as a factor
    seed: int


Shadow = BandShadow | LineShadow | TreeShadow


@dataclass(frozen=True)
class Light:
    """The light of a scene."""

    shade: Colour  # what share of light a full shadow leaves, per channel
    shadows: tuple[Shadow, ...] = ()
    sun: float = 0.5  # metres to the left that a metre of height throws its shadow
    headlights: float = 0.0  # range of the vehicle's own lights in metres at night, 0 by day
    glow: float = 1.0  # light that is everywhere, 1 by day

    def level(self, x: float, y: float) -> float:
        """Light that falls on a thing at vehicle-frame (x, y), metres: 1 in full daylight."""
        if self.headlights <= 0.0:
            return self.glow
        beam = math.exp(-0.5 * (y / (1.6 + 0.2 * x)) ** 2) / (1.0 + (x / self.headlights) ** 2)
        return self.glow + (1.0 - self.glow) * beam


@dataclass(frozen=True)
class Air:
    """Haze, fog or spray: its colour, and the distance in metres over which it swallows all but 1/e."""

    color: Colour
    range: float

    def clearness(self, x: float) -> float:
        """Share of light from distance x (metres) that comes through."""
        return math.exp(-x / self.range)


def light_ground(grid: Grid, light: Light, ground: Layer) -> None:
    """Lights the ground in place."""
    if light.shadows:
        shadow = _shadows(grid, light.shadows)
        for channel, left in enumerate(light.shade):
            ground[..., channel] *= 1.0 - np.float32(1.0 - left) * shadow
    if light.headlights > 0.0:
        ground *= _headlights(grid, light)[..., None]
    elif light.glow != 1.0:
        ground *= np.float32(light.glow)


def haze_ground(grid: Grid, air: Air, ground: Layer) -> None:
    """Mixes the air's colour into the ground in place, by distance."""
    clear = np.exp(grid.x * np.float32(-1.0 / air.range))[:, None]
    for channel, value in enumerate(air.color):
        ground[..., channel] *= clear
        ground[..., channel] += np.float32(value) * (1.0 - clear)


def _shadows(grid: Grid, shadows: tuple[Shadow, ...]) -> Layer:
    """Depth of shadow over the ground, 0 to 1: where several fall, the deepest."""
    total = np.zeros(grid.shape, np.float32)
    for shadow in shadows:
        if isinstance(shadow, LineShadow):
            _cast_line(grid, shadow, total)
        elif isinstance(shadow, BandShadow):
            _cast_band(grid, shadow, total)
        elif grid.view.spans(shadow.s, shadow.s + shadow.length):
            rows = _rows_between(grid, shadow.s - 15.0, shadow.s + shadow.length + 15.0)
            total[rows] = np.maximum(total[rows], _tree_shade(grid, rows, shadow))
    return total


def _cast_line(grid: Grid, shadow: LineShadow, total: Layer) -> None:
    band = grid.band(shadow.u - shadow.width, shadow.u + shadow.width)
    footprint = np.maximum(band.across, np.float32(shadow.softness))
    cover = coverage(band.u - np.float32(shadow.u), shadow.width, footprint)
    flat = total.reshape(-1)
    flat[band.index] = np.maximum(flat[band.index], cover)


def _cast_band(grid: Grid, shadow: BandShadow, total: Layer) -> None:
    reach = shadow.length + 40.0 * abs(shadow.slant)
    if not grid.view.spans(shadow.s - reach, shadow.s + reach):
        return
    rows = _rows_between(grid, shadow.s - reach, shadow.s + reach)
    offset = grid.s[rows] - np.float32(shadow.slant) * grid.u[rows] - np.float32(shadow.s)
    footprint = np.maximum(grid.along[rows], np.float32(shadow.softness))[:, None]
    total[rows] = np.maximum(total[rows], coverage(offset, shadow.length, footprint))


def _rows_between(grid: Grid, low: float, high: float) -> slice:
    """The rows of the grid that reach into s = low to high, judged on the reference line."""
    s = np.interp(grid.x, grid.view.x, grid.view.s)
    inside = np.flatnonzero((s >= low) & (s <= high))
    return slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0)


def _tree_shade(grid: Grid, rows: slice, shadow: TreeShadow) -> Layer:
    u, s = grid.u[rows], grid.s[rows]
    if not u.size:
        return u
    cell = (shadow.blotch / 24.0, shadow.blotch * shadow.slant / 24.0)
    noise = sample(noise_tiles().cloud, u, s, cell, shadow.seed)
    leaves = sample(noise_tiles().cloud, u, s, (0.15 * cell[0], 0.15 * cell[1]), shadow.seed + 1)
    leaves *= (0.35 / (1.0 + grid.along[rows]))[:, None]
    noise += leaves
    noise += np.clip((u - np.float32(shadow.edge)) * np.float32(0.25 * shadow.side), -2.0, 2.0)
    ends = np.minimum(s - np.float32(shadow.s), np.float32(shadow.s + shadow.length) - s)
    noise += np.clip(ends * 0.4, -4.0, 0.0)
    noise += np.float32(2.4 * (shadow.density - 0.5))
    soft = (0.12 + grid.along[rows] / np.float32(shadow.blotch))[:, None]
    return np.asarray(np.clip(noise / soft + 0.5, 0.0, 1.0), dtype=np.float32)


def _headlights(grid: Grid, light: Light) -> Layer:
    """Gain of the ground at night: a cone of light, dark right before the bumper."""
    camera = grid.view.camera
    ray = ((camera.centre - np.arange(camera.width)) / camera.focal).astype(np.float32)
    x = grid.x[:, None]
    spread = x * ray / (1.2 + 0.17 * x)
    fade = (1.0 - np.exp(-x / 5.0)) / (1.0 + (x / np.float32(light.headlights)) ** 2)
    beam = fade * np.exp(-0.5 * spread**2)
    return np.asarray(light.glow + (1.0 - light.glow) * beam, dtype=np.float32)
