"""Tileable noise textures and their lookup in road coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from lanestream_exporter.scenes.projection import Float32Array, GroundGrid

TILE = 512  # texels on a side
FOLD = 256  # row length when a 1-D array is looked up


@dataclass(frozen=True)
class NoiseTiles:
    """Square tileable noise with zero mean and unit standard deviation, (TILE, TILE), read-only.

    `fine` is smooth over two texels; `cloud` has the same strength in every octave from 4 to 256 texels.
    """

    fine: Float32Array
    cloud: Float32Array


@cache
def noise_tiles() -> NoiseTiles:
    """Returns the noise tiles shared by all scenes; a constant, so it is computed once and cached."""
    rng = np.random.default_rng(20_240_229)
    fine = _octave(rng, TILE // 2)
    cloud = np.sum([_octave(rng, cells) for cells in (2, 4, 8, 16, 32, 64, 128)], axis=0)
    return NoiseTiles(_normalized(fine), _normalized(cloud))


def _octave(rng: np.random.Generator, cells: int) -> Float32Array:
    """Returns smooth noise with `cells` random values per side, wrapped before it is enlarged so that it tiles."""
    seeds = rng.standard_normal((cells, cells), dtype=np.float32)
    wrapped = np.pad(seeds, 2, mode="wrap")
    scale = TILE // cells
    enlarged = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.asarray(enlarged[2 * scale : -2 * scale, 2 * scale : -2 * scale], dtype=np.float32)


def _normalized(tile: Float32Array) -> Float32Array:
    tile = ((tile - tile.mean()) / tile.std()).astype(np.float32)
    tile.setflags(write=False)
    return tile


def sample_noise(
    tile: Float32Array, u: Float32Array, s: Float32Array, cell: tuple[float, float], seed: int
) -> Float32Array:
    """Returns noise at road coordinates. `cell`: texel size in meters (across, along); `seed` shifts the tile."""
    if not u.size:
        return np.zeros(u.shape, np.float32)
    shift = np.random.default_rng(seed).random(2)
    maps = []
    for coordinate, size, offset in ((u, cell[0], shift[0]), (s, cell[1], shift[1])):
        cycles = coordinate * np.float32(1.0 / (size * TILE)) + np.float32(offset)
        cycles -= np.floor(cycles)
        cycles *= TILE
        maps.append(cycles if cycles.ndim == 2 else _folded(cycles))
    values = cv2.remap(tile, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(values.ravel()[: u.size].reshape(u.shape), dtype=np.float32)


def _folded(values: Float32Array) -> Float32Array:
    """Reshapes a 1-D array into padded rows of FOLD values, because OpenCV remaps at most 32,767 columns."""
    return np.pad(values, (0, -len(values) % FOLD)).reshape(-1, FOLD)


def ground_noise(tile: Float32Array, grid: GroundGrid, cell: tuple[float, float], seed: int) -> Float32Array:
    """Returns noise over the entire ground, faded out where a pixel covers more than a few texels to avoid flicker."""
    values = sample_noise(tile, grid.u, grid.s, cell, seed)
    size = np.maximum(grid.x / np.float32(grid.projection.camera.focal) / cell[0], grid.along / cell[1])
    values *= np.minimum(1.0, 2.0 / np.maximum(size, 1e-3))[:, None].astype(np.float32)
    return values
