"""Things near the camera: sheets, rails, faces, food, the inside of a vehicle."""

from __future__ import annotations

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road import patterns, prints
from lanestream_exporter.scenes.no_road.camera import TurnedCamera, sample_turns, vector
from lanestream_exporter.scenes.no_road.colors import BgrColor, defocused, hued, mottled, plain, shaded, tint
from lanestream_exporter.scenes.no_road.flat import ALL_PATTERNS, pattern
from lanestream_exporter.scenes.no_road.outdoors import sky
from lanestream_exporter.scenes.no_road.patterns import painted, texture
from lanestream_exporter.scenes.no_road.rooms import room
from lanestream_exporter.scenes.random_sampler import RandomSampler


def sheet(sampler: RandomSampler, image: Image) -> Image:
    """Draws a flat thing held in front of the camera, oblique, before something else."""
    height, width = image.shape[:2]
    image[:] = defocused(sampler, sampler.choice(ALL_PATTERNS)(sampler, width, height))
    turns = sampler.normal(20.0), sampler.normal(25.0), sampler.normal(12.0)
    camera = TurnedCamera.looking(image, sampler.uniform(40.0, 80.0), turns)
    across, down = sampler.uniform(0.8, 2.2), sampler.uniform(0.7, 1.8)
    held = texture(sampler, sampler.choice(ALL_PATTERNS), across, down)
    corner = vector(sampler.normal(0.2) - across / 2, sampler.normal(0.15) - down / 2, sampler.uniform(1.0, 1.8))
    camera.show(held, corner, vector(across, 0.0, 0.0), vector(0.0, down, 0.0))
    return image


def rails(sampler: RandomSampler, image: Image) -> Image:
    """Draws bars near the camera, before something else: rails of a bed or a balcony, a ladder, a fence, cables."""
    background = sampler.choice((room, sky, pattern, portrait))
    background(sampler, image)
    if sampler.bernoulli(0.5):
        image[:] = defocused(sampler, image)
    camera = TurnedCamera.looking(image, sampler.uniform(45.0, 90.0), sample_turns(sampler, 25.0, (-10.0, 25.0), 6.0))
    color, thick = tint(sampler, 20.0, 255.0, 0.4), sampler.uniform(0.01, 0.06)
    x, foot, far = sampler.uniform(-0.8, 0.8), sampler.uniform(0.1, 0.8), sampler.uniform(1.5, 5.0)
    top = foot - sampler.uniform(0.3, 1.2)
    low, high = vector(x, foot, 0.3), vector(x + sampler.normal(0.3), top, 0.3)
    along = vector(sampler.normal(0.8), 0.0, far)
    for start in (low, high, low + 0.5 * (high - low))[: sampler.integer(2, 3)]:
        camera.bar(start, start + along, thick, color)
    posts = sampler.integer(0, 16)
    for share in np.linspace(0.0, 1.0, posts).tolist():
        camera.bar(low + share * along, high + share * along, 0.7 * thick, shaded(color, sampler.uniform(0.8, 1.1)))
    if sampler.bernoulli(0.4):
        other = vector(sampler.choice((-1.0, 1.0)) * sampler.uniform(0.4, 1.2), 0.0, 0.0)
        for start in (low, high):
            camera.bar(start + other, start + other + along, thick, color)
    return image


def portrait(sampler: RandomSampler, image: Image) -> Image:
    """Draws a head and shoulders before something out of focus."""
    height, width = image.shape[:2]
    image[:] = defocused(sampler, sampler.choice(ALL_PATTERNS)(sampler, width, height))
    for _ in range(sampler.integer(1, 3)):
        skin = hued(sampler.uniform(0.3, 0.7), sampler.uniform(0.2, 0.6), sampler.uniform(80.0, 245.0))
        size = min(width, height) * sampler.uniform(0.15, 0.35)
        x, y = sampler.uniform(0.2, 0.8) * width, sampler.uniform(0.3, 0.6) * height
        parts: list[tuple[float, float, float, float, BgrColor]] = [
            (0.0, 2.4, 1.8, 1.5, tint(sampler)),
            (0.0, -0.2, 0.85, 1.1, tint(sampler, 10.0, 180.0, 0.7)),
            (0.0, 0.0, 0.72, 1.0, skin),
            *((side, -0.15, 0.13, 0.07, (235.0, 235.0, 235.0)) for side in (-0.3, 0.3)),
            *((side, -0.15, 0.06, 0.06, (40.0, 40.0, 40.0)) for side in (-0.3, 0.3)),
            (0.0, 0.2, 0.08, 0.2, shaded(skin, 0.85)),
            (0.0, 0.55, 0.3, 0.08, (90.0, 80.0, 170.0)),
        ]
        for dx, dy, across, down, color in parts:
            _ellipse(image, (x + dx * size, y + dy * size), (across * size, down * size), color)
    return image


def food(sampler: RandomSampler, image: Image) -> Image:
    """Draws plates with food on a cloth or a table, from above."""
    height, width = image.shape[:2]
    cloth = sampler.choice((patterns.planks, patterns.tiles, patterns.stripes, painted))
    image[:] = cloth(sampler, width, height)
    for _ in range(sampler.integer(1, 4)):
        radius = min(width, height) * sampler.uniform(0.15, 0.5)
        x, y, flat = sampler.uniform(0.1, 0.9) * width, sampler.uniform(0.1, 0.9) * height, sampler.uniform(0.4, 1.0)
        plate = tint(sampler, 120.0, 250.0, 0.3)
        for share, gain in ((1.0, 0.9), (0.92, 1.0), (0.7, 0.93)):
            _ellipse(image, (x, y), (share * radius, share * flat * radius), shaded(plate, gain))
        for dx, dy in sampler.rng.uniform(-0.45, 0.45, (sampler.integer(3, 30), 2)).tolist():
            radii = radius * sampler.uniform(0.05, 0.25), radius * sampler.uniform(0.05, 0.25)
            color = hued(sampler.uniform(0.0, 2.2), sampler.uniform(0.3, 0.9), sampler.uniform(60.0, 240.0))
            _ellipse(image, (x + dx * radius, y + flat * dy * radius), radii, color, sampler.uniform(0.0, 180.0))
    return mottled(sampler, image, 0.3, width / 4, height / 4)


def dashboard(sampler: RandomSampler, image: Image) -> Image:
    """Draws the inside of a vehicle; its windows are dark, blind or show the sky."""
    height, width = image.shape[:2]
    sky(sampler, image)
    if sampler.bernoulli(0.6):
        image[:] = plain(width, height, tint(sampler, 0.0, 255.0, 0.1))
    trim = tint(sampler, 15.0, 120.0, 0.3)
    edge = height * sampler.uniform(0.2, 0.55)
    across = np.linspace(0.0, 1.0, 24)
    rows = edge + height * sampler.uniform(-0.15, 0.15) * (2.0 * across - 1.0) ** 2
    outline = np.concatenate([np.stack([across * width, rows], axis=1), [[width, height], [0, height]]])
    cv2.fillPoly(image, [outline.round().astype(np.int32)], trim, cv2.LINE_AA)
    for side in (0.0, 1.0):  # the pillars
        inside = abs(side - sampler.uniform(0.05, 0.2))
        pillar = np.array([[side, 0.0], [inside, 0.0], [side, edge / height]]) * (width, height)
        cv2.fillPoly(image, [pillar.round().astype(np.int32)], shaded(trim, 0.7), cv2.LINE_AA)
    image[:] = mottled(sampler, image, 0.2, width / 2, height / 2)
    for _ in range(sampler.integer(0, 3)):
        left, top = sampler.uniform(0.0, 0.8) * width, edge + sampler.uniform(0.1, 0.6) * (height - edge)
        wide, tall = max(16, round(0.2 * width)), max(16, round(0.2 * height))
        panel = sampler.choice((prints.screen, prints.keyboard, patterns.blinds))(sampler, wide, tall)
        part = image[round(top) : round(top) + tall, round(left) : round(left) + wide]
        part[:] = panel[: part.shape[0], : part.shape[1]]
    if sampler.bernoulli(0.7):
        hub = round(sampler.uniform(0.1, 0.7) * width), round(sampler.uniform(0.75, 1.0) * height)
        radius, wheel = round(0.4 * min(width, height)), tint(sampler, 10.0, 90.0, 0.3)
        thick = max(1, radius // 6)
        cv2.circle(image, hub, radius, wheel, thick, cv2.LINE_AA)
        for angle in (0.2, 2.9, 1.6):
            end = round(hub[0] + radius * np.cos(angle)), round(hub[1] + radius * np.sin(angle))
            cv2.line(image, hub, end, wheel, thick, cv2.LINE_AA)
    return image


def _ellipse(
    image: Image, center: tuple[float, float], radii: tuple[float, float], color: BgrColor, turn: float = 0.0
) -> None:
    at, axes = (round(center[0]), round(center[1])), (max(1, round(radii[0])), max(1, round(radii[1])))
    cv2.ellipse(image, at, axes, turn, 0.0, 360.0, color, cv2.FILLED, cv2.LINE_AA)
