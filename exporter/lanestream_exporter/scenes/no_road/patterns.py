"""Flat patterns: walls, floors, cloth, ground. Each is drawn at any size, to be shown as is or in perspective.

Sizes are in pixels of the pattern.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road.colors import BgrColor, gradient, hued, mottled, plain, shaded, tint
from lanestream_exporter.scenes.random_sampler import RandomSampler

Pattern = Callable[[RandomSampler, int, int], Image]
TEXTURE_SIZE: Final = 640  # pixels on the longer side of a surface in a room


def texture(sampler: RandomSampler, pattern: Pattern, across: float, down: float) -> Image:
    """Returns a pattern for a surface of so many meters."""
    scale = TEXTURE_SIZE / max(across, down)
    return pattern(sampler, max(96, round(scale * across)), max(96, round(scale * down)))


def painted(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a painted wall."""
    image = plain(width, height, tint(sampler, 90.0, 245.0, 0.4))
    return mottled(sampler, image, sampler.uniform(0.05, 0.3), 8, 8)


def bricks(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a wall of bricks or stones."""
    size = height / sampler.uniform(6.0, 26.0)
    color = hued(sampler.uniform(0.0, 0.8), sampler.uniform(0.1, 0.7), sampler.uniform(60.0, 220.0))
    image = plain(width, height, tint(sampler, 60.0, 230.0, 0.2))
    shape = size * sampler.uniform(1.5, 3.5), size
    blocks(sampler, image, shape, size * sampler.uniform(0.05, 0.2), 0.5, color)
    return mottled(sampler, image, sampler.uniform(0.1, 0.4), width / 3, height / 3)


def tiles(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns square tiles with joints, or a checkerboard."""
    size = height / sampler.uniform(4.0, 14.0)
    color = tint(sampler, 90.0, 245.0, 0.6)
    joint = shaded(color, sampler.uniform(0.4, 1.4))
    image = plain(width, height, joint)
    blocks(sampler, image, (size, size), size * sampler.uniform(0.02, 0.1), 0.0, color)
    if sampler.bernoulli(0.35):
        other = tint(sampler, 20.0, 240.0, 0.7)
        for row in range(int(height / size) + 1):
            for column in range(row % 2, int(width / size) + 1, 2):
                corner = round(column * size), round(row * size)
                cv2.rectangle(image, corner, (round(corner[0] + size), round(corner[1] + size)), other, cv2.FILLED)
    return mottled(sampler, image, sampler.uniform(0.0, 0.3), width / 4, height / 4)


def planks(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns planks of wood that run from the top to the bottom, with dark or bright joints."""
    bright = sampler.bernoulli(0.5)  # only between many boards of a strong color: a few bright lines on gray are a road
    size = width / sampler.uniform(9.0 if bright else 3.0, 24.0)
    saturation = sampler.uniform(0.45 if bright else 0.2, 0.75)
    color = hued(sampler.uniform(0.2, 0.9), saturation, sampler.uniform(60.0, 230.0))
    joint = shaded(color, sampler.choice((1.5, 2.2) if bright else (0.3, 0.6)))
    turned = plain(height, width, joint)
    length = height * sampler.uniform(0.3, 3.0)
    blocks(sampler, turned, (length, size), size * sampler.uniform(0.02, 0.15), None, color)
    image = np.ascontiguousarray(turned.transpose(1, 0, 2))
    return mottled(sampler, image, sampler.uniform(0.1, 0.5), width / 2, height / 24)


def stripes(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns upright stripes: a curtain, a striped cloth, corrugated metal, organ pipes, bar code."""
    colors = [tint(sampler, 10.0, 250.0) for _ in range(sampler.integer(2, 4))]
    image = plain(width, height, colors[0])
    pitch, x, index = width / sampler.uniform(4.0, 40.0), 0.0, 0
    even = sampler.bernoulli(0.5)
    while x < width:
        step = max(2.0, pitch * (1.0 if even else sampler.uniform(0.2, 1.8)))
        cv2.rectangle(image, (round(x), 0), (round(x + step), height), colors[index % len(colors)], cv2.FILLED)
        x, index = x + step, index + 1
    if sampler.bernoulli(0.5):
        image = np.asarray(cv2.blur(image, (2 * max(1, round(pitch / 4)) + 1, 1)), dtype=np.uint8)
    return mottled(sampler, image, sampler.uniform(0.0, 0.4), width / 8, 8)


def carpet(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a carpet: coarse cloth, often with borders and rows of figures."""
    image = plain(width, height, tint(sampler, 40.0, 200.0))
    inset = 0
    for _ in range(sampler.integer(0, 4)):
        inset += max(1, round(width * sampler.uniform(0.02, 0.1)))
        corners = (inset, inset), (width - inset, height - inset)
        cv2.rectangle(image, *corners, tint(sampler), sampler.choice((1, 2, 6, cv2.FILLED)), cv2.LINE_AA)
    if sampler.bernoulli(0.6):
        step, color = max(8, round(width / sampler.uniform(4.0, 14.0))), tint(sampler)
        sides, turn = sampler.choice((3, 4, 6, 20)), sampler.uniform(0.0, 90.0)
        figure = cv2.ellipse2Poly((0, 0), (step // 3, step // 3), round(turn), 0, 360, 360 // sides)
        for y in range(step // 2, height, step):
            cv2.fillPoly(image, [figure + np.array([x, y]) for x in range(step // 2, width, step)], color, cv2.LINE_AA)
    return mottled(sampler, image, sampler.uniform(0.3, 0.8), width, height)


def ground_cover(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns grass, sand, earth, leaves or snow, seen from above."""
    hue, saturation, value = sampler.choice(
        ((1.6, 0.6, 130.0), (0.7, 0.35, 200.0), (0.4, 0.5, 90.0), (3.5, 0.06, 235.0))
    )
    color = hued(
        hue + sampler.uniform(-0.3, 0.3), saturation * sampler.uniform(0.6, 1.3), value * sampler.uniform(0.7, 1.05)
    )
    rough = 0.3 if saturation < 0.1 else 1.0  # snow is smooth
    image = mottled(sampler, plain(width, height, color), rough * sampler.uniform(0.3, 0.9), width, height)
    return mottled(sampler, image, rough * sampler.uniform(0.1, 0.5), width / 12, height / 12)


def furrows(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a plowed or planted field: soft rows of earth and green from the top to the bottom."""
    count = sampler.integer(8, 40)
    across = np.sin(np.linspace(0.0, np.pi * 2 * count, width) + sampler.uniform(0.0, 6.0)) * 0.5 + 0.5
    low = np.array(hued(sampler.uniform(0.3, 0.7), sampler.uniform(0.3, 0.6), sampler.uniform(50.0, 120.0)))
    high = np.array(hued(sampler.uniform(0.5, 2.0), sampler.uniform(0.3, 0.7), sampler.uniform(80.0, 190.0)))
    row = low + (high - low) * (across ** sampler.uniform(0.5, 2.0))[:, None]
    image = np.repeat(row[None].astype(np.uint8), height, axis=0)
    return mottled(sampler, image, sampler.uniform(0.4, 0.9), width, height)


def blinds(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a window with blinds: bright gaps between level slats."""
    image = gradient(width, height, tint(sampler, 150.0, 255.0, 0.3), tint(sampler, 80.0, 255.0, 0.3))
    slat, pitch = tint(sampler, 30.0, 240.0, 0.4), max(4.0, height / sampler.uniform(6.0, 40.0))
    share = sampler.uniform(0.4, 0.9)
    for y in np.arange(0.0, height, pitch).tolist():
        top, bottom = round(y), round(y + share * pitch)
        cv2.rectangle(image, (0, top), (width, bottom), slat, cv2.FILLED)
        cv2.line(image, (0, bottom), (width, bottom), shaded(slat, 0.6), 1)
    for x in sampler.rng.uniform(0.05, 0.95, sampler.integer(1, 4)).tolist():
        cv2.line(image, (round(x * width), 0), (round(x * width), height), shaded(slat, 0.8), max(1, width // 200))
    return image


def facade(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns a building's front: floors of windows with frames, some lit, and ledges."""
    wall = tint(sampler, 40.0, 230.0, 0.5)
    image = mottled(sampler, plain(width, height, wall), sampler.uniform(0.0, 0.3), width / 4, height / 4)
    floors, columns = sampler.integer(2, 12), sampler.integer(3, 16)
    tall, wide = height / floors, width / columns
    share_x, share_y = sampler.uniform(0.35, 0.9), sampler.uniform(0.4, 0.85)
    glass, frame = tint(sampler, 20.0, 160.0, 0.5), shaded(wall, sampler.choice((0.5, 1.5)))
    for floor in range(floors):
        gains = sampler.rng.uniform(0.5, 1.6, columns).tolist()
        for column, gain in enumerate(gains):
            left, top = (column + 0.5 - share_x / 2) * wide, (floor + 0.5 - share_y / 2) * tall
            box = (round(left), round(top)), (round(left + share_x * wide), round(top + share_y * tall))
            cv2.rectangle(image, *box, shaded(glass, gain), cv2.FILLED)
            cv2.rectangle(image, *box, frame, max(1, round(wide / 16)))
        if share_y < 0.7:
            cv2.line(image, (0, round(floor * tall)), (width, round(floor * tall)), frame, max(1, round(tall / 20)))
    return image


def shelves(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns shelves full of books, boxes or jars."""
    wood = hued(sampler.uniform(0.2, 0.9), sampler.uniform(0.0, 0.6), sampler.uniform(40.0, 230.0))
    image = plain(width, height, shaded(wood, 0.3))
    count = sampler.integer(2, 7)
    tall, board = height / count, max(2, round(height * sampler.uniform(0.01, 0.03)))
    for shelf in range(count):
        foot, x = round((shelf + 1) * tall), 0.0
        while x < width:
            wide = tall * sampler.uniform(0.06, 0.4)
            top = round(foot - tall * sampler.uniform(0.45, 0.9))
            cv2.rectangle(image, (round(x), top), (round(x + 0.92 * wide), foot), tint(sampler), cv2.FILLED)
            x += max(3.0, wide)
        cv2.rectangle(image, (0, foot - board), (width, foot), wood, cv2.FILLED)
    return image


def arches(sampler: RandomSampler, width: int, height: int) -> Image:
    """Returns rows of rounded blocks with gaps: teeth, arcades, cushions."""
    image = plain(width, height, tint(sampler, 30.0, 200.0))
    color = hued(sampler.uniform(0.3, 1.0), sampler.uniform(0.0, 0.4), sampler.uniform(160.0, 250.0))
    rows, count, bend = sampler.integer(1, 3), sampler.integer(4, 14), sampler.uniform(-0.25, 0.25)
    tall, wide = height / rows, width / count
    for row in range(rows):
        for index in range(count):
            x = (index + 0.5) * wide
            y = (row + 0.5) * tall + bend * tall * ((2.0 * x / width - 1.0) ** 2 - 0.5)
            half_x, half_y = max(2, round(0.46 * wide)), max(2, round(sampler.uniform(0.3, 0.42) * tall))
            center = round(x), round(y)
            cv2.ellipse(image, center, (half_x, half_y), 0.0, 0.0, 360.0, color, cv2.FILLED, cv2.LINE_AA)
            cv2.ellipse(image, center, (half_x, half_y), 0.0, 0.0, 360.0, shaded(color, 0.6), 1, cv2.LINE_AA)
    return mottled(sampler, image, sampler.uniform(0.1, 0.4), width / 6, height / 6)


def blocks(
    sampler: RandomSampler, image: Image, block: tuple[float, float], joint: float, shift: float | None, color: BgrColor
) -> None:
    """Draws rows of blocks of about one color. Every other row is moved by `shift` blocks, or each at random."""
    height, width = image.shape[:2]
    across, down = max(3.0, block[0]), max(3.0, block[1])
    gap, spread = max(1, round(joint)), sampler.uniform(0.02, 0.25)
    for row in range(int(height / down) + 1):
        offset = sampler.uniform(0.0, 1.0) if shift is None else shift * (row % 2)
        gains = 1.0 + spread * sampler.rng.uniform(-1.0, 1.0, int(width / across) + 2)
        for column, gain in enumerate(gains.tolist()):
            left, top = round((column - offset) * across), round(row * down)
            right, bottom = round((column + 1 - offset) * across) - gap, round((row + 1) * down) - gap
            cv2.rectangle(image, (left, top), (right - 1, bottom - 1), shaded(color, gain), cv2.FILLED)
