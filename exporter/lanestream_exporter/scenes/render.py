"""Rendering a scene: backdrop, ground, objects from far to near and the lens, with the exact labels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame, LabeledLane
from lanestream_exporter.scenes.backdrop import draw_backdrop
from lanestream_exporter.scenes.kerbs import draw_kerb
from lanestream_exporter.scenes.lens import develop
from lanestream_exporter.scenes.light import haze_ground, light_ground
from lanestream_exporter.scenes.markings import paint_boundaries, paint_other_marks
from lanestream_exporter.scenes.projection import GroundGrid, RoadProjection
from lanestream_exporter.scenes.render_target import RenderTarget
from lanestream_exporter.scenes.roadside import Bridge, RoadsideItem, draw_bridge, draw_item, draw_wall
from lanestream_exporter.scenes.surface import cover_with_dust, paint_ground
from lanestream_exporter.scenes.traffic import Vehicle, draw_vehicle, mark_covered

if TYPE_CHECKING:
    from lanestream.road.curve import FloatArray
    from lanestream.road.view import Image
    from lanestream_exporter.scenes.road import Boundary
    from lanestream_exporter.scenes.scene import Scene


SOURCE = "rendered"
MAX_LABEL_DISTANCE = 120.0  # meters; people do not label boundaries farther away
MIN_LANE_WIDTH = 12.0  # pixels of a 640 pixel wide image; the boundaries of narrower lanes merge
TYPICAL_LANE_WIDTH = 3.5  # meters
LABEL_ROWS = 90  # approximate number of rows with label points over the image height
MIN_LABEL_SPAN = 0.05  # share of the image height that a label must span
EDGE_MARGIN = 2.0  # pixels between an edge and the place beside it where the pavement must be visible
MOST_COVERED = 0.8  # share of an edge that vehicles may hide

MAX_OBJECT_LENGTH = 30.0  # meters that an object extends beyond its s


@dataclass(frozen=True)
class RenderedFrame:
    """A rendered image and its ground truth."""

    image: Image  # (H, W, 3) uint8, blue, green, red
    labels: LabeledFrame
    horizon: float  # image row of the road plane's vanishing line, pixels
    timestamp: float = 0.0  # seconds since the start of the clip


def render_still(scene: Scene) -> RenderedFrame:
    """Renders one scene. The same scene always gives the same pixels."""
    target = render_target(scene)
    labels = annotate(scene, target.projection, target.hidden)
    return RenderedFrame(develop(target.image, scene.lens), labels, scene.camera.horizon)


def render_target(scene: Scene) -> RenderTarget:
    """Draws everything in front of the lens."""
    camera = scene.camera
    projection = RoadProjection.from_pose(camera, scene.road.course, scene.pose)
    grid = GroundGrid.from_projection(projection)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    target = RenderTarget(image, np.zeros(image.shape[:2], np.uint8), projection, scene.light, scene.atmosphere)
    draw_backdrop(target, scene.backdrop, grid.top)
    _draw_ground(target, scene, grid)
    _draw_objects(target, scene)
    if scene.wetness > 0.0:
        _reflect(target, grid, scene.wetness)
    return target


def _draw_ground(target: RenderTarget, scene: Scene, grid: GroundGrid) -> None:
    if not grid.u.size:
        return
    ground = paint_ground(grid, scene.surface)
    paint_other_marks(grid, scene.paintwork, ground)
    paint_boundaries(grid, scene.road, ground)
    for dust in scene.surface.dust:
        cover_with_dust(grid, dust, ground)
    light_ground(grid, scene.light, ground)
    haze_ground(grid, scene.atmosphere, ground)
    cv2.convertScaleAbs(ground, target.image[grid.top :], alpha=255.0)


def _draw_objects(target: RenderTarget, scene: Scene) -> None:
    """Draws objects from far to near; those behind a wall before the wall, those inside the walls after it.

    Kerbs are so low that they hide the ground only.
    """
    for kerb in scene.kerbs:
        draw_kerb(target, kerb)
    left = min((wall.u for wall in scene.walls if wall.u > scene.pose.u), default=1e6)
    right = max((wall.u for wall in scene.walls if wall.u < scene.pose.u), default=-1e6)
    everything: tuple[Bridge | RoadsideItem | Vehicle, ...] = (*scene.bridges, *scene.items, *scene.traffic)
    objects = [item for item in everything if target.projection.overlaps(item.s, item.s + MAX_OBJECT_LENGTH)]
    objects.sort(key=lambda item: -item.s)
    inside = [item for item in objects if not isinstance(item, Bridge) and right < item.u < left]
    outside = [item for item in objects if isinstance(item, Bridge) or not right < item.u < left]
    for item in outside:
        _draw_object(target, item)
    for wall in sorted(scene.walls, key=lambda wall: -abs(wall.u - scene.pose.u)):
        draw_wall(target, wall)
    for item in inside:
        _draw_object(target, item)


def _draw_object(target: RenderTarget, item: Bridge | RoadsideItem | Vehicle) -> None:
    if isinstance(item, Bridge):
        draw_bridge(target, item)
    elif isinstance(item, RoadsideItem):
        draw_item(target, item)
    else:
        draw_vehicle(target, item)


def _reflect(target: RenderTarget, grid: GroundGrid, wetness: float) -> None:
    """Adds the mirrored, blurred image of everything above the horizon to the wet ground."""
    height = target.image.shape[0] - grid.top
    above = target.image[max(0, grid.top - height) : grid.top][::-1]
    if len(above) < 2:
        return
    smeared = cv2.blur(above, (3, max(3, height // 12)))
    region = target.image[grid.top : grid.top + len(smeared)]
    fade = np.linspace(1.0, 0.3, len(smeared), dtype=np.float32)[:, None, None] * np.float32(wetness)
    region[...] = np.clip(region * (1.0 - 0.5 * fade) + smeared * fade, 0.0, 255.0).astype(np.uint8)


def annotate(scene: Scene, projection: RoadProjection, hidden: Image, label_rows: int = LABEL_ROWS) -> LabeledFrame:
    """Returns the labels of a frame, with points in about `label_rows` rows over the image height.

    `hidden` (H, W) is non-zero where walls, trees or houses hide the road. Labels run through vehicles, but an edge
    that they hide nearly everywhere has no label.
    """
    camera = scene.camera
    rows = _rows(scene, projection, label_rows)
    covered = np.zeros_like(hidden)
    for vehicle in scene.traffic:
        if vehicle.s < scene.pose.s + MAX_LABEL_DISTANCE:
            mark_covered(covered, projection, vehicle)
    lanes = []
    for lane_id, position in enumerate(scene.road.positions(scene.pose.s, scene.pose.u)):
        boundary = scene.road.boundaries[lane_id]
        points = _boundary_points(boundary, projection, rows)
        # A wall may stand right at an edge: look at the pavement beside it.
        inward = 0.0 if boundary.marking else math.copysign(EDGE_MARGIN, boundary.u - scene.pose.u)
        points = _visible(scene, hidden, points, inward)
        if len(points) < 3 or points[0, 1] - points[-1, 1] < MIN_LABEL_SPAN * camera.height:
            continue
        if boundary.marking is None and _covered_share(points, covered) > MOST_COVERED:
            continue
        color = boundary.marking.color if boundary.marking else None
        lanes.append(LabeledLane(points, lane_id, position, boundary.type, color))
    return LabeledFrame(
        camera.width, camera.height, tuple(lanes), scene.name, SOURCE, WHOLE, horizon=float(camera.horizon)
    )


def _boundary_points(boundary: Boundary, projection: RoadProjection, rows: FloatArray) -> FloatArray:
    """Returns the points (N, 2) of a boundary at those of the rows where it exists."""
    u = boundary.u_at(rows * 0.0)
    for _ in range(3):  # s depends on u, but hardly
        s = projection.road_positions(rows, u)
        u = boundary.u_at(s)
    exists = (s >= boundary.first) & (s <= boundary.last)
    return np.stack([projection.boundary_columns(rows, u), rows], axis=-1)[exists]


def _rows(scene: Scene, projection: RoadProjection, label_rows: int) -> FloatArray:
    """Returns the image rows with label points, from the bottom up."""
    camera = scene.camera
    step = max(1, camera.height // label_rows)
    rows = np.arange(camera.height - 1, -1, -step, dtype=np.float64)
    distance = camera.road_distance(rows, projection.vertical_curvature)
    max_distance = camera.focal * TYPICAL_LANE_WIDTH / (MIN_LANE_WIDTH * camera.width / 640.0)
    return rows[distance < min(MAX_LABEL_DISTANCE, max_distance, projection.reach, visibility(scene))]


def visibility(scene: Scene) -> float:
    """Returns the distance at which paint is still visible through haze and darkness, meters."""
    haze = 2.5 * scene.atmosphere.range
    return min(haze, 2.5 * scene.light.headlights) if scene.light.headlights > 0.0 else haze


def _covered_share(points: FloatArray, covered: Image) -> float:
    """Returns the share of points (N, 2) that lie where the mask (H, W) is set."""
    columns, rows = np.round(points).astype(int).T
    return float(np.mean(covered[rows, columns] > 0))


def _visible(scene: Scene, hidden: Image, points: FloatArray, inward: float) -> FloatArray:
    """Returns the points inside the image and above the hood, without a far end hidden by a solid object.

    What hides a point is looked up `inward` pixels to its right.
    """
    width, height = scene.camera.width, scene.camera.height
    points = points[(points[:, 0] >= 0.0) & (points[:, 0] <= width - 1)]
    if not len(points):
        return points
    columns, rows = np.round(points).astype(int).T
    if scene.lens.hood:
        above = rows < scene.lens.hood.top(width, height)[columns] - 1.0
        points, columns, rows = points[above], columns[above], rows[above]
    beside = np.clip(np.round(points[:, 0] + inward).astype(int), 0, width - 1)
    visible = np.flatnonzero(hidden[rows, beside] == 0)
    return points[: visible[-1] + 1] if len(visible) else points[:0]
