"""Random pictures without a road: their kinds, the light on them and the camera's faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.lens import Glare, Lens, develop
from lanestream_exporter.scenes.no_road import close_ups, flat, outdoors, rooms
from lanestream_exporter.scenes.no_road.colors import defocused, plain
from lanestream_exporter.scenes.random_sampler import RandomSampler


@dataclass(frozen=True)
class Kind:
    """A kind of picture; `draw` fills an image, which may be a part of a larger one, and returns it."""

    draw: Callable[[RandomSampler, Image], Image]
    share: float  # of all pictures
    lit: bool = False  # may get patches of light and shadow; on open ground those could pass for a road
    gray: bool = False  # may lose its colors and still not pass for a road


# The parts of a collage.
_PARTS: Final = (
    flat.pattern,
    outdoors.sky,
    rooms.room,
    close_ups.portrait,
    flat.boards,
    outdoors.meadow,
)


def _collage(sampler: RandomSampler, image: Image) -> Image:
    """Two or four pictures side by side."""
    height, width = image.shape[:2]
    x, y = round(width * sampler.uniform(0.3, 0.7)), round(height * sampler.uniform(0.3, 0.7))
    rows = (slice(0, y), slice(y, height)) if sampler.bernoulli(0.5) else (slice(0, height),)
    for row in rows:
        for column in (slice(0, x), slice(x, width)):
            sampler.choice(_PARTS)(sampler, image[row, column])
    return image


KINDS: Final[Mapping[str, Kind]] = MappingProxyType(
    {
        "pattern": Kind(flat.pattern, 0.18, lit=True, gray=True),
        "sheet": Kind(close_ups.sheet, 0.1, lit=True, gray=True),
        "corridor": Kind(rooms.corridor, 0.08, lit=True),
        "room": Kind(rooms.room, 0.08, lit=True, gray=True),
        "floor": Kind(rooms.floor, 0.08, lit=True),
        "tabletop": Kind(rooms.tabletop, 0.07, lit=True),
        "rails": Kind(close_ups.rails, 0.05),
        "boards": Kind(flat.boards, 0.04),
        "stairs": Kind(rooms.stairs, 0.03, lit=True, gray=True),
        "sky": Kind(outdoors.sky, 0.03, gray=True),
        "meadow": Kind(outdoors.meadow, 0.03),
        "field": Kind(outdoors.field, 0.02),
        "water": Kind(outdoors.water, 0.02),
        "forest": Kind(outdoors.forest, 0.03, gray=True),
        "portrait": Kind(close_ups.portrait, 0.03, lit=True, gray=True),
        "food": Kind(close_ups.food, 0.02, lit=True, gray=True),
        "dashboard": Kind(close_ups.dashboard, 0.03, gray=True),
        "night": Kind(outdoors.night, 0.02, gray=True),
        "fog": Kind(flat.fog, 0.02, gray=True),
        "static": Kind(flat.static, 0.02, gray=True),
        "collage": Kind(_collage, 0.02),
    }
)


def sample_picture(rng: np.random.Generator, width: int, height: int) -> Image:
    """Returns a random picture without a road, BGR (height, width, 3) uint8; the same generator gives the same picture.

    Width and height are at least 64 pixels.
    """
    return sample_kind_and_picture(rng, width, height)[1]


def sample_kind_and_picture(rng: np.random.Generator, width: int, height: int) -> tuple[str, Image]:
    """Returns the picture of `sample_picture` after the name of its kind."""
    sampler = RandomSampler(rng)
    name = sampler.weighted_choice({name: kind.share for name, kind in KINDS.items()})
    kind = KINDS[name]
    image = kind.draw(sampler, plain(width, height, (0.0, 0.0, 0.0)))
    if kind.lit and sampler.bernoulli(0.4):
        image = _lit(sampler, image)
    if sampler.bernoulli(0.5):
        image = np.ascontiguousarray(image[:, ::-1])
    return name, develop(image, _lens(sampler, gray=kind.gray and sampler.bernoulli(0.1)))


def _lit(sampler: RandomSampler, image: Image) -> Image:
    """Returns the image with a shadow or a patch of light whose edges are straight."""
    height, width = image.shape[:2]
    gains = np.full((height, width, 3), 128, np.uint8)
    corners = (sampler.rng.uniform(-0.4, 1.4, (sampler.choice((3, 4)), 2)) * (width, height)).round().astype(np.int32)
    level = 128.0 * (sampler.uniform(0.35, 0.9) if sampler.bernoulli(0.6) else sampler.uniform(1.1, 1.6))
    cv2.fillConvexPoly(gains, cv2.convexHull(corners), (level, level, level), cv2.LINE_AA)
    if sampler.bernoulli(0.5):
        gains = defocused(sampler, gains)
    return np.asarray(cv2.multiply(image, gains, scale=1.0 / 128.0), dtype=np.uint8)


def _lens(sampler: RandomSampler, gray: bool) -> Lens:
    """Returns a lens with the usual faults of cameras, in about one picture of four none."""
    if sampler.bernoulli(0.25):
        return Lens(quality=sampler.choice((0, 0, 90)))
    cast, glare = sampler.normal(0.05), None
    if sampler.bernoulli(0.1):
        x, y = sampler.uniform(0.0, 1.0), sampler.uniform(0.0, 1.0)
        glare = Glare(x, y, sampler.uniform(0.05, 0.4), sampler.uniform(0.2, 0.8))
    return Lens(
        exposure=sampler.uniform(0.5, 1.5),
        gamma=sampler.uniform(0.75, 1.35),
        cast=(1.0 + cast, 1.0 + sampler.normal(0.02), 1.0 - cast),
        saturation=0.0 if gray else sampler.uniform(0.7, 1.3),
        lift=sampler.uniform(0.0, 0.12) if sampler.bernoulli(0.2) else 0.0,
        vignette=sampler.uniform(0.1, 0.6) if sampler.bernoulli(0.3) else 0.0,
        defocus=sampler.uniform(0.3, 1.0) if sampler.bernoulli(0.7) else sampler.uniform(1.0, 3.0),
        shake=sampler.uniform(2.0, 9.0) if sampler.bernoulli(0.12) else 0.0,
        shake_angle=sampler.uniform(0.0, 180.0),
        noise=sampler.uniform(1.0, 4.0) if sampler.bernoulli(0.7) else sampler.uniform(4.0, 14.0),
        quality=sampler.integer(25, 95) if sampler.bernoulli(0.5) else 0,
        glare=glare,
        seed=sampler.seed(),
    )
