"""Tileable noise, made once, and its lookup in road coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from lanestream_exporter.scenes.view import Grid, Layer

TILE = 512  # texels on a side
FOLD = 256  # values a row where a vector is looked up


@dataclass(frozen=True)
class NoiseTiles:
    """Square tileable noise, zero mean and unit deviation, (TILE, TILE), read-only.

    `fine` is smooth over two texels; `cloud` has the same strength in every octave from 4 to 256 texels.
    """

    fine: Layer
    cloud: Layer


@cache
def noise_tiles() -> NoiseTiles:
    """The noise that every scene draws on. A pure function of nothing, so its one result is kept."""
    rng = np.random.default_rng(20_240_229)
    fine = _octave(rng, TILE // 2)
    cloud = np.sum([_octave(rng, cells) for cells in (2, 4, 8, 16, 32, 64, 128)], axis=0)
    return NoiseTiles(_normalised(fine), _normalised(cloud))


def _octave(rng: np.random.Generator, cells: int) -> Layer:
    """Smooth noise with `cells` random values a side; wrapped before enlarging so that it tiles."""
    seeds = rng.standard_normal((cells, cells), dtype=np.float32)
    wrapped = np.pad(seeds, 2, mode="wrap")
    scale = TILE // cells
    enlarged = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.asarray(enlarged[2 * scale : -2 * scale, 2 * scale : -2 * scale], dtype=np.float32)


def _normalised(tile: Layer) -> Layer:
    tile = ((tile - tile.mean()) / tile.std()).astype(np.float32)
    tile.setflags(write=False)
    return tile


def sample(tile: Layer, u: Layer, s: Layer, cell: tuple[float, float], seed: int) -> Layer:
    """Noise at road coordinates. `cell` is the size of a texel in metres (across, along); `seed` shifts the tile."""
    if not u.size:
        return np.zeros(u.shape, np.float32)
    shift = np.random.default_rng(seed).random(2)
    maps = []
    for coordinate, size, offset in ((u, cell[0], shift[0]), (s, cell[1], shift[1])):
        turns = coordinate * np.float32(1.0 / (size * TILE)) + np.float32(offset)
        turns -= np.floor(turns)
        turns *= TILE
        maps.append(turns if turns.ndim == 2 else _folded(turns))
    values = cv2.remap(tile, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(values.ravel()[: u.size].reshape(u.shape), dtype=np.float32)


def _folded(values: Layer) -> Layer:
    """A vector as rows of FOLD values, padded: OpenCV maps at most 32,767 columns at a time."""
    return np.pad(values, (0, -len(values) % FOLD)).reshape(-1, FOLD)


def ground_noise(tile: Layer, grid: Grid, cell: tuple[float, float], seed: int) -> Layer:
    """Noise over the whole ground, faded out where a pixel covers more than a few texels so that it can't flicker."""
    values = sample(tile, grid.u, grid.s, cell, seed)
    size = np.maximum(grid.x / np.float32(grid.view.camera.focal) / cell[0], grid.along / cell[1])
    values *= np.minimum(1.0, 2.0 / np.maximum(size, 1e-3))[:, None].astype(np.float32)
    return values
