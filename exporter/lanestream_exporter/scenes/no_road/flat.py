"""Pictures without depth: a pattern from the front, bars that meet at one point, fog, noise."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road import patterns, prints
from lanestream_exporter.scenes.no_road.camera import SUBPIXELS
from lanestream_exporter.scenes.no_road.colors import gradient, hued, mottled, plain, shaded, tint
from lanestream_exporter.scenes.no_road.patterns import Pattern
from lanestream_exporter.scenes.random_sampler import RandomSampler

ALL_PATTERNS: Final[tuple[Pattern, ...]] = (
    patterns.arches,
    patterns.blinds,
    patterns.bricks,
    patterns.carpet,
    prints.chart,
    prints.chart,
    prints.color_bars,
    patterns.facade,
    patterns.facade,
    patterns.ground_cover,
    prints.keyboard,
    prints.page,
    patterns.planks,
    prints.screen,
    patterns.shelves,
    prints.sign,
    patterns.stripes,
    prints.table,
    patterns.tiles,
)


def pattern(sampler: RandomSampler, image: Image) -> Image:
    """Draws one pattern from the front, sometimes turned about the view axis."""
    height, width = image.shape[:2]
    image[:] = sampler.choice(ALL_PATTERNS)(sampler, width, height)
    if sampler.bernoulli(0.3):
        turn = cv2.getRotationMatrix2D((width / 2, height / 2), sampler.normal(25.0), sampler.uniform(1.0, 2.0))
        image[:] = cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REFLECT)
    return image


def boards(sampler: RandomSampler, image: Image) -> Image:
    """Draws bright bars over a plain ground that meet at one point: slats, tent poles, rays, rows of tubes."""
    height, width = image.shape[:2]
    ground = hued(sampler.uniform(0.0, 6.0), sampler.uniform(0.4, 0.9), sampler.uniform(30.0, 200.0))  # not as asphalt
    image[:] = mottled(sampler, plain(width, height, ground), sampler.uniform(0.1, 0.6), 64, 64)
    vertex = np.array([sampler.uniform(-0.2, 1.2) * width, sampler.choice((-0.4, 0.2, 0.5, 1.3)) * height])
    color, count = tint(sampler, 120.0, 255.0), sampler.integer(7, 24)
    spread = sampler.uniform(0.2, 0.6) * 2.0 * np.pi / count
    start = 0.0 if sampler.bernoulli(0.5) else sampler.uniform(0.05, 0.3) * height
    for angle in (np.arange(count) * 2.0 * np.pi / count + sampler.uniform(0.0, 1.0)).tolist():
        rays = np.array([[np.cos(side), np.sin(side)] for side in (angle, angle + spread)])
        corners = np.concatenate([vertex + start * rays, vertex + 3.0 * (width + height) * rays[::-1]])
        fixed = [(corners * 2**SUBPIXELS).astype(np.int32)]
        cv2.fillPoly(image, fixed, shaded(color, sampler.uniform(0.7, 1.1)), cv2.LINE_AA, SUBPIXELS)
    return image


def fog(sampler: RandomSampler, image: Image) -> Image:
    """Draws nearly nothing: fog, a covered lens, a picture of one color, a gradient."""
    height, width = image.shape[:2]
    top = tint(sampler, 0.0, 255.0, 0.5)
    bottom = top if sampler.bernoulli(0.4) else tint(sampler, 0.0, 255.0, 0.5)
    image[:] = gradient(width, height, top, bottom)
    if sampler.bernoulli(0.6):
        image[:] = mottled(sampler, image, sampler.uniform(0.0, 0.5), 24, 24)
    return image


def static(sampler: RandomSampler, image: Image) -> Image:
    """Draws noise: grains of any size, in color or gray, or broken rows."""
    height, width = image.shape[:2]
    columns, rows = (max(2, round(size / sampler.choice((1, 1, 2, 4, 16, 60)))) for size in (width, height))
    grains = sampler.rng.integers(0, 256, (rows, columns, 3 if sampler.bernoulli(0.5) else 1), np.uint8)
    image[:] = cv2.resize(grains if grains.shape[2] == 3 else np.repeat(grains, 3, axis=2), (width, height))
    return image
