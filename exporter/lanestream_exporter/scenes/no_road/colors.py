"""Random colors, and images that are plain, faded, mottled, darker or out of focus.

Colors are BGR gray levels from 0 to 255.
"""

from __future__ import annotations

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.noise import TILE, noise_tiles
from lanestream_exporter.scenes.random_sampler import RandomSampler

BgrColor = tuple[float, float, float]


def tint(sampler: RandomSampler, low: float = 20.0, high: float = 240.0, vivid: float = 1.0) -> BgrColor:
    """Returns a random color whose brightest channel lies between `low` and `high`; `vivid` 0 gives grays."""
    saturation = vivid * sampler.uniform(0.0, 1.0) ** 2.2
    return hued(sampler.uniform(0.0, 6.0), saturation, sampler.uniform(low, high))


def hued(hue: float, saturation: float, value: float) -> BgrColor:
    """Returns a color; `hue` runs from 0 (red) by 2 (green) and 4 (blue) to 6 (red)."""
    channels = ((offset + hue) % 6.0 for offset in (1.0, 3.0, 5.0))
    blue, green, red = (value * (1.0 - saturation * max(0.0, min(k, 4.0 - k, 1.0))) for k in channels)
    return blue, green, red


def shaded(color: BgrColor, gain: float) -> BgrColor:
    """Returns a lighter or darker color."""
    blue, green, red = (min(255.0, max(0.0, channel * gain)) for channel in color)
    return blue, green, red


def plain(width: int, height: int, color: BgrColor) -> Image:
    """Returns an image of one color."""
    return np.full((height, width, 3), color, np.uint8)


def gradient(width: int, height: int, top: BgrColor, bottom: BgrColor) -> Image:
    """Returns an image that fades from one color at the top to another at the bottom."""
    rows = np.linspace(top, bottom, height)[:, None, :]
    return np.repeat(rows.astype(np.uint8), width, axis=1)


def smooth_noise(sampler: RandomSampler, width: int, height: int, columns: float, rows: float) -> Image:
    """Returns cloudy noise (height, width) uint8 around 128; the picture shows that many texels of the noise tile."""
    columns, rows = (int(min(TILE, max(4.0, cells))) for cells in (columns, rows))
    x, y = sampler.integer(0, TILE - columns), sampler.integer(0, TILE - rows)
    texels = noise_tiles().cloud[y : y + rows, x : x + columns]
    levels = np.clip(128.0 + 42.0 * texels, 0.0, 255.0).astype(np.uint8)
    return np.asarray(cv2.resize(levels, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.uint8)


def mottled(sampler: RandomSampler, image: Image, strength: float, columns: float, rows: float) -> Image:
    """Returns the image, darker and lighter by cloudy noise; at `strength` 1 by up to all of it."""
    height, width = image.shape[:2]
    noise = smooth_noise(sampler, width, height, columns, rows)
    gain = cv2.convertScaleAbs(noise, alpha=strength, beta=128.0 * (1.0 - strength))
    return np.asarray(cv2.multiply(image, cv2.cvtColor(gain, cv2.COLOR_GRAY2BGR), scale=1.0 / 128.0), dtype=np.uint8)


def with_gain(image: Image, gain: float) -> Image:
    """Returns the image, brighter or darker."""
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain), dtype=np.uint8)


def defocused(sampler: RandomSampler, image: Image) -> Image:
    """Returns the image out of focus by a random amount."""
    size = 2 * max(1, round(image.shape[1] * sampler.uniform(0.004, 0.05))) + 1
    return np.asarray(cv2.blur(cv2.blur(image, (size, size)), (size, size)), dtype=np.uint8)
