"""The sky by day and by night, meadows, fields, water and woods."""

from __future__ import annotations

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road import patterns
from lanestream_exporter.scenes.no_road.camera import TurnedCamera, vector
from lanestream_exporter.scenes.no_road.colors import (
    BgrColor,
    gradient,
    hued,
    mottled,
    plain,
    shaded,
    smooth_noise,
    tint,
    with_gain,
)
from lanestream_exporter.scenes.no_road.patterns import TEXTURE_SIZE, Pattern
from lanestream_exporter.scenes.random_sampler import RandomSampler


def sky(sampler: RandomSampler, image: Image) -> Image:
    """Draws a sky with clouds, at times with cables before it."""
    height, width = image.shape[:2]
    zenith = hued(sampler.uniform(3.2, 4.0), sampler.uniform(0.1, 0.8), sampler.uniform(60.0, 240.0))
    skyline = hued(sampler.uniform(0.0, 4.0), sampler.uniform(0.0, 0.4), sampler.uniform(150.0, 255.0))
    image[:] = gradient_sky = gradient(width, height, zenith, skyline)
    noise = smooth_noise(sampler, width, height, sampler.uniform(60.0, 300.0), sampler.uniform(40.0, 200.0))
    level, contrast = sampler.uniform(60.0, 190.0), sampler.uniform(1.0, 4.0)
    cover = np.clip((np.arange(256.0) - level) * contrast, 0.0, 255.0).astype(np.uint8)
    share = np.asarray(cv2.cvtColor(cv2.LUT(noise, cover), cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    image[:] = cv2.add(cv2.multiply(gradient_sky, cv2.bitwise_not(share), scale=1.0 / 255.0), with_gain(share, 0.95))
    for _ in range(sampler.integer(1, 6) if sampler.bernoulli(0.3) else 0):  # cables
        ends = (sampler.rng.uniform(-0.1, 1.1, (2, 2)) * (width, height)).astype(int).tolist()
        cv2.line(image, ends[0], ends[1], (30.0, 30.0, 30.0), max(1, width // 300), cv2.LINE_AA)
    return image


def meadow(sampler: RandomSampler, image: Image) -> Image:
    """Draws grass, sand, earth or snow up to the horizon."""
    return _open_ground(sampler, image, patterns.ground_cover, 40.0)


def field(sampler: RandomSampler, image: Image) -> Image:
    """Draws a plowed or planted field up to the horizon."""
    return _open_ground(sampler, image, patterns.furrows, 25.0)


def _open_ground(sampler: RandomSampler, image: Image, pattern: Pattern, reach: float) -> Image:
    """Draws ground of one pattern up to the horizon under a sky, with a wood or hills in the distance."""
    sky(sampler, image)
    down = sampler.uniform(-8.0, 20.0)
    camera = TurnedCamera.looking(image, sampler.uniform(45.0, 85.0), (sampler.normal(30.0), down, sampler.normal(3.0)))
    texture = pattern(sampler, TEXTURE_SIZE, TEXTURE_SIZE)
    foot, near = sampler.uniform(0.6, 3.0), reach * sampler.uniform(0.3, 1.0)
    size = 2.0 * near
    camera.fill(
        np.array([[-500, foot, -500], [500, foot, -500], [500, foot, 500], [-500, foot, 500.0]]), _mean(texture)
    )
    camera.show(texture, vector(-near, foot, near), vector(size, 0.0, 0.0), vector(0.0, 0.0, -size))
    if sampler.bernoulli(0.7):
        color = hued(sampler.uniform(1.0, 4.0), sampler.uniform(0.1, 0.6), sampler.uniform(30.0, 150.0))
        heights = sampler.uniform(0.02, 0.2) * near * (1.0 + sampler.rng.uniform(0.0, 0.6, 60))
        angles = np.linspace(-np.pi, np.pi, 60)
        ring = np.stack([0.98 * near * np.sin(angles), np.full(60, foot), 0.98 * near * np.cos(angles)], axis=1)
        raised = ring - heights[:, None] * (0.0, 1.0, 0.0)
        for index in range(59):
            corners = np.stack([ring[index], ring[index + 1], raised[index + 1], raised[index]])
            camera.fill(corners, shaded(color, 0.98 + 0.04 * (index % 2)))
    return image


def _mean(image: Image) -> BgrColor:
    blue, green, red = image.reshape(-1, 3)[::97].mean(axis=0).tolist()
    return blue, green, red


def water(sampler: RandomSampler, image: Image) -> Image:
    """Draws a lake or the sea under a sky."""
    sky(sampler, image)
    height, width = image.shape[:2]
    horizon = round(height * sampler.uniform(0.0, 0.7))
    lower = image[horizon:]
    color = hued(sampler.uniform(2.6, 4.0), sampler.uniform(0.1, 0.5), sampler.uniform(60.0, 190.0))
    lower[:] = gradient(width, height - horizon, shaded(color, 1.3), color)
    lower[:] = mottled(sampler, lower, sampler.uniform(0.3, 0.9), 40, 400)
    return image


def forest(sampler: RandomSampler, image: Image) -> Image:
    """Draws trunks before leaves."""
    height, width = image.shape[:2]
    leaf = hued(sampler.uniform(0.8, 2.3), sampler.uniform(0.3, 0.8), sampler.uniform(50.0, 170.0))
    image[:] = mottled(sampler, plain(width, height, leaf), 0.9, 400, 400)
    bark = hued(sampler.uniform(0.2, 0.8), sampler.uniform(0.05, 0.5), sampler.uniform(30.0, 220.0))
    for size in np.sort(sampler.rng.uniform(0.006, 0.08, sampler.integer(3, 30))).tolist():
        x, lean, half = sampler.uniform(0.0, width), sampler.normal(0.04) * height, size * width / 2
        foot = height * min(1.1, 0.5 + 8.0 * size)
        trunk = np.array([[x - half, foot], [x + half, foot], [x + lean + 0.6 * half, 0], [x + lean - 0.6 * half, 0]])
        gain = sampler.uniform(0.5, 1.2)
        cv2.fillPoly(image, [np.round(trunk).astype(np.int32)], shaded(bark, gain), cv2.LINE_AA)
    return np.asarray(mottled(sampler, image, 0.6, 300, 300), dtype=np.uint8)


def night(sampler: RandomSampler, image: Image) -> Image:
    """Draws a night sky with stars, or a dark town with lit windows and lamps."""
    height, width = image.shape[:2]
    image[:] = gradient(width, height, tint(sampler, 0.0, 30.0), tint(sampler, 0.0, 60.0))
    if sampler.bernoulli(0.5):
        for _ in range(sampler.integer(2, 9)):
            wide, tall = round(width * sampler.uniform(0.08, 0.3)), round(height * sampler.uniform(0.2, 0.7))
            left = round(sampler.uniform(-0.1, 1.0) * width)
            house = with_gain(patterns.facade(sampler, max(8, wide), max(8, tall)), sampler.uniform(0.1, 0.6))
            part = image[height - tall :, max(0, left) : max(0, left) + wide]
            part[:] = house[: part.shape[0], : part.shape[1]]
    glow = np.zeros_like(image)
    for x, y in (sampler.rng.random((sampler.integer(3, 60), 2)) * (width, height)).round().astype(int).tolist():
        radius = max(1, round(width * sampler.uniform(0.0, 0.012)))
        cv2.circle(glow, (x, y), radius, tint(sampler, 120.0, 255.0, 0.7), cv2.FILLED, cv2.LINE_AA)
    size = 2 * max(1, width // 60) + 1
    image[:] = cv2.add(cv2.add(image, glow), with_gain(np.asarray(cv2.blur(glow, (size, size)), dtype=np.uint8), 2.0))
    return image
