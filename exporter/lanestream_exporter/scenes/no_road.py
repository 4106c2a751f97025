"""Pictures that show no road: pages, walls, rooms, landscapes, faces. A detector must find nothing in them.

Many are hard on purpose: floors of planks, corridors, keyboards and rails show bright bars that meet at one point, as
lane lines do. None shows a carriageway, a path or a parking lot: even unmarked ones have edges that are boundaries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.view import Image
from lanestream_exporter.scenes import patterns
from lanestream_exporter.scenes.lens import Glare, Lens, develop
from lanestream_exporter.scenes.patterns import BgrColor, Pattern, hued, mottled, plain, shaded, smooth_noise, tint
from lanestream_exporter.scenes.random_sampler import RandomSampler

_NEAREST: Final = 0.05  # distance in front of the camera from which things are drawn, meters
_SUBPIXELS: Final = 4  # binary digits after the point of the corners of polygons
_FARTHEST_CORNER: Final = 2.0**28  # OpenCV overflows beyond, fixed-point pixels
_TEXTURE_SIZE: Final = 640  # pixels on the longer side of a surface in a room

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class _Eye:
    """A turned pinhole camera at the origin and the image that it fills. World: x right, y down, z ahead, meters."""

    image: Image
    projection: Vector  # (3, 3), from world points to homogeneous pixels

    @classmethod
    def looking(cls, image: Image, field_of_view: float, turns: tuple[float, float, float]) -> _Eye:
        """Returns a camera turned right, down and about its axis by three angles in degrees."""
        height, width = image.shape[:2]
        focal = max(width, height) / (2.0 * np.tan(np.radians(field_of_view) / 2.0))
        inner = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
        right, down, roll = np.radians(turns)
        about_y = [[np.cos(right), 0.0, -np.sin(right)], [0.0, 1.0, 0.0], [np.sin(right), 0.0, np.cos(right)]]
        about_x = [[1.0, 0.0, 0.0], [0.0, np.cos(down), -np.sin(down)], [0.0, np.sin(down), np.cos(down)]]
        about_z = [[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]]
        return cls(image, inner @ about_z @ about_x @ about_y)

    def outline(self, corners: Vector) -> NDArray[np.int32]:
        """Returns the part of a flat polygon (N, 3) in front of the camera, as (M, 2) fixed-point pixels."""
        points = corners @ self.projection.T
        kept = []
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            if start[2] >= _NEAREST:
                kept.append(start)
            if (start[2] >= _NEAREST) != (end[2] >= _NEAREST):
                kept.append(start + (end - start) * (_NEAREST - start[2]) / (end[2] - start[2]))
        if not kept:
            return np.zeros((0, 2), np.int32)
        visible = np.array(kept)
        pixels = visible[:, :2] / visible[:, 2:] * 2**_SUBPIXELS
        return np.asarray(np.clip(pixels, -_FARTHEST_CORNER, _FARTHEST_CORNER).round(), dtype=np.int32)

    def show(self, texture: Image, corner: Vector, across: Vector, down: Vector) -> None:
        """Draws a texture on a parallelogram: its top left corner, and the vectors along its top and its left side."""
        outline = self.outline(np.stack([corner, corner + across, corner + across + down, corner + down]))
        height, width = self.image.shape[:2]
        to_pixels = self.projection @ np.stack([across / texture.shape[1], down / texture.shape[0], corner], axis=1)
        if len(outline) < 3 or abs(np.linalg.det(to_pixels)) < 1e-9:
            return
        pixels = outline >> _SUBPIXELS
        left, top = np.maximum(pixels.min(axis=0), 0).tolist()
        right, bottom = np.minimum(pixels.max(axis=0) + 2, (width, height)).tolist()
        if left >= right or top >= bottom:
            return
        region = self.image[top:bottom, left:right]
        moved = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ to_pixels
        size = right - left, bottom - top
        seen = cv2.warpPerspective(texture, moved, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        mask = np.zeros(region.shape[:2], np.uint8)
        shift = np.array([left, top]) << _SUBPIXELS
        cv2.fillPoly(mask, [(outline - shift).astype(np.int32)], 255, cv2.LINE_8, _SUBPIXELS)
        cv2.copyTo(seen, mask, region)

    def fill(self, corners: Vector, color: BgrColor) -> None:
        """Draws a flat polygon (N, 3) of one color."""
        outline = self.outline(corners)
        if len(outline) >= 3:
            cv2.fillPoly(self.image, [outline], color, cv2.LINE_AA, _SUBPIXELS)

    def bar(self, start: Vector, end: Vector, thickness: float, color: BgrColor) -> None:
        """Draws a straight bar that is about `thickness` meters thick."""
        side = np.cross(end - start, (start + end) / 2.0)
        side *= thickness / (2.0 * np.linalg.norm(side) + 1e-9)
        self.fill(np.stack([start - side, start + side, end + side, end - side]), color)

    def box(self, low: Vector, high: Vector, texture: Image, color: BgrColor) -> None:
        """Draws an upright box between two corners: the texture on its top and front, one color on its sides."""
        size = high - low
        x, y, z = np.diag(size)
        for sideways, seen in ((low[0], low[0] > 0.0), (high[0], high[0] < 0.0)):
            if seen:
                corner = np.array([sideways, low[1], low[2]])
                self.fill(np.stack([corner, corner + z, corner + z + y, corner + y]), shaded(color, 0.6))
        if low[1] > 0.0:
            self.show(texture, low + z, x, -z)
        self.show(shade(texture, 0.75), low, x, y)


def shade(image: Image, gain: float) -> Image:
    """Returns the image, brighter or darker."""
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain), dtype=np.uint8)


def _vector(x: float, y: float, z: float) -> Vector:
    return np.array([x, y, z])


def _texture(sampler: RandomSampler, pattern: Pattern, across: float, down: float) -> Image:
    """Returns a pattern for a surface of so many meters."""
    scale = _TEXTURE_SIZE / max(across, down)
    return pattern(sampler, max(96, round(scale * across)), max(96, round(scale * down)))


_FLOORS: Final = (patterns.planks, patterns.planks, patterns.tiles, patterns.carpet, patterns.stripes)
_WALLS: Final = (patterns.bricks, patterns.tiles, patterns.stripes, patterns.shelves, patterns.planks, patterns.facade)
_CLUTTER: Final = (patterns.page, patterns.keyboard, patterns.sign, patterns.table, patterns.chart, patterns.carpet)


def _painted(sampler: RandomSampler, width: int, height: int) -> Image:
    """A painted wall."""
    image = plain(width, height, tint(sampler, 90.0, 245.0, 0.4))
    return mottled(sampler, image, sampler.uniform(0.05, 0.3), 8, 8)


def _wall(sampler: RandomSampler, across: float, tall: float) -> Image:
    """Returns a wall with a skirting board and some doors, windows or pictures on it."""
    pattern = sampler.choice(_WALLS) if sampler.bernoulli(0.35) else _painted
    wall = _texture(sampler, pattern, across, tall)
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
    ceiling = _texture(sampler, sampler.choice((_painted, _painted, patterns.tiles, patterns.planks)), across, along)
    height, width = ceiling.shape[:2]
    lamp_x, lamp_y = sampler.uniform(0.03, 0.2) * width, sampler.choice((0.3, 1.0, 4.0))
    columns = sampler.choice(((0.5,), (0.25, 0.75), (0.2, 0.5, 0.8)))
    for y in np.arange(0.0, height, height / sampler.uniform(2.0, 10.0)).tolist():
        for x in columns:
            left, wide = round(x * width - lamp_x / 2), max(2, round(lamp_x))
            tall = max(2, round(lamp_x * lamp_y))
            cv2.rectangle(ceiling, (left, round(y)), (left + wide, round(y) + tall), (250.0, 253.0, 255.0), cv2.FILLED)
    return ceiling


def _draw_room(sampler: RandomSampler, eye: _Eye, across: tuple[float, float], foot: float, depth: float) -> None:
    """Draws floor, walls and ceiling of a room from x = across[0] to across[1]; the floor lies `foot` below the eye."""
    tall, behind = foot + sampler.uniform(0.5, 1.8), -1.5
    left, right = across
    wide, long = right - left, depth - behind
    x, y, z = _vector(wide, 0.0, 0.0), _vector(0.0, tall, 0.0), _vector(0.0, 0.0, long)
    top = foot - tall
    floor = _texture(sampler, sampler.choice(_FLOORS), wide, long)
    if sampler.bernoulli(0.3):
        floor = np.ascontiguousarray(floor[::-1].transpose(1, 0, 2))  # planks across the room
    eye.show(floor, _vector(left, foot, depth), x, -z)
    eye.show(shade(_ceiling(sampler, wide, long), sampler.uniform(0.6, 1.1)), _vector(left, top, behind), x, z)
    eye.show(_wall(sampler, wide, tall), _vector(left, top, depth), x, y)
    side = _wall(sampler, long, tall)
    eye.show(shade(side, sampler.uniform(0.5, 1.0)), _vector(left, top, behind), z, y)
    side = _wall(sampler, long, tall) if sampler.bernoulli(0.4) else side
    eye.show(shade(side, sampler.uniform(0.5, 1.0)), _vector(right, top, depth), -z, y)


def _turns(
    sampler: RandomSampler, right: float, down: tuple[float, float], roll: float = 2.0
) -> tuple[float, float, float]:
    return sampler.normal(right), sampler.uniform(*down), sampler.normal(roll)


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


def _corridor(sampler: RandomSampler, image: Image) -> Image:
    eye = _Eye.looking(image, sampler.uniform(45.0, 95.0), _turns(sampler, 6.0, (-25.0, 20.0)))
    half = sampler.uniform(0.7, 2.2)
    shift = sampler.uniform(-0.5, 0.5) * half
    _draw_room(sampler, eye, (shift - half, shift + half), sampler.uniform(0.8, 2.0), sampler.uniform(4.0, 25.0))
    return image


def _room(sampler: RandomSampler, image: Image) -> Image:
    view, foot, depth = sampler.uniform(50.0, 95.0), sampler.uniform(0.8, 1.8), sampler.uniform(2.5, 7.0)
    pitch = _downward(sampler, image, view, -5.0, (foot, depth))
    eye = _Eye.looking(image, view, (sampler.normal(20.0), pitch, sampler.normal(2.0)))
    left, right = sampler.uniform(-4.0, -1.0), sampler.uniform(1.0, 4.0)
    _draw_room(sampler, eye, (left, right), foot, depth)
    for z in sorted(sampler.rng.uniform(0.9, depth, sampler.integer(0, 4)).tolist(), reverse=True):
        x, size = sampler.uniform(left, right), sampler.rng.uniform(0.3, 1.8, 3)
        low = _vector(x - size[0] / 2, foot - 0.6 * size[1], z)
        pattern = sampler.choice((patterns.planks, patterns.carpet, patterns.stripes, patterns.shelves, _painted))
        high = _vector(x + size[0] / 2, foot, min(depth, z + size[2]))
        eye.box(low, high, pattern(sampler, 160, 160), tint(sampler, 30.0, 220.0, 0.5))
    return image


def _floor(sampler: RandomSampler, image: Image) -> Image:
    """A floor that fills most of the picture, up to a wall."""
    view, foot, depth = sampler.uniform(45.0, 90.0), sampler.uniform(0.4, 1.8), sampler.uniform(2.0, 8.0)
    half, pitch = sampler.uniform(2.0, 6.0), _downward(sampler, image, view, 5.0, (foot, depth))
    eye = _Eye.looking(image, view, (sampler.normal(15.0), pitch, sampler.normal(4.0)))
    _draw_room(sampler, eye, (-half, half), foot, depth)
    for _ in range(sampler.integer(0, 2)):  # a rug, a mat, a poster
        across, along = sampler.uniform(0.5, 2.0), sampler.uniform(0.5, 2.5)
        corner = _vector(sampler.uniform(-1.5, 1.0), foot - 0.01, sampler.uniform(1.5, depth))
        rug = sampler.choice((*_CLUTTER, patterns.carpet, patterns.stripes))(sampler, 300, 300)
        eye.show(rug, corner, _vector(across, 0.0, 0.0), _vector(0.0, 0.0, -along))
    return image


def _tabletop(sampler: RandomSampler, image: Image) -> Image:
    """A table seen from a seat, with sheets, keyboards and plates on it, and the wall behind."""
    height, width = image.shape[:2]
    image[:] = sampler.choice((_painted, patterns.bricks, patterns.shelves, patterns.blinds, patterns.stripes))(
        sampler, width, height
    )
    view, foot, depth = sampler.uniform(45.0, 85.0), sampler.uniform(0.2, 0.7), sampler.uniform(0.7, 2.0)
    half, pitch = sampler.uniform(0.4, 1.5), _downward(sampler, image, view, 8.0, (foot, depth))
    eye = _Eye.looking(image, view, (sampler.normal(12.0), pitch, sampler.normal(4.0)))
    top = sampler.choice((patterns.planks, patterns.planks, _painted, patterns.tiles, patterns.stripes))
    board = top(sampler, _TEXTURE_SIZE, 400)
    eye.show(board, _vector(-half, foot, depth), _vector(2.0 * half, 0.0, 0.0), _vector(0.0, 0.0, -depth - 0.3))
    if sampler.bernoulli(0.6):
        rim = hued(sampler.uniform(0.0, 6.0), sampler.uniform(0.0, 0.5), sampler.uniform(30.0, 250.0))
        for side in (-half, half):
            eye.bar(_vector(side, foot, depth), _vector(side, foot, 0.0), sampler.uniform(0.01, 0.06), rim)
    for _ in range(sampler.integer(0, 4)):
        turn, size = sampler.normal(0.5), sampler.uniform(0.2, 0.5)
        across = size * _vector(np.cos(turn), 0.0, np.sin(turn))
        down = size * sampler.uniform(0.3, 1.4) * _vector(np.sin(turn), 0.0, -np.cos(turn))
        corner = _vector(sampler.uniform(-0.8, 0.5) * half, foot - 0.005, sampler.uniform(0.4, depth))
        eye.show(sampler.choice(_CLUTTER)(sampler, 300, 260), corner, across, down)
    return image


def _sheet(sampler: RandomSampler, image: Image) -> Image:
    """A flat thing held in front of the camera, oblique, before something else."""
    height, width = image.shape[:2]
    image[:] = _defocused(sampler, sampler.choice(_ALL_PATTERNS)(sampler, width, height))
    turns = sampler.normal(20.0), sampler.normal(25.0), sampler.normal(12.0)
    eye = _Eye.looking(image, sampler.uniform(40.0, 80.0), turns)
    across, down = sampler.uniform(0.8, 2.2), sampler.uniform(0.7, 1.8)
    sheet = _texture(sampler, sampler.choice(_ALL_PATTERNS), across, down)
    corner = _vector(sampler.normal(0.2) - across / 2, sampler.normal(0.15) - down / 2, sampler.uniform(1.0, 1.8))
    eye.show(sheet, corner, _vector(across, 0.0, 0.0), _vector(0.0, down, 0.0))
    return image


def _stairs(sampler: RandomSampler, image: Image) -> Image:
    """Stairs that rise in front of the camera, between walls."""
    eye = _Eye.looking(image, sampler.uniform(50.0, 90.0), _turns(sampler, 15.0, (-15.0, 10.0)))
    half, foot = sampler.uniform(0.6, 3.0), sampler.uniform(1.0, 1.7)
    _draw_room(sampler, eye, (-half, half), foot, sampler.uniform(6.0, 9.0))
    rise, run, near = sampler.uniform(0.13, 0.2), sampler.uniform(0.25, 0.4), sampler.uniform(1.0, 2.5)
    tread, count = tint(sampler, 90.0, 240.0, 0.5), sampler.integer(5, 16)
    nosing = shaded(tread, sampler.choice((0.6, 1.4))) if sampler.bernoulli(0.6) else tread
    for step in range(count, 0, -1):
        z, y = near + step * run, foot - step * rise
        ends = np.array([[-half, y, z], [half, y, z]])
        deep, low = _vector(0.0, 0.0, run), _vector(0.0, rise, 0.0)
        eye.fill(np.concatenate([ends, ends[::-1] + deep]), tread)
        eye.fill(np.concatenate([ends, ends[::-1] + low]), shaded(tread, 0.6))
        eye.bar(ends[0], ends[1], 0.03, nosing)
    if sampler.bernoulli(0.6):
        rail, side = tint(sampler, 20.0, 240.0, 0.4), sampler.choice((-0.9, 0.9)) * half
        start, end = _vector(side, foot - 0.9, near), _vector(side, foot - 0.9 - count * rise, near + count * run)
        eye.bar(start, end, 0.05, rail)
        for share in np.linspace(0.0, 1.0, count).tolist():
            post = start + share * (end - start)
            eye.bar(post, post + _vector(0.0, 0.9, 0.0), 0.02, rail)
    return image


def _rails(sampler: RandomSampler, image: Image) -> Image:
    """Bars near the camera: the rails of a bed or a balcony, a ladder, a fence, cables, before a room or the sky."""
    background = sampler.choice((_room, _sky, _upright, _portrait))
    background(sampler, image)
    if sampler.bernoulli(0.5):
        image[:] = _defocused(sampler, image)
    eye = _Eye.looking(image, sampler.uniform(45.0, 90.0), _turns(sampler, 25.0, (-10.0, 25.0), 6.0))
    color, thick = tint(sampler, 20.0, 255.0, 0.4), sampler.uniform(0.01, 0.06)
    x, foot, far = sampler.uniform(-0.8, 0.8), sampler.uniform(0.1, 0.8), sampler.uniform(1.5, 5.0)
    top = foot - sampler.uniform(0.3, 1.2)
    low, high = _vector(x, foot, 0.3), _vector(x + sampler.normal(0.3), top, 0.3)
    along = _vector(sampler.normal(0.8), 0.0, far)
    for start in (low, high, low + 0.5 * (high - low))[: sampler.integer(2, 3)]:
        eye.bar(start, start + along, thick, color)
    posts = sampler.integer(0, 16)
    for share in np.linspace(0.0, 1.0, posts).tolist():
        eye.bar(low + share * along, high + share * along, 0.7 * thick, shaded(color, sampler.uniform(0.8, 1.1)))
    if sampler.bernoulli(0.4):
        other = _vector(sampler.choice((-1.0, 1.0)) * sampler.uniform(0.4, 1.2), 0.0, 0.0)
        for start in (low, high):
            eye.bar(start + other, start + other + along, thick, color)
    return image


def _boards(sampler: RandomSampler, image: Image) -> Image:
    """Bright bars over a plain ground that meet at one point: slats, tent poles, rays, rows of tubes."""
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
        fixed = [(corners * 2**_SUBPIXELS).astype(np.int32)]
        cv2.fillPoly(image, fixed, shaded(color, sampler.uniform(0.7, 1.1)), cv2.LINE_AA, _SUBPIXELS)
    return image


def _sky(sampler: RandomSampler, image: Image) -> Image:
    height, width = image.shape[:2]
    zenith = hued(sampler.uniform(3.2, 4.0), sampler.uniform(0.1, 0.8), sampler.uniform(60.0, 240.0))
    skyline = hued(sampler.uniform(0.0, 4.0), sampler.uniform(0.0, 0.4), sampler.uniform(150.0, 255.0))
    image[:] = gradient_sky = patterns.gradient(width, height, zenith, skyline)
    noise = smooth_noise(sampler, width, height, sampler.uniform(60.0, 300.0), sampler.uniform(40.0, 200.0))
    level, contrast = sampler.uniform(60.0, 190.0), sampler.uniform(1.0, 4.0)
    cover = np.clip((np.arange(256.0) - level) * contrast, 0.0, 255.0).astype(np.uint8)
    share = np.asarray(cv2.cvtColor(cv2.LUT(noise, cover), cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    image[:] = cv2.add(cv2.multiply(gradient_sky, cv2.bitwise_not(share), scale=1.0 / 255.0), shade(share, 0.95))
    for _ in range(sampler.integer(1, 6) if sampler.bernoulli(0.3) else 0):  # cables
        ends = (sampler.rng.uniform(-0.1, 1.1, (2, 2)) * (width, height)).astype(int).tolist()
        cv2.line(image, ends[0], ends[1], (30.0, 30.0, 30.0), max(1, width // 300), cv2.LINE_AA)
    return image


def _open_ground(sampler: RandomSampler, image: Image, pattern: Pattern, reach: float) -> Image:
    """Ground of one pattern up to the horizon under a sky, with a wood or hills in the distance."""
    _sky(sampler, image)
    down = sampler.uniform(-8.0, 20.0)
    eye = _Eye.looking(image, sampler.uniform(45.0, 85.0), (sampler.normal(30.0), down, sampler.normal(3.0)))
    texture = pattern(sampler, _TEXTURE_SIZE, _TEXTURE_SIZE)
    foot, near = sampler.uniform(0.6, 3.0), reach * sampler.uniform(0.3, 1.0)
    size = 2.0 * near
    eye.fill(np.array([[-500, foot, -500], [500, foot, -500], [500, foot, 500], [-500, foot, 500.0]]), _mean(texture))
    eye.show(texture, _vector(-near, foot, near), _vector(size, 0.0, 0.0), _vector(0.0, 0.0, -size))
    if sampler.bernoulli(0.7):
        color = hued(sampler.uniform(1.0, 4.0), sampler.uniform(0.1, 0.6), sampler.uniform(30.0, 150.0))
        heights = sampler.uniform(0.02, 0.2) * near * (1.0 + sampler.rng.uniform(0.0, 0.6, 60))
        angles = np.linspace(-np.pi, np.pi, 60)
        ring = np.stack([0.98 * near * np.sin(angles), np.full(60, foot), 0.98 * near * np.cos(angles)], axis=1)
        raised = ring - heights[:, None] * (0.0, 1.0, 0.0)
        for index in range(59):
            corners = np.stack([ring[index], ring[index + 1], raised[index + 1], raised[index]])
            eye.fill(corners, shaded(color, 0.98 + 0.04 * (index % 2)))
    return image


def _mean(image: Image) -> BgrColor:
    blue, green, red = image.reshape(-1, 3)[::97].mean(axis=0).tolist()
    return blue, green, red


def _meadow(sampler: RandomSampler, image: Image) -> Image:
    return _open_ground(sampler, image, patterns.ground_cover, 40.0)


def _field(sampler: RandomSampler, image: Image) -> Image:
    return _open_ground(sampler, image, patterns.furrows, 25.0)


def _water(sampler: RandomSampler, image: Image) -> Image:
    _sky(sampler, image)
    height, width = image.shape[:2]
    horizon = round(height * sampler.uniform(0.0, 0.7))
    lower = image[horizon:]
    color = hued(sampler.uniform(2.6, 4.0), sampler.uniform(0.1, 0.5), sampler.uniform(60.0, 190.0))
    lower[:] = patterns.gradient(width, height - horizon, shaded(color, 1.3), color)
    lower[:] = mottled(sampler, lower, sampler.uniform(0.3, 0.9), 40, 400)
    return image


def _forest(sampler: RandomSampler, image: Image) -> Image:
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


def _portrait(sampler: RandomSampler, image: Image) -> Image:
    """A head and shoulders before something out of focus."""
    height, width = image.shape[:2]
    image[:] = _defocused(sampler, sampler.choice(_ALL_PATTERNS)(sampler, width, height))
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


def _ellipse(
    image: Image, center: tuple[float, float], radii: tuple[float, float], color: BgrColor, turn: float = 0.0
) -> None:
    at, axes = (round(center[0]), round(center[1])), (max(1, round(radii[0])), max(1, round(radii[1])))
    cv2.ellipse(image, at, axes, turn, 0.0, 360.0, color, cv2.FILLED, cv2.LINE_AA)


def _food(sampler: RandomSampler, image: Image) -> Image:
    """Plates with food on a cloth or a table, from above."""
    height, width = image.shape[:2]
    cloth = sampler.choice((patterns.planks, patterns.tiles, patterns.stripes, _painted))
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


def _dashboard(sampler: RandomSampler, image: Image) -> Image:
    """The inside of a vehicle; its windows are dark, blind or show the sky."""
    height, width = image.shape[:2]
    _sky(sampler, image)
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
        panel = sampler.choice((patterns.screen, patterns.keyboard, patterns.blinds))(sampler, wide, tall)
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


def _night(sampler: RandomSampler, image: Image) -> Image:
    """A night sky with stars, or a dark town with lit windows and lamps."""
    height, width = image.shape[:2]
    image[:] = patterns.gradient(width, height, tint(sampler, 0.0, 30.0), tint(sampler, 0.0, 60.0))
    if sampler.bernoulli(0.5):
        for _ in range(sampler.integer(2, 9)):
            wide, tall = round(width * sampler.uniform(0.08, 0.3)), round(height * sampler.uniform(0.2, 0.7))
            left = round(sampler.uniform(-0.1, 1.0) * width)
            house = shade(patterns.facade(sampler, max(8, wide), max(8, tall)), sampler.uniform(0.1, 0.6))
            part = image[height - tall :, max(0, left) : max(0, left) + wide]
            part[:] = house[: part.shape[0], : part.shape[1]]
    glow = np.zeros_like(image)
    for x, y in (sampler.rng.random((sampler.integer(3, 60), 2)) * (width, height)).round().astype(int).tolist():
        radius = max(1, round(width * sampler.uniform(0.0, 0.012)))
        cv2.circle(glow, (x, y), radius, tint(sampler, 120.0, 255.0, 0.7), cv2.FILLED, cv2.LINE_AA)
    size = 2 * max(1, width // 60) + 1
    image[:] = cv2.add(cv2.add(image, glow), shade(np.asarray(cv2.blur(glow, (size, size)), dtype=np.uint8), 2.0))
    return image


def _fog(sampler: RandomSampler, image: Image) -> Image:
    """Nearly nothing: fog, a covered lens, a picture of one color, a gradient."""
    height, width = image.shape[:2]
    top = tint(sampler, 0.0, 255.0, 0.5)
    bottom = top if sampler.bernoulli(0.4) else tint(sampler, 0.0, 255.0, 0.5)
    image[:] = patterns.gradient(width, height, top, bottom)
    if sampler.bernoulli(0.6):
        image[:] = mottled(sampler, image, sampler.uniform(0.0, 0.5), 24, 24)
    return image


def _static(sampler: RandomSampler, image: Image) -> Image:
    """Noise: grains of any size, in color or gray, or broken rows."""
    height, width = image.shape[:2]
    columns, rows = (max(2, round(size / sampler.choice((1, 1, 2, 4, 16, 60)))) for size in (width, height))
    grains = sampler.rng.integers(0, 256, (rows, columns, 3 if sampler.bernoulli(0.5) else 1), np.uint8)
    image[:] = cv2.resize(grains if grains.shape[2] == 3 else np.repeat(grains, 3, axis=2), (width, height))
    return image


def _upright(sampler: RandomSampler, image: Image) -> Image:
    """One pattern from the front, sometimes turned about the view axis."""
    height, width = image.shape[:2]
    image[:] = sampler.choice(_ALL_PATTERNS)(sampler, width, height)
    if sampler.bernoulli(0.3):
        turn = cv2.getRotationMatrix2D((width / 2, height / 2), sampler.normal(25.0), sampler.uniform(1.0, 2.0))
        image[:] = cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REFLECT)
    return image


def _collage(sampler: RandomSampler, image: Image) -> Image:
    """Two or four pictures side by side."""
    height, width = image.shape[:2]
    x, y = round(width * sampler.uniform(0.3, 0.7)), round(height * sampler.uniform(0.3, 0.7))
    rows = (slice(0, y), slice(y, height)) if sampler.bernoulli(0.5) else (slice(0, height),)
    for row in rows:
        for column in (slice(0, x), slice(x, width)):
            sampler.choice((_upright, _sky, _room, _portrait, _boards, _meadow))(sampler, image[row, column])
    return image


_ALL_PATTERNS: Final[tuple[Pattern, ...]] = (
    patterns.arches,
    patterns.blinds,
    patterns.bricks,
    patterns.carpet,
    patterns.chart,
    patterns.chart,
    patterns.color_bars,
    patterns.facade,
    patterns.facade,
    patterns.ground_cover,
    patterns.keyboard,
    patterns.page,
    patterns.planks,
    patterns.screen,
    patterns.shelves,
    patterns.sign,
    patterns.stripes,
    patterns.table,
    patterns.tiles,
)


@dataclass(frozen=True)
class Kind:
    """A kind of picture; `draw` fills an image, which may be a part of a larger one, and returns it."""

    draw: Callable[[RandomSampler, Image], Image]
    share: float  # of all pictures
    lit: bool = False  # may get patches of light and shadow; on open ground those could pass for a road
    gray: bool = False  # may lose its colors and still not pass for a road


KINDS: Final[Mapping[str, Kind]] = MappingProxyType(
    {
        "pattern": Kind(_upright, 0.18, lit=True, gray=True),
        "sheet": Kind(_sheet, 0.1, lit=True, gray=True),
        "corridor": Kind(_corridor, 0.08, lit=True),
        "room": Kind(_room, 0.08, lit=True, gray=True),
        "floor": Kind(_floor, 0.08, lit=True),
        "tabletop": Kind(_tabletop, 0.07, lit=True),
        "rails": Kind(_rails, 0.05),
        "boards": Kind(_boards, 0.04),
        "stairs": Kind(_stairs, 0.03, lit=True, gray=True),
        "sky": Kind(_sky, 0.03, gray=True),
        "meadow": Kind(_meadow, 0.03),
        "field": Kind(_field, 0.02),
        "water": Kind(_water, 0.02),
        "forest": Kind(_forest, 0.03, gray=True),
        "portrait": Kind(_portrait, 0.03, lit=True, gray=True),
        "food": Kind(_food, 0.02, lit=True, gray=True),
        "dashboard": Kind(_dashboard, 0.03, gray=True),
        "night": Kind(_night, 0.02, gray=True),
        "fog": Kind(_fog, 0.02, gray=True),
        "static": Kind(_static, 0.02, gray=True),
        "collage": Kind(_collage, 0.02),
    }
)


def sample_picture(rng: np.random.Generator, width: int, height: int) -> Image:
    """Returns a random picture without a road, BGR (height, width, 3) uint8; the same generator gives the same picture.

    Width and height are at least 64 pixels.
    """
    sampler = RandomSampler(rng)
    kind = sampler.weighted_choice({kind: kind.share for kind in KINDS.values()})
    image = kind.draw(sampler, plain(width, height, (0.0, 0.0, 0.0)))
    if kind.lit and sampler.bernoulli(0.4):
        image = _lit(sampler, image)
    if sampler.bernoulli(0.5):
        image = np.ascontiguousarray(image[:, ::-1])
    return develop(image, _lens(sampler, gray=kind.gray and sampler.bernoulli(0.1)))


def _defocused(sampler: RandomSampler, image: Image) -> Image:
    size = 2 * max(1, round(image.shape[1] * sampler.uniform(0.004, 0.05))) + 1
    return np.asarray(cv2.blur(cv2.blur(image, (size, size)), (size, size)), dtype=np.uint8)


def _lit(sampler: RandomSampler, image: Image) -> Image:
    """Returns the image with a shadow or a patch of light whose edges are straight."""
    height, width = image.shape[:2]
    gains = np.full((height, width, 3), 128, np.uint8)
    corners = (sampler.rng.uniform(-0.4, 1.4, (sampler.choice((3, 4)), 2)) * (width, height)).round().astype(np.int32)
    level = 128.0 * (sampler.uniform(0.35, 0.9) if sampler.bernoulli(0.6) else sampler.uniform(1.1, 1.6))
    cv2.fillConvexPoly(gains, cv2.convexHull(corners), (level, level, level), cv2.LINE_AA)
    if sampler.bernoulli(0.5):
        gains = _defocused(sampler, gains)
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
