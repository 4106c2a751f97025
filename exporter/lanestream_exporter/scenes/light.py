"""Lighting of the road: shadows, night, haze."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lanestream_exporter.scenes.noise import noise_tiles, sample_noise
from lanestream_exporter.scenes.projection import Float32Array, GroundGrid, coverage

if TYPE_CHECKING:
    from lanestream_exporter.scenes.surface import Color


@dataclass(frozen=True)
class BandShadow:
    """A hard shadow across the road, of a bridge, a building or a pole. Meters."""

    s: float  # of its center line at u = 0
    length: float
    slant: float = 0.0  # meters along the road per meter to the left
    softness: float = 0.1


@dataclass(frozen=True)
class LineShadow:
    """A shadow along the road, of a barrier, a guard rail or a hedge. Meters."""

    u: float
    width: float
    softness: float = 0.05


@dataclass(frozen=True)
class TreeShadow:
    """Blotchy shade of trees from s to s + length, thinning out away from the trees."""

    s: float
    length: float
    edge: float  # u at which the shade has half its density
    side: float  # of the trees: +1 left, -1 right
    density: float  # 0 to 1
    blotch: float  # size of the blotches, meters
    slant: float  # elongation of the blotches along the road, a factor
    seed: int


Shadow = BandShadow | LineShadow | TreeShadow


@dataclass(frozen=True)
class SceneLight:
    """The lighting of a scene."""

    shade: Color  # share of light left in full shadow, per channel
    shadows: tuple[Shadow, ...] = ()
    sun: float = 0.5  # meters to the left that a meter of height casts its shadow
    headlights: float = 0.0  # range of the vehicle's headlights in meters at night; 0 by day
    glow: float = 1.0  # ambient light, 1 by day

    def level(self, x: float, y: float) -> float:
        """Returns the light on an object at vehicle-frame (x, y), meters; 1 in full daylight."""
        if self.headlights <= 0.0:
            return self.glow
        beam = math.exp(-0.5 * (y / (1.6 + 0.2 * x)) ** 2) / (1.0 + (x / self.headlights) ** 2)
        return self.glow + (1.0 - self.glow) * beam


@dataclass(frozen=True)
class Atmosphere:
    """Haze, fog or spray: its color, and the distance `range` in meters at which the transmittance is 1/e."""

    color: Color
    range: float

    def transmittance(self, x: float) -> float:
        """Returns the share of light that is transmitted over the distance x in meters."""
        return math.exp(-x / self.range)


def light_ground(grid: GroundGrid, light: SceneLight, ground: Float32Array) -> None:
    """Applies shadows and headlights to the ground, in place."""
    if light.shadows:
        shadow = _shadows(grid, light.shadows)
        for channel, remaining in enumerate(light.shade):
            ground[..., channel] *= 1.0 - np.float32(1.0 - remaining) * shadow
    if light.headlights > 0.0:
        ground *= _headlights(grid, light)[..., None]
    elif light.glow != 1.0:
        ground *= np.float32(light.glow)


def haze_ground(grid: GroundGrid, atmosphere: Atmosphere, ground: Float32Array) -> None:
    """Blends the color of the haze into the ground, in place, by distance."""
    clear = np.exp(grid.x * np.float32(-1.0 / atmosphere.range))[:, None]
    for channel, value in enumerate(atmosphere.color):
        ground[..., channel] *= clear
        ground[..., channel] += np.float32(value) * (1.0 - clear)


def _shadows(grid: GroundGrid, shadows: tuple[Shadow, ...]) -> Float32Array:
    """Returns the depth of shadow over the ground, 0 to 1; overlapping shadows give the deepest."""
    total = np.zeros(grid.shape, np.float32)
    for shadow in shadows:
        if isinstance(shadow, LineShadow):
            _cast_line(grid, shadow, total)
        elif isinstance(shadow, BandShadow):
            _cast_band(grid, shadow, total)
        elif grid.projection.overlaps(shadow.s, shadow.s + shadow.length):
            rows = _rows_within(grid, shadow.s - 15.0, shadow.s + shadow.length + 15.0)
            total[rows] = np.maximum(total[rows], _tree_shade(grid, rows, shadow))
    return total


def _cast_line(grid: GroundGrid, shadow: LineShadow, total: Float32Array) -> None:
    band = grid.band(shadow.u - shadow.width, shadow.u + shadow.width)
    footprint = np.maximum(band.across, np.float32(shadow.softness))
    cover = coverage(band.u - np.float32(shadow.u), shadow.width, footprint)
    flat = total.reshape(-1)
    flat[band.index] = np.maximum(flat[band.index], cover)


def _cast_band(grid: GroundGrid, shadow: BandShadow, total: Float32Array) -> None:
    reach = shadow.length + 40.0 * abs(shadow.slant)
    if not grid.projection.overlaps(shadow.s - reach, shadow.s + reach):
        return
    rows = _rows_within(grid, shadow.s - reach, shadow.s + reach)
    offset = grid.s[rows] - np.float32(shadow.slant) * grid.u[rows] - np.float32(shadow.s)
    footprint = np.maximum(grid.along[rows], np.float32(shadow.softness))[:, None]
    total[rows] = np.maximum(total[rows], coverage(offset, shadow.length, footprint))


def _rows_within(grid: GroundGrid, low: float, high: float) -> slice:
    """Returns the rows of the grid whose point on the reference line lies between s = low and s = high."""
    s = np.interp(grid.x, grid.projection.x, grid.projection.s)
    inside = np.flatnonzero((s >= low) & (s <= high))
    return slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) else slice(0, 0)


def _tree_shade(grid: GroundGrid, rows: slice, shadow: TreeShadow) -> Float32Array:
    u, s = grid.u[rows], grid.s[rows]
    if not u.size:
        return u
    cell = (shadow.blotch / 24.0, shadow.blotch * shadow.slant / 24.0)
    noise = sample_noise(noise_tiles().cloud, u, s, cell, shadow.seed)
    leaves = sample_noise(noise_tiles().cloud, u, s, (0.15 * cell[0], 0.15 * cell[1]), shadow.seed + 1)
    leaves *= (0.35 / (1.0 + grid.along[rows]))[:, None]
    noise += leaves
    noise += np.clip((u - np.float32(shadow.edge)) * np.float32(0.25 * shadow.side), -2.0, 2.0)
    ends = np.minimum(s - np.float32(shadow.s), np.float32(shadow.s + shadow.length) - s)
    noise += np.clip(ends * 0.4, -4.0, 0.0)
    noise += np.float32(2.4 * (shadow.density - 0.5))
    soft = (0.12 + grid.along[rows] / np.float32(shadow.blotch))[:, None]
    return np.asarray(np.clip(noise / soft + 0.5, 0.0, 1.0), dtype=np.float32)


def _headlights(grid: GroundGrid, light: SceneLight) -> Float32Array:
    """Returns the gain of the ground at night: a cone of light, dark right in front of the bumper."""
    camera = grid.projection.camera
    ray = ((camera.center - np.arange(camera.width)) / camera.focal).astype(np.float32)
    x = grid.x[:, None]
    spread = x * ray / (1.2 + 0.17 * x)
    fade = (1.0 - np.exp(-x / 5.0)) / (1.0 + (x / np.float32(light.headlights)) ** 2)
    beam = fade * np.exp(-0.5 * spread**2)
    return np.asarray(light.glow + (1.0 - light.glow) * beam, dtype=np.float32)
