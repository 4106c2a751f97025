"""Objects next to and above the road: barriers, rails, hedges, trees, posts, houses and bridges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from lanestream_exporter.scenes.noise import noise_tiles

if TYPE_CHECKING:
    from lanestream.road.curve import FloatArray
    from lanestream_exporter.scenes.projection import Float32Array
    from lanestream_exporter.scenes.render_target import RenderTarget
    from lanestream_exporter.scenes.surface import Color

WallKind = Literal["jersey", "rail", "fence", "hedge"]
ItemKind = Literal["tree", "bush", "post", "lamp", "sign", "house"]

NEAREST = 0.5  # meters ahead of the lens where long objects start
SPRITE = 128  # pixels on a side of a tree sprite
SPRITES = 6  # number of different tree sprites

# Per kind of wall: stripes (low, high, brightness), low and high as shares of its height; post spacing in meters.
WALL_STRIPES: dict[WallKind, tuple[tuple[tuple[float, float, float], ...], float]] = {
    "jersey": (((0.0, 0.1, 0.75), (0.1, 0.4, 1.1), (0.4, 0.95, 0.88), (0.95, 1.0, 1.2)), 6.0),
    "rail": (((0.55, 0.68, 0.8), (0.68, 0.8, 1.15), (0.8, 0.88, 0.7), (0.88, 1.0, 1.1)), 4.0),
    "fence": (((0.45, 0.52, 0.9), (0.93, 1.0, 1.0)), 3.0),
    "hedge": (((0.0, 0.5, 0.7), (0.5, 0.9, 1.0), (0.9, 1.0, 1.25)), 0.0),
}


@dataclass(frozen=True)
class Wall:
    """A long object next to the road at lateral position u. Meters."""

    kind: WallKind
    u: float
    height: float
    color: Color


@dataclass(frozen=True)
class RoadsideItem:
    """One object at the roadside, facing the driver. Meters."""

    kind: ItemKind
    s: float
    u: float
    height: float
    width: float
    color: Color
    seed: int


@dataclass(frozen=True)
class Bridge:
    """A bridge deck over the road, or a sign gantry if `length` is short. Meters."""

    s: float
    length: float
    clearance: float
    depth: float  # of the deck
    reach: float  # to either side of the reference line
    color: Color


def draw_wall(target: RenderTarget, wall: Wall) -> None:
    """Draws a wall from far to near."""
    projection = target.projection
    ahead = projection.s[(projection.x > NEAREST) & (projection.x < projection.reach)]
    s = np.concatenate([[projection.vehicle_s + NEAREST], ahead[ahead > projection.vehicle_s + NEAREST]])
    stripes, spacing = WALL_STRIPES[wall.kind]
    if spacing:
        _draw_posts(target, wall, s, spacing)
    for low, high, gain in stripes:
        _draw_stripe(target, wall, s, (low * wall.height, high * wall.height), gain)
    if wall.kind == "jersey":
        _draw_posts(target, wall, s, spacing)


def _draw_stripe(target: RenderTarget, wall: Wall, s: FloatArray, rise: tuple[float, float], gain: float) -> None:
    """Draws one stripe of a wall in several segments, each with the light and haze at its distance."""
    color: Color = (wall.color[0] * gain, wall.color[1] * gain, wall.color[2] * gain)
    cuts = np.unique(np.searchsorted(s, s[0] + np.array([0.0, 4.0, 9.0, 16.0, 28.0, 50.0, 90.0, 150.0, 1e4])))
    for first, last in reversed(list(pairwise(cuts))):
        part = s[first : last + 1]
        if len(part) < 2:
            continue
        u = np.full(len(part), wall.u)
        foot = target.projection.project(part, u, np.full(len(part), rise[0]))
        head = target.projection.project(part, u, np.full(len(part), rise[1]))
        x, y = target.projection.to_vehicle(part[:1], u[:1])
        outline = np.concatenate([foot, head[::-1]])
        target.polygon(outline, target.tone(color, float(x[0]), float(y[0])), hides=wall.kind in {"jersey", "hedge"})


def _draw_posts(target: RenderTarget, wall: Wall, s: FloatArray, spacing: float) -> None:
    """Draws the posts of a rail, or the dark joints of a concrete wall, up to 80 m ahead."""
    first = np.ceil(s[0] / spacing) * spacing
    wide = 0.03 if wall.kind == "jersey" else 0.12
    color: Color = (wall.color[0] * 0.6, wall.color[1] * 0.6, wall.color[2] * 0.6)
    for post in np.arange(min(first + 80.0, s[-1]), first - 0.1, -spacing):
        along = np.array([post, post + wide, post + wide, post])
        rise = np.array([0.0, 0.0, 1.0, 1.0]) * wall.height
        outline = target.projection.project(along, np.full(4, wall.u), rise)
        x, y = target.projection.to_vehicle(along[:1], np.array([wall.u]))
        target.polygon(outline, target.tone(color, float(x[0]), float(y[0])))


def draw_item(target: RenderTarget, item: RoadsideItem) -> None:
    """Draws one roadside object."""
    if not target.projection.overlaps(item.s, item.s):
        return
    x, y = (float(value[0]) for value in target.projection.to_vehicle(np.array([item.s]), np.array([item.u])))
    if x < 2.0 or x > target.projection.reach:
        return
    if item.kind in {"tree", "bush"}:
        _draw_tree(target, item, x, y)
    elif item.kind == "house":
        _draw_house(target, item, x, y)
    else:
        _draw_post(target, item, x, y)


def _upright(
    target: RenderTarget, x: float, y: float, sides: tuple[float, float], rise: tuple[float, float]
) -> FloatArray:
    """Returns the image corners of an upright rectangle at (x, y), facing the vehicle; sides and heights in meters."""
    lateral = y + np.array([sides[0], sides[1], sides[1], sides[0]])
    return target.projection.project_vehicle(np.full(4, x), lateral, np.array([rise[0], rise[0], rise[1], rise[1]]))


def _draw_tree(target: RenderTarget, item: RoadsideItem, x: float, y: float) -> None:
    half = item.width / 2.0
    corners = _upright(target, x, y, (half, -half), (0.0, item.height))
    left, top = np.floor(corners.min(axis=0)).astype(int)
    right, bottom = np.ceil(corners.max(axis=0)).astype(int)
    height, width = target.hidden.shape
    # Very close trees would cost many pixels for a blur at the image border.
    if right <= 0 or left >= width or bottom <= 0 or top >= height or bottom - top > 3 * height:
        return
    sprite = tree_sprites()[item.seed % SPRITES]
    if item.kind == "bush":
        sprite = sprite[: round(0.62 * SPRITE)]
    size = (max(1, int(right - left)), max(1, int(bottom - top)))
    method = cv2.INTER_AREA if size[0] < SPRITE else cv2.INTER_LINEAR
    scaled = np.asarray(cv2.resize(sprite, size, interpolation=method), dtype=np.float32)
    tone = np.array(target.tone(item.color, x, y), np.float32)
    mist = np.array(target.tone((0.02, 0.02, 0.02), x, y), np.float32)
    patch = mist + scaled[..., :1] * (tone - mist)
    target.blend(patch, scaled[..., 1], int(left), int(top))
    crown = (int(left + 0.3 * size[0]), int(top + 0.2 * size[1])), (int(right - 0.3 * size[0]), int(bottom))
    cv2.rectangle(target.hidden, *crown, (255,), -1)


@cache
def tree_sprites() -> tuple[Float32Array, ...]:
    """Returns tree sprites (SPRITE, SPRITE, 2): shade 0 to 1.4 and opacity 0 to 1; the trunk is in the lowest third."""
    return tuple(_tree_sprite(seed) for seed in range(SPRITES))


def _tree_sprite(seed: int) -> Float32Array:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:SPRITE, 0:SPRITE].astype(np.float32) / np.float32(SPRITE)
    shift = rng.integers(0, 512, 2)
    noise = np.roll(noise_tiles().cloud, shift, (0, 1))[:SPRITE, :SPRITE]
    leaves = np.roll(noise_tiles().fine, shift, (0, 1))[:SPRITE, :SPRITE]
    slim = rng.uniform(0.8, 1.4)
    radius = np.hypot((x - 0.5) * slim, (y - 0.42) * 0.95) / 0.33
    cover = np.clip((1.0 - radius + 0.16 * noise + 0.05 * leaves) * 9.0, 0.0, 1.0)
    trunk = (np.abs(x - 0.5) < rng.uniform(0.012, 0.035)) & (y > 0.4)
    shade = np.clip(0.75 + 0.3 * noise + 0.18 * leaves - 0.5 * (y - 0.3) + 0.3 * (0.5 - x), 0.1, 1.4)
    shade = np.where(trunk & (cover < 0.5), 0.35, shade)
    sprite = np.stack([shade, np.maximum(cover, trunk)], axis=-1).astype(np.float32)
    sprite.setflags(write=False)
    return np.asarray(sprite, dtype=np.float32)


def _draw_house(target: RenderTarget, item: RoadsideItem, x: float, y: float) -> None:
    half = item.width / 2.0
    front = _upright(target, x, y, (half, -half), (0.0, item.height))
    if front[:, 0].max() < 0 or front[:, 0].min() > target.image.shape[1]:
        return
    target.polygon(front, target.tone(item.color, x, y), hides=True)
    dark = target.tone((item.color[0] * 0.35, item.color[1] * 0.32, item.color[2] * 0.3), x, y)
    columns, floors = max(2, round(item.width / 3.0)), max(1, round(item.height / 3.2))
    for floor in range(min(floors, 6)):
        for column in range(min(columns, 8)):
            near = half - item.width * (column + 0.25) / min(columns, 8)
            low = item.height * (floor + 0.3) / min(floors, 6)
            pane = (near, near - 0.5 * item.width / min(columns, 8))
            target.polygon(_upright(target, x, y, pane, (low, low + 0.45 * item.height / min(floors, 6))), dark)


def _draw_post(target: RenderTarget, item: RoadsideItem, x: float, y: float) -> None:
    thick = 0.05 if item.kind == "sign" else max(0.06, 0.02 * item.height)
    tone = target.tone(item.color, x, y)
    target.polygon(_upright(target, x, y, (thick, -thick), (0.0, item.height)), tone)
    if item.kind == "lamp":
        inward = -1.0 if item.u > 0.0 else 1.0
        arm = (0.0, inward * 2.2)
        target.polygon(_upright(target, x, y, arm, (item.height - 0.12, item.height)), tone)
        if target.light.glow < 0.4:
            bulb = _upright(target, x, y, (arm[1] - 0.35, arm[1] + 0.35), (item.height - 0.3, item.height))
            target.polygon(bulb, (170.0, 225.0, 255.0))
    elif item.kind == "sign":
        half = item.width / 2.0
        plate = _upright(target, x, y, (half, -half), (item.height - item.width * 0.8, item.height))
        face = np.random.default_rng(item.seed).choice([(0.35, 0.45, 0.1), (0.85, 0.86, 0.86), (0.1, 0.5, 0.9)])
        target.polygon(plate, target.tone((float(face[0]), float(face[1]), float(face[2])), x, y))


def draw_bridge(target: RenderTarget, bridge: Bridge) -> None:
    """Draws a bridge: its underside, its face and its piers."""
    projection = target.projection
    start = max(bridge.s, projection.vehicle_s + NEAREST)
    end = bridge.s + bridge.length
    if end < start + 0.2 or float(projection.to_vehicle(np.array([start]), np.zeros(1))[0][0]) > projection.reach:
        return
    sides = np.array([bridge.reach, -bridge.reach])
    x, y = (float(value[0]) for value in projection.to_vehicle(np.array([start]), np.zeros(1)))

    def quad(s: tuple[float, float], z: tuple[float, float]) -> FloatArray:
        near = projection.project(np.full(2, s[0]), sides, np.full(2, z[0]))
        far = projection.project(np.full(2, s[1]), sides[::-1], np.full(2, z[1]))
        return np.concatenate([near, far])

    below = target.tone((0.16, 0.15, 0.14), x, y)
    target.polygon(quad((start, end), (bridge.clearance, bridge.clearance)), below)
    if bridge.s > start - 0.1:
        top = bridge.clearance + bridge.depth
        target.polygon(quad((start, start), (bridge.clearance, top)), target.tone(bridge.color, x, y))
        lip: Color = (bridge.color[0] * 1.15, bridge.color[1] * 1.15, bridge.color[2] * 1.15)
        target.polygon(quad((start, start), (top - 0.25 * bridge.depth, top)), target.tone(lip, x, y))
    for side in sides:
        pier = side * 0.96
        foot = projection.project(np.array([end, end]), np.array([pier, pier * 0.92]), np.zeros(2))
        head = projection.project(np.array([end, end]), np.array([pier * 0.92, pier]), np.full(2, bridge.clearance))
        shade: Color = (bridge.color[0] * 0.7, bridge.color[1] * 0.7, bridge.color[2] * 0.7)
        target.polygon(np.concatenate([foot, head]), target.tone(shade, x, y))
