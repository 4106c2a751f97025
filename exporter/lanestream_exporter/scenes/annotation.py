"""Labels of a rendered frame: where its lane boundaries lie in the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lanestream_exporter.datasets.labels import WHOLE, LabelledFrame, LabelledLane

if TYPE_CHECKING:
    from lanestream_exporter.scenes.camera import FloatArray
    from lanestream_exporter.scenes.render_target import Image
    from lanestream_exporter.scenes.scene import Scene
    from lanestream_exporter.scenes.view import RoadView

SOURCE = "rendered"
FARTHEST = 120.0  # metres; nobody places a boundary beyond
NARROWEST = 12.0  # pixels of a picture 640 wide: where a lane is narrower, its boundaries run into each other
USUAL_LANE = 3.5  # metres
ROWS = 90  # a label has a point on every row of the picture divided by this
SHORTEST = 0.05  # share of the picture's height that a label must span


def annotate(scene: Scene, view: RoadView, hidden: Image) -> LabelledFrame:
    """The labels of a frame. `hidden` (H, W) is non-zero where walls, trees or houses cover the road."""
    camera = scene.camera
    rows = _rows(scene, view)
    lanes = []
    for lane_id, position in enumerate(scene.road.positions(scene.pose.u)):
        boundary = scene.road.boundaries[lane_id]
        points = _visible(scene, hidden, np.stack([view.boundary(rows, boundary.u), rows], axis=-1))
        if len(points) < 3 or points[0, 1] - points[-1, 1] < SHORTEST * camera.height:
            continue
        colour = boundary.marking.color if boundary.marking else None
        lanes.append(LabelledLane(points, lane_id, position, boundary.kind, colour))
    return LabelledFrame(camera.width, camera.height, tuple(lanes), scene.name, SOURCE, WHOLE)


def _rows(scene: Scene, view: RoadView) -> FloatArray:
    """The image rows that carry label points, from the lowest upwards."""
    camera = scene.camera
    step = max(1, camera.height // ROWS)
    rows = np.arange(camera.height - 1, -1, -step, dtype=np.float64)
    distance = camera.road_distance(rows, view.bend)
    widest = camera.focal * USUAL_LANE / (NARROWEST * camera.width / 640.0)
    return rows[distance < min(FARTHEST, widest, view.reach, sight(scene))]


def sight(scene: Scene) -> float:
    """How far one can tell paint from road through haze and darkness, metres."""
    haze = 2.5 * scene.air.range
    return min(haze, 2.5 * scene.light.headlights) if scene.light.headlights > 0.0 else haze


def _visible(scene: Scene, hidden: Image, points: FloatArray) -> FloatArray:
    """The points inside the picture and above the bonnet, without the far end that something solid hides."""
    width, height = scene.camera.width, scene.camera.height
    points = points[(points[:, 0] >= 0.0) & (points[:, 0] <= width - 1)]
    if not len(points):
        return points
    columns, rows = np.round(points).astype(int).T
    if scene.lens.bonnet:
        above = rows < scene.lens.bonnet.top(width, height)[columns] - 1.0
        points, columns, rows = points[above], columns[above], rows[above]
    seen = np.flatnonzero(hidden[rows, columns] == 0)
    return points[: seen[-1] + 1] if len(seen) else points[:0]
