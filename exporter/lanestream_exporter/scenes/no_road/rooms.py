"""Rooms, corridors, stairs, floors and tables, with the walls around them."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road import patterns, prints
from lanestream_exporter.scenes.no_road.camera import TurnedCamera, sample_turns, vector
from lanestream_exporter.scenes.no_road.colors import hued, shaded, tint, with_gain
from lanestream_exporter.scenes.no_road.patterns import TEXTURE_SIZE, painted, texture
from lanestream_exporter.scenes.random_sampler import RandomSampler

_FLOORS: Final = (patterns.planks, patterns.planks, patterns.tiles, patterns.carpet, patterns.stripes)
_WALLS: Final = (patterns.bricks, patterns.tiles, patterns.stripes, patterns.shelves, patterns.planks, patterns.facade)
_CLUTTER: Final = (prints.page, prints.keyboard, prints.sign, prints.table, prints.chart, patterns.carpet)


def corridor(sampler: RandomSampler, image: Image) -> Image:
    """Draws a corridor, seen along it."""
    camera = TurnedCamera.looking(image, sampler.uniform(45.0, 95.0), sample_turns(sampler, 6.0, (-25.0, 20.0)))
    half = sampler.uniform(0.7, 2.2)
    shift = sampler.uniform(-0.5, 0.5) * half
    _draw_room(sampler, camera, (shift - half, shift + half), sampler.uniform(0.8, 2.0), sampler.uniform(4.0, 25.0))
    return image


def room(sampler: RandomSampler, image: Image) -> Image:
    """Draws a room with up to four pieces of furniture."""
    view, foot, depth = sampler.uniform(50.0, 95.0), sampler.uniform(0.8, 1.8), sampler.uniform(2.5, 7.0)
    pitch = _downward(sampler, image, view, -5.0, (foot, depth))
    camera = TurnedCamera.looking(image, view, (sampler.normal(20.0), pitch, sampler.normal(2.0)))
    left, right = sampler.uniform(-4.0, -1.0), sampler.uniform(1.0, 4.0)
    _draw_room(sampler, camera, (left, right), foot, depth)
    for z in sorted(sampler.rng.uniform(0.9, depth, sampler.integer(0, 4)).tolist(), reverse=True):
        x, size = sampler.uniform(left, right), sampler.rng.uniform(0.3, 1.8, 3)
        low = vector(x - size[0] / 2, foot - 0.6 * size[1], z)
        pattern = sampler.choice((patterns.planks, patterns.carpet, patterns.stripes, patterns.shelves, painted))
        high = vector(x + size[0] / 2, foot, min(depth, z + size[2]))
        camera.box(low, high, pattern(sampler, 160, 160), tint(sampler, 30.0, 220.0, 0.5))
    return image


def floor(sampler: RandomSampler, image: Image) -> Image:
    """Draws a floor that fills most of the picture, up to a wall."""
    view, foot, depth = sampler.uniform(45.0, 90.0), sampler.uniform(0.4, 1.8), sampler.uniform(2.0, 8.0)
    half, pitch = sampler.uniform(2.0, 6.0), _downward(sampler, image, view, 5.0, (foot, depth))
    camera = TurnedCamera.looking(image, view, (sampler.normal(15.0), pitch, sampler.normal(4.0)))
    _draw_room(sampler, camera, (-half, half), foot, depth)
    for _ in range(sampler.integer(0, 2)):  # a rug, a mat, a poster
        across, along = sampler.uniform(0.5, 2.0), sampler.uniform(0.5, 2.5)
        corner = vector(sampler.uniform(-1.5, 1.0), foot - 0.01, sampler.uniform(1.5, depth))
        rug = sampler.choice((*_CLUTTER, patterns.carpet, patterns.stripes))(sampler, 300, 300)
        camera.show(rug, corner, vector(across, 0.0, 0.0), vector(0.0, 0.0, -along))
    return image


def tabletop(sampler: RandomSampler, image: Image) -> Image:
    """Draws a table seen from a seat, with sheets, keyboards and plates on it, and the wall behind."""
    height, width = image.shape[:2]
    image[:] = sampler.choice((painted, patterns.bricks, patterns.shelves, patterns.blinds, patterns.stripes))(
        sampler, width, height
    )
    view, foot, depth = sampler.uniform(45.0, 85.0), sampler.uniform(0.2, 0.7), sampler.uniform(0.7, 2.0)
    half, pitch = sampler.uniform(0.4, 1.5), _downward(sampler, image, view, 8.0, (foot, depth))
    camera = TurnedCamera.looking(image, view, (sampler.normal(12.0), pitch, sampler.normal(4.0)))
    top = sampler.choice((patterns.planks, patterns.planks, painted, patterns.tiles, patterns.stripes))
    board = top(sampler, TEXTURE_SIZE, 400)
    camera.show(board, vector(-half, foot, depth), vector(2.0 * half, 0.0, 0.0), vector(0.0, 0.0, -depth - 0.3))
    if sampler.bernoulli(0.6):
        rim = hued(sampler.uniform(0.0, 6.0), sampler.uniform(0.0, 0.5), sampler.uniform(30.0, 250.0))
        for side in (-half, half):
            camera.bar(vector(side, foot, depth), vector(side, foot, 0.0), sampler.uniform(0.01, 0.06), rim)
    for _ in range(sampler.integer(0, 4)):
        turn, size = sampler.normal(0.5), sampler.uniform(0.2, 0.5)
        across = size * vector(np.cos(turn), 0.0, np.sin(turn))
        down = size * sampler.uniform(0.3, 1.4) * vector(np.sin(turn), 0.0, -np.cos(turn))
        corner = vector(sampler.uniform(-0.8, 0.5) * half, foot - 0.005, sampler.uniform(0.4, depth))
        camera.show(sampler.choice(_CLUTTER)(sampler, 300, 260), corner, across, down)
    return image


def stairs(sampler: RandomSampler, image: Image) -> Image:
    """Draws stairs that rise in front of the camera, between walls."""
    camera = TurnedCamera.looking(image, sampler.uniform(50.0, 90.0), sample_turns(sampler, 15.0, (-15.0, 10.0)))
    half, foot = sampler.uniform(0.6, 3.0), sampler.uniform(1.0, 1.7)
    _draw_room(sampler, camera, (-half, half), foot, sampler.uniform(6.0, 9.0))
    rise, run, near = sampler.uniform(0.13, 0.2), sampler.uniform(0.25, 0.4), sampler.uniform(1.0, 2.5)
    tread, count = tint(sampler, 90.0, 240.0, 0.5), sampler.integer(5, 16)
    nosing = shaded(tread, sampler.choice((0.6, 1.4))) if sampler.bernoulli(0.6) else tread
    for step in range(count, 0, -1):
        z, y = near + step * run, foot - step * rise
        ends = np.array([[-half, y, z], [half, y, z]])
        deep, low = vector(0.0, 0.0, run), vector(0.0, rise, 0.0)
        camera.fill(np.concatenate([ends, ends[::-1] + deep]), tread)
        camera.fill(np.concatenate([ends, ends[::-1] + low]), shaded(tread, 0.6))
        camera.bar(ends[0], ends[1], 0.03, nosing)
    if sampler.bernoulli(0.6):
        rail, side = tint(sampler, 20.0, 240.0, 0.4), sampler.choice((-0.9, 0.9)) * half
        start, end = vector(side, foot - 0.9, near), vector(side, foot - 0.9 - count * rise, near + count * run)
        camera.bar(start, end, 0.05, rail)
        for share in np.linspace(0.0, 1.0, count).tolist():
            post = start + share * (end - start)
            camera.bar(post, post + vector(0.0, 0.9, 0.0), 0.02, rail)
    return image


def _draw_room(
    sampler: RandomSampler, camera: TurnedCamera, across: tuple[float, float], foot: float, depth: float
) -> None:
    """Draws floor, walls and ceiling of a room from x = across[0] to across[1], `foot` meters above its floor."""
    tall, behind = foot + sampler.uniform(0.5, 1.8), -1.5
    left, right = across
    wide, long = right - left, depth - behind
    x, y, z = vector(wide, 0.0, 0.0), vector(0.0, tall, 0.0), vector(0.0, 0.0, long)
    top = foot - tall
    ground = texture(sampler, sampler.choice(_FLOORS), wide, long)
    if sampler.bernoulli(0.3):
        ground = np.ascontiguousarray(ground[::-1].transpose(1, 0, 2))  # planks across the room
    camera.show(ground, vector(left, foot, depth), x, -z)
    camera.show(with_gain(_ceiling(sampler, wide, long), sampler.uniform(0.6, 1.1)), vector(left, top, behind), x, z)
    camera.show(_wall(sampler, wide, tall), vector(left, top, depth), x, y)
    side = _wall(sampler, long, tall)
    camera.show(with_gain(side, sampler.uniform(0.5, 1.0)), vector(left, top, behind), z, y)
    side = _wall(sampler, long, tall) if sampler.bernoulli(0.4) else side
    camera.show(with_gain(side, sampler.uniform(0.5, 1.0)), vector(right, top, depth), -z, y)


def _wall(sampler: RandomSampler, across: float, tall: float) -> Image:
    """Returns a wall with a skirting board and some doors, windows or pictures on it."""
    pattern = sampler.choice(_WALLS) if sampler.bernoulli(0.35) else painted
    wall = texture(sampler, pattern, across, tall)
    height, width = wall.shape[:2]
    per_meter = height / tall
    for x in np.arange(sampler.uniform(0.3, 2.0), across, sampler.uniform(1.2, 4.0)).tolist():
        wide, left = round(sampler.uniform(0.6, 1.2) * per_meter), round(x * per_meter)
        top = height - round(min(0.85 * tall, 2.1) * per_meter)
        foot = height if sampler.bernoulli(0.5) else round(0.6 * height)
        color = tint(sampler, 30.0, 240.0, 0.6)
        cv2.rectangle(wall, (left, top), (left + wide, foot), color, cv2.FILLED)
        cv2.rectangle(wall, (left, top), (left + wide, foot), shaded(color, 0.6), max(1, round(0.05 * per_meter)))
    if sampler.bernoulli(0.6):
        board = max(1, round(sampler.uniform(0.05, 0.2) * per_meter))
        cv2.rectangle(wall, (0, height - board), (width, height), tint(sampler, 20.0, 250.0, 0.4), cv2.FILLED)
    return wall


def _ceiling(sampler: RandomSampler, across: float, along: float) -> Image:
    """Returns a ceiling with lamps in rows, as long tubes or as squares."""
    ceiling = texture(sampler, sampler.choice((painted, painted, patterns.tiles, patterns.planks)), across, along)
    height, width = ceiling.shape[:2]
    lamp_x, lamp_y = sampler.uniform(0.03, 0.2) * width, sampler.choice((0.3, 1.0, 4.0))
    columns = sampler.choice(((0.5,), (0.25, 0.75), (0.2, 0.5, 0.8)))
    for y in np.arange(0.0, height, height / sampler.uniform(2.0, 10.0)).tolist():
        for x in columns:
            left, wide = round(x * width - lamp_x / 2), max(2, round(lamp_x))
            tall = max(2, round(lamp_x * lamp_y))
            cv2.rectangle(ceiling, (left, round(y)), (left + wide, round(y) + tall), (250.0, 253.0, 255.0), cv2.FILLED)
    return ceiling


def _downward(
    sampler: RandomSampler, image: Image, field_of_view: float, least: float, edge: tuple[float, float]
) -> float:
    """Returns an angle to look down at, in degrees, so that the far edge of a floor or table stays in the picture.

    A floor without its end could be a road. `edge`: how far below and ahead the edge is, meters.
    """
    height, width = image.shape[:2]
    half = np.arctan(height / max(width, height) * np.tan(np.radians(field_of_view) / 2.0))
    most = float(np.degrees(0.8 * half + np.arctan(edge[0] / edge[1])))
    return sampler.uniform(min(least, most), most)
