"""Drawing a scene: ground, backdrop, things from far to near, then the lens."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress
from operator import not_
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lanestream_exporter.scenes.annotation import annotate
from lanestream_exporter.scenes.backdrop import draw_backdrop
from lanestream_exporter.scenes.lens import develop
from lanestream_exporter.scenes.light import haze_ground, light_ground
from lanestream_exporter.scenes.markings import paint_boundaries, paint_others
from lanestream_exporter.scenes.render_target import Canvas, Image
from lanestream_exporter.scenes.roadside import Bridge, Item, draw_bridge, draw_item, draw_wall
from lanestream_exporter.scenes.surface import paint_ground
from lanestream_exporter.scenes.traffic import Vehicle, draw_vehicle
from lanestream_exporter.scenes.view import Grid, RoadView

if TYPE_CHECKING:
    from lanestream_exporter.datasets.labels import LabelledFrame
    from lanestream_exporter.scenes.scene import Scene


MARGIN = 30.0  # metres that the longest thing at the roadside reaches beyond its s


@dataclass(frozen=True)
class RenderedFrame:
    """A picture and its ground truth."""

    image: Image  # (H, W, 3) uint8, blue, green, red
    labels: LabelledFrame
    horizon: float  # image row of the road's vanishing plane, pixels
    timestamp: float = 0.0  # seconds since the clip began


def render_still(scene: Scene) -> RenderedFrame:
    """Renders one scene. The same scene always gives the same pixels."""
    camera = scene.camera
    view = RoadView.ahead(camera, scene.road.course, scene.pose)
    grid = Grid.of(view)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    canvas = Canvas(image, np.zeros(image.shape[:2], np.uint8), view, scene.light, scene.air)
    draw_backdrop(canvas, scene.backdrop, grid.top)
    _draw_ground(canvas, scene, grid)
    _draw_things(canvas, scene)
    if scene.wetness > 0.0:
        _mirror(canvas, grid, scene.wetness)
    labels = annotate(scene, view, canvas.hidden)
    return RenderedFrame(develop(canvas.image, scene.lens), labels, camera.horizon)


def _draw_ground(canvas: Canvas, scene: Scene, grid: Grid) -> None:
    if not grid.u.size:
        return
    ground = paint_ground(grid, scene.surface)
    paint_others(grid, scene.paintwork, ground)
    paint_boundaries(grid, scene.road, ground)
    light_ground(grid, scene.light, ground)
    haze_ground(grid, scene.air, ground)
    cv2.convertScaleAbs(ground, canvas.image[grid.top :], alpha=255.0)


def _draw_things(canvas: Canvas, scene: Scene) -> None:
    """Far before near; and what stands behind a wall before the wall, what drives inside after it."""
    left = min((wall.u for wall in scene.walls if wall.u > scene.pose.u), default=1e6)
    right = max((wall.u for wall in scene.walls if wall.u < scene.pose.u), default=-1e6)
    everything: tuple[Bridge | Item | Vehicle, ...] = (*scene.bridges, *scene.items, *scene.traffic)
    things = [thing for thing in everything if canvas.view.spans(thing.s, thing.s + MARGIN)]
    things.sort(key=lambda thing: -thing.s)
    inside = [not isinstance(thing, Bridge) and right < thing.u < left for thing in things]
    for thing in compress(things, map(not_, inside)):
        _draw_thing(canvas, thing)
    for wall in sorted(scene.walls, key=lambda wall: -abs(wall.u - scene.pose.u)):
        draw_wall(canvas, wall)
    for thing in compress(things, inside):
        _draw_thing(canvas, thing)


def _draw_thing(canvas: Canvas, thing: Bridge | Item | Vehicle) -> None:
    if isinstance(thing, Bridge):
        draw_bridge(canvas, thing)
    elif isinstance(thing, Item):
        draw_item(canvas, thing)
    else:
        draw_vehicle(canvas, thing)


def _mirror(canvas: Canvas, grid: Grid, wetness: float) -> None:
    """Adds the upside-down, smeared picture of what stands above the road to the wet ground."""
    height = canvas.image.shape[0] - grid.top
    above = canvas.image[max(0, grid.top - height) : grid.top][::-1]
    if len(above) < 2:
        return
    smeared = cv2.blur(above, (3, max(3, height // 12)))
    target = canvas.image[grid.top : grid.top + len(smeared)]
    fade = np.linspace(1.0, 0.3, len(smeared), dtype=np.float32)[:, None, None] * np.float32(wetness)
    target[...] = np.clip(target * (1.0 - 0.5 * fade) + smeared * fade, 0.0, 255.0).astype(np.uint8)
