"""What stands beside and over the road: barriers, rails, kerbs, trees, posts, houses and bridges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from lanestream_exporter.scenes.noise import noise_tiles

if TYPE_CHECKING:
    from lanestream_exporter.scenes.camera import FloatArray
    from lanestream_exporter.scenes.render_target import Canvas
    from lanestream_exporter.scenes.surface import Colour
    from lanestream_exporter.scenes.view import Layer

WallKind = Literal["jersey", "rail", "kerb", "fence", "hedge"]
ItemKind = Literal["tree", "bush", "post", "lamp", "sign", "house"]

NEAREST = 0.5  # metres ahead of the lens where drawing of long things starts
SPRITE = 128  # pixels on a side of a tree's picture
SPRITES = 6  # different trees

# Of each kind of wall: stripes (low, high, brightness) as shares of its height, and metres between its posts.
WALL_STRIPES: dict[WallKind, tuple[tuple[tuple[float, float, float], ...], float]] = {
    "jersey": (((0.0, 0.1, 0.75), (0.1, 0.4, 1.1), (0.4, 0.95, 0.88), (0.95, 1.0, 1.2)), 6.0),
    "rail": (((0.55, 0.68, 0.8), (0.68, 0.8, 1.15), (0.8, 0.88, 0.7), (0.88, 1.0, 1.1)), 4.0),
    "kerb": (((0.0, 1.0, 0.8),), 0.0),
    "fence": (((0.45, 0.52, 0.9), (0.93, 1.0, 1.0)), 3.0),
    "hedge": (((0.0, 0.5, 0.7), (0.5, 0.9, 1.0), (0.9, 1.0, 1.25)), 0.0),
}


@dataclass(frozen=True)
class Wall:
    """Something long beside the road at lateral position u. Metres."""

    kind: WallKind
    u: float
    height: float
    color: Colour


@dataclass(frozen=True)
class Item:
    """One thing at the roadside, facing the driver. Metres."""

    kind: ItemKind
    s: float
    u: float
    height: float
    width: float
    color: Colour
    seed: int


@dataclass(frozen=True)
class Bridge:
    """A deck over the road, or a sign gantry where it is short along the road. Metres."""

    s: float
    length: float
    clearance: float
    depth: float  # of the deck
    reach: float  # to either side of the reference line
    color: Colour


def draw_wall(canvas: Canvas, wall: Wall) -> None:
    """Draws a wall from far to near."""
    view = canvas.view
    ahead = view.s[(view.x > NEAREST) & (view.x < view.reach)]
    s = np.concatenate([[view.here + NEAREST], ahead[ahead > view.here + NEAREST]])
    stripes, spacing = WALL_STRIPES[wall.kind]
    if spacing:
        _draw_posts(canvas, wall, s, spacing)
    for low, high, gain in stripes:
        _draw_stripe(canvas, wall, s, (low * wall.height, high * wall.height), gain)
    if wall.kind == "jersey":
        _draw_posts(canvas, wall, s, spacing)


def _draw_stripe(canvas: Canvas, wall: Wall, s: FloatArray, rise: tuple[float, float], gain: float) -> None:
    """One stripe of a wall, in a few lengths so that each takes the light and haze of its distance."""
    colour: Colour = (wall.color[0] * gain, wall.color[1] * gain, wall.color[2] * gain)
    cuts = np.unique(np.searchsorted(s, s[0] + np.array([0.0, 4.0, 9.0, 16.0, 28.0, 50.0, 90.0, 150.0, 1e4])))
    for first, last in reversed(list(pairwise(cuts))):
        part = s[first : last + 1]
        if len(part) < 2:
            continue
        u = np.full(len(part), wall.u)
        foot = canvas.view.project(part, u, np.full(len(part), rise[0]))
        head = canvas.view.project(part, u, np.full(len(part), rise[1]))
        x, y = canvas.view.place(part[:1], u[:1])
        outline = np.concatenate([foot, head[::-1]])
        canvas.polygon(outline, canvas.tone(colour, float(x[0]), float(y[0])), hides=wall.kind in {"jersey", "hedge"})


def _draw_posts(canvas: Canvas, wall: Wall, s: FloatArray, spacing: float) -> None:
    """The posts of a rail, or the dark joints of a concrete wall, out to 80 m."""
    first = np.ceil(s[0] / spacing) * spacing
    wide = 0.03 if wall.kind == "jersey" else 0.12
    colour: Colour = (wall.color[0] * 0.6, wall.color[1] * 0.6, wall.color[2] * 0.6)
    for post in np.arange(min(first + 80.0, s[-1]), first - 0.1, -spacing):
        along = np.array([post, post + wide, post + wide, post])
        rise = np.array([0.0, 0.0, 1.0, 1.0]) * wall.height
        outline = canvas.view.project(along, np.full(4, wall.u), rise)
        x, y = canvas.view.place(along[:1], np.array([wall.u]))
        canvas.polygon(outline, canvas.tone(colour, float(x[0]), float(y[0])))


def draw_item(canvas: Canvas, item: Item) -> None:
    """Draws one roadside thing."""
    if not canvas.view.spans(item.s, item.s):
        return
    x, y = (float(value[0]) for value in canvas.view.place(np.array([item.s]), np.array([item.u])))
    if x < 2.0 or x > canvas.view.reach:
        return
    if item.kind in {"tree", "bush"}:
        _draw_tree(canvas, item, x, y)
    elif item.kind == "house":
        _draw_house(canvas, item, x, y)
    else:
        _draw_post(canvas, item, x, y)


def _upright(canvas: Canvas, x: float, y: float, sides: tuple[float, float], rise: tuple[float, float]) -> FloatArray:
    """Image corners of an upright rectangle facing the vehicle at (x, y); sides to the left and heights, metres."""
    lateral = y + np.array([sides[0], sides[1], sides[1], sides[0]])
    return canvas.view.image(np.full(4, x), lateral, np.array([rise[0], rise[0], rise[1], rise[1]]))


def _draw_tree(canvas: Canvas, item: Item, x: float, y: float) -> None:
    half = item.width / 2.0
    corners = _upright(canvas, x, y, (half, -half), (0.0, item.height))
    left, top = np.floor(corners.min(axis=0)).astype(int)
    right, bottom = np.ceil(corners.max(axis=0)).astype(int)
    height, width = canvas.hidden.shape
    # Very near trees would cost a lot of pixels for a blur at the picture's edge.
    if right <= 0 or left >= width or bottom <= 0 or top >= height or bottom - top > 3 * height:
        return
    sprite = tree_sprites()[item.seed % SPRITES]
    if item.kind == "bush":
        sprite = sprite[: round(0.62 * SPRITE)]
    size = (max(1, int(right - left)), max(1, int(bottom - top)))
    method = cv2.INTER_AREA if size[0] < SPRITE else cv2.INTER_LINEAR
    picture = np.asarray(cv2.resize(sprite, size, interpolation=method), dtype=np.float32)
    tone = np.array(canvas.tone(item.color, x, y), np.float32)
    mist = np.array(canvas.tone((0.02, 0.02, 0.02), x, y), np.float32)
    patch = mist + picture[..., :1] * (tone - mist)
    canvas.blend(patch, picture[..., 1], int(left), int(top))
    crown = (int(left + 0.3 * size[0]), int(top + 0.2 * size[1])), (int(right - 0.3 * size[0]), int(bottom))
    cv2.rectangle(canvas.hidden, *crown, (255,), -1)


@cache
def tree_sprites() -> tuple[Layer, ...]:
    """Pictures of trees (SPRITE, SPRITE, 2): shade 0 to 1.4 and cover 0 to 1. The trunk takes the lowest third."""
    return tuple(_tree_sprite(seed) for seed in range(SPRITES))


def _tree_sprite(seed: int) -> Layer:
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


def _draw_house(canvas: Canvas, item: Item, x: float, y: float) -> None:
    half = item.width / 2.0
    front = _upright(canvas, x, y, (half, -half), (0.0, item.height))
    if front[:, 0].max() < 0 or front[:, 0].min() > canvas.image.shape[1]:
        return
    canvas.polygon(front, canvas.tone(item.color, x, y), hides=True)
    dark = canvas.tone((item.color[0] * 0.35, item.color[1] * 0.32, item.color[2] * 0.3), x, y)
    columns, floors = max(2, round(item.width / 3.0)), max(1, round(item.height / 3.2))
    for floor in range(min(floors, 6)):
        for column in range(min(columns, 8)):
            near = half - item.width * (column + 0.25) / min(columns, 8)
            low = item.height * (floor + 0.3) / min(floors, 6)
            pane = (near, near - 0.5 * item.width / min(columns, 8))
            canvas.polygon(_upright(canvas, x, y, pane, (low, low + 0.45 * item.height / min(floors, 6))), dark)


def _draw_post(canvas: Canvas, item: Item, x: float, y: float) -> None:
    thick = 0.05 if item.kind == "sign" else max(0.06, 0.02 * item.height)
    tone = canvas.tone(item.color, x, y)
    canvas.polygon(_upright(canvas, x, y, (thick, -thick), (0.0, item.height)), tone)
    if item.kind == "lamp":
        inward = -1.0 if item.u > 0.0 else 1.0
        arm = (0.0, inward * 2.2)
        canvas.polygon(_upright(canvas, x, y, arm, (item.height - 0.12, item.height)), tone)
        if canvas.light.glow < 0.4:
            bulb = _upright(canvas, x, y, (arm[1] - 0.35, arm[1] + 0.35), (item.height - 0.3, item.height))
            canvas.polygon(bulb, (170.0, 225.0, 255.0))
    elif item.kind == "sign":
        half = item.width / 2.0
        plate = _upright(canvas, x, y, (half, -half), (item.height - item.width * 0.8, item.height))
        face = np.random.default_rng(item.seed).choice([(0.35, 0.45, 0.1), (0.85, 0.86, 0.86), (0.1, 0.5, 0.9)])
        canvas.polygon(plate, canvas.tone((float(face[0]), float(face[1]), float(face[2])), x, y))


def draw_bridge(canvas: Canvas, bridge: Bridge) -> None:
    """Draws a deck over the road: its underside, its face and its piers."""
    view = canvas.view
    start = max(bridge.s, view.here + NEAREST)
    end = bridge.s + bridge.length
    if end < start + 0.2 or float(view.place(np.array([start]), np.zeros(1))[0][0]) > view.reach:
        return
    sides = np.array([bridge.reach, -bridge.reach])
    x, y = (float(value[0]) for value in view.place(np.array([start]), np.zeros(1)))

    def quad(s: tuple[float, float], z: tuple[float, float]) -> FloatArray:
        near = view.project(np.full(2, s[0]), sides, np.full(2, z[0]))
        far = view.project(np.full(2, s[1]), sides[::-1], np.full(2, z[1]))
        return np.concatenate([near, far])

    below = canvas.tone((0.16, 0.15, 0.14), x, y)
    canvas.polygon(quad((start, end), (bridge.clearance, bridge.clearance)), below)
    if bridge.s > start - 0.1:
        top = bridge.clearance + bridge.depth
        canvas.polygon(quad((start, start), (bridge.clearance, top)), canvas.tone(bridge.color, x, y))
        lip: Colour = (bridge.color[0] * 1.15, bridge.color[1] * 1.15, bridge.color[2] * 1.15)
        canvas.polygon(quad((start, start), (top - 0.25 * bridge.depth, top)), canvas.tone(lip, x, y))
    for side in sides:
        pier = side * 0.96
        foot = view.project(np.array([end, end]), np.array([pier, pier * 0.92]), np.zeros(2))
        head = view.project(np.array([end, end]), np.array([pier * 0.92, pier]), np.full(2, bridge.clearance))
        shade: Colour = (bridge.color[0] * 0.7, bridge.color[1] * 0.7, bridge.color[2] * 0.7)
        canvas.polygon(np.concatenate([foot, head]), canvas.tone(shade, x, y))
