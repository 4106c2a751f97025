"""Clips with exact truth for trackers: what is delivered when, and where the vehicle and the boundaries are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from lanestream_exporter.scenes.clip import write_frames
from lanestream_exporter.scenes.lens import develop
from lanestream_exporter.scenes.motion import Drift
from lanestream_exporter.scenes.render import annotate, render_target
from lanestream_exporter.scenes.traffic import mark_covered

if TYPE_CHECKING:
    from pathlib import Path

    from lanestream.road.view import Image
    from lanestream_exporter.datasets.labels import LabeledLane
    from lanestream_exporter.scenes.clip import Clip, ProgressCallback
    from lanestream_exporter.scenes.motion import SidewaysMove
    from lanestream_exporter.scenes.projection import PinholeCamera
    from lanestream_exporter.scenes.render_target import RenderTarget
    from lanestream_exporter.scenes.road import Boundary
    from lanestream_exporter.scenes.scene import Scene
    from lanestream_exporter.scenes.traffic import Vehicle

VEHICLE_WIDTH: Final = 1.8  # of our vehicle, meters

_LABEL_ROWS: Final = 180
_PAINT_SHARE: Final = 0.3  # paint is counted from the bottom up to this share of the rows below the horizon
_TRAFFIC_REACH: Final = 160.0  # meters ahead; farther vehicles cost time and hardly show
_CROSSING_STEPS: Final = 40  # bisections of the frame in which a boundary is crossed
_NO_PAINT: Final = 1.0  # wear of which hardly a chip is left


@dataclass(frozen=True)
class PaintGap:
    """Frames in which the paint of a boundary is missing, or worn away except for a few chips."""

    boundary: int  # index
    first: int  # frame
    frames: int
    worn: bool = False

    def covers(self, frame: int) -> bool:
        """Returns whether the paint is missing in this frame."""
        return self.first <= frame < self.first + self.frames


@dataclass(frozen=True)
class LineRider:
    """A vehicle that keeps its distance ahead of ours and leaves its lane for the line for a while."""

    vehicle: Vehicle  # in its lane; its s is its distance ahead of the camera, meters
    moves: tuple[SidewaysMove, ...]

    def at(self, s: float, time: float) -> Vehicle:
        """Returns the vehicle at `time` seconds, when ours is at s."""
        shift = sum(move.shift_at(time) for move in self.moves)
        return replace(self.vehicle, s=s + self.vehicle.s, u=self.vehicle.u + shift)


@dataclass(frozen=True)
class TruePart:
    """A part of a clip without a cut: a drive in which paint may be missing and vehicles may drive on the lines."""

    clip: Clip
    gaps: tuple[PaintGap, ...] = ()
    riders: tuple[LineRider, ...] = ()
    start: float = 0.0  # seconds since the clip's start
    first_id: int = 0  # of its boundaries

    def scene_at(self, frame: int) -> Scene:
        """Returns the scene to draw for a frame."""
        scene, time = self.clip.scene_at(frame), frame / self.clip.fps
        boundaries = list(scene.road.boundaries)
        for gap in self.gaps:
            if gap.covers(frame):
                marking = boundaries[gap.boundary].marking
                remains = replace(marking, wear=_NO_PAINT) if marking and gap.worn else None
                boundaries[gap.boundary] = replace(boundaries[gap.boundary], marking=remains)
        near = (car for car in scene.traffic if car.s < scene.pose.s + _TRAFFIC_REACH)
        riders = (rider.at(scene.pose.s, time) for rider in self.riders)
        road = replace(scene.road, boundaries=tuple(boundaries))
        return replace(scene, road=road, traffic=(*near, *riders))

    def crossings(self) -> list[dict[str, Any]]:
        """Returns an event for every crossing of a boundary by the vehicle's middle, in the order of time."""
        fps, events = self.clip.fps, []
        for index, boundary in enumerate(self.clip.scene.road.boundaries):
            for frame in range(1, self.clip.frames):
                before, after = (frame - 1) / fps, frame / fps
                from_right = self._distance(boundary, before) > 0.0
                if (self._distance(boundary, after) > 0.0) == from_right or not boundary.reaches(self._s(after)):
                    continue
                for _ in range(_CROSSING_STEPS):
                    middle = (before + after) / 2.0
                    same = (self._distance(boundary, middle) > 0.0) == from_right
                    before, after = (middle, after) if same else (before, middle)
                events.append((self.start + after, "left" if from_right else "right", self.first_id + index))
        return [
            {"type": "lane_change", "direction": direction, "lane_id": lane_id, "timestamp": timestamp}
            for timestamp, direction, lane_id in sorted(events)
        ]

    def _s(self, time: float) -> float:
        return self.clip.scene.pose.s + self.clip.motion.speed * time

    def _distance(self, boundary: Boundary, time: float) -> float:
        """Returns how far the boundary is to the left of our vehicle, meters."""
        u = self.clip.scene.pose.u + self.clip.motion.lateral(time)
        return float(boundary.u_at(np.array(self._s(time)))) - u


@dataclass(frozen=True)
class Delivery:
    """A frame as it reaches the tracker: frame `frame` of a part, with the timestamp that it claims, in seconds."""

    part: int
    frame: int
    timestamp: float


@dataclass(frozen=True)
class TrackingClip:
    """A clip with exact truth for trackers. `deliveries` are in the order in which frames reach the tracker."""

    name: str
    parts: tuple[TruePart, ...]
    deliveries: tuple[Delivery, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Returns the width and height of its images in pixels."""
        camera = self.parts[0].clip.scene.camera
        return camera.width, camera.height

    def frames(self) -> Iterator[tuple[Image, dict[str, Any]]]:
        """Yields the images (H, W, 3) uint8, blue, green, red, each with its truth, in the order of delivery."""
        pending = [event for part in self.parts for event in part.crossings()]
        last: Delivery | None = None
        image: Image | None = None
        truth: dict[str, Any] = {}
        for number, delivery in enumerate(self.deliveries):
            repeated = last is not None and (last.part, last.frame) == (delivery.part, delivery.frame)
            if image is None or not repeated:
                image, truth = _render(self.parts[delivery.part], delivery.frame)
            time = truth["time"]
            due = [event for event in pending if event["timestamp"] <= time]
            pending = pending[len(due) :]
            head = {"clip": self.name, "frame": number, "timestamp": delivery.timestamp, "scene": delivery.part}
            yield image, head | truth | {"repeated": repeated, "events": due}
            last = delivery


def write_tracking_clip(
    clip: TrackingClip, fps: float, video: Path, labels: Path, progress: ProgressCallback | None = None
) -> None:
    """Writes the delivered frames into an MP4 file at `video`, one every 1/`fps` s, and their truth to `labels`.

    Their timestamps are in the truth only. Raises ValueError if the width or height is odd.
    """
    frames = ((image, truth | {"clip": video.name}) for image, truth in clip.frames())
    write_frames(frames, fps, video, labels, progress)


def _render(part: TruePart, frame: int) -> tuple[Image, dict[str, Any]]:
    """Returns the image of a frame, and its truth."""
    scene, time = part.scene_at(frame), frame / part.clip.fps
    target = render_target(scene)
    camera, pitch, yaw = scene.camera, _pitch(part.clip.scene.camera), math.degrees(part.clip.scene.pose.heading)
    ego = _ego(part, scene, time)
    truth: dict[str, Any] = {
        "time": part.start + time,
        "width": camera.width,
        "height": camera.height,
        "horizon": round(camera.horizon, 4),
        "camera": _tilted(camera, pitch) | ({"yaw": round(yaw, 4)} if yaw else {}),
        "truth_pitch": round(math.degrees(pitch), 4),
        "truth_yaw": round(yaw, 4),
        "vertical_curvature": scene.road.course.vertical_curvature,
        "ego": ego,
        "lanes": _lanes(part, frame, scene, target),
    }
    drift = next((move for move in part.clip.motion.moves if isinstance(move, Drift)), None)
    if drift:
        truth["drift"] = _drift(drift, ego)
    return develop(target.image, scene.lens), truth


def _pitch(camera: PinholeCamera) -> float:
    """Returns the angle in radians at which a tilted camera that sees the same road looks down; see `_tilted`."""
    return math.asin(((camera.height - 1) / 2.0 - camera.horizon) / camera.focal)


def _tilted(camera: PinholeCamera, pitch: float) -> dict[str, float]:
    """Returns the height and the field of view of the camera that is tilted by `pitch` and sees the same road.

    The renderer's image plane is upright. With its focal length f, height h and horizon, it shows a flat road as does a
    camera that is tilted by p, sin p = (middle row - horizon) / f, of the focal length f cos p and the height h cos p,
    h sin p farther ahead.
    """
    field_of_view = 2.0 * math.atan(camera.width / (2.0 * camera.focal * math.cos(pitch)))
    return {
        "height": round(camera.mount_height * math.cos(pitch), 5),
        "field_of_view": round(math.degrees(field_of_view), 5),
    }


def _ego(part: TruePart, scene: Scene, time: float) -> dict[str, float | None]:
    """Returns the ego lane in meters in the frame of the vehicle, whose X axis is its direction of travel.

    The vehicle is at (s, u) with the heading h to the left of the road. Its lateral axis meets a boundary u_b(s) at
    Y = (u_b - u) / (cos h + u_b' sin h), with u_b' the boundary's slope.
    """
    motion, s, u = part.clip.motion, scene.pose.s, scene.pose.u
    heading = motion.heading(time)
    left, right = scene.road.beside(s, u)
    if not left or not right:
        return dict.fromkeys(
            ("offset_m", "heading", "curvature", "lane_width_m", "lateral_speed", "left", "right"), None
        )
    places, slopes, distances = [], [], []
    for index in (left[0], right[0]):
        place, ahead = (float(scene.road.boundaries[index].u_at(np.array(at))) for at in (s, s + 0.1))
        slope = (ahead - place) / 0.1
        places.append(place)
        slopes.append(slope)
        distances.append((place - u) / (math.cos(heading) + slope * math.sin(heading)))
    center, slope = sum(places) / 2.0, sum(slopes) / 2.0
    curvature = float(scene.road.course.curvature(np.array(s)))
    values = {
        "offset_m": sum(distances) / 2.0,
        "heading": math.atan2(slope, 1.0 - curvature * center) - heading,
        "curvature": curvature / (1.0 - curvature * center),
        "lane_width_m": places[0] - places[1],
        "lateral_speed": slope * motion.speed - motion.lateral_speed(time),
        "left": distances[0],
        "right": -distances[1],
    }
    return {name: round(value, 8) for name, value in values.items()}


def _drift(drift: Drift, ego: dict[str, float | None]) -> dict[str, Any]:
    """Returns the drift's speed in m/s and side, and the distances in meters of the wheels from the boundaries."""
    distances = {side: ego[side] for side in ("left", "right")}
    wheels = {side: None if far is None else round(far - VEHICLE_WIDTH / 2, 6) for side, far in distances.items()}
    side = "left" if drift.shift > 0.0 else "right"
    return {"speed": round(drift.speed, 6), "side": side, "wheel_distance": wheels}


def _lanes(part: TruePart, frame: int, scene: Scene, target: RenderTarget) -> list[dict[str, Any]]:
    """Returns the boundaries in the image, each with the share of its near rows in which its paint can be seen."""
    whole = replace(scene, road=part.clip.scene.road)  # without gaps
    covered = target.hidden.copy()
    for vehicle in scene.traffic:
        mark_covered(covered, target.projection, vehicle)
    lanes = []
    for lane in annotate(whole, target.projection, target.hidden, _LABEL_ROWS).lanes:
        index = lane.lane_id or 0
        gap = next((gap for gap in part.gaps if gap.boundary == index and gap.covers(frame)), None)
        painted = whole.road.boundaries[index].marking is not None and gap is None
        lanes.append(
            {
                "id": part.first_id + index,
                "position": lane.position or 0,  # 0: has ended behind the vehicle or begins ahead of it
                "type": lane.type,
                "color": lane.color,
                "points": lane.points.round(2).tolist(),
                "paint": round(_visible_share(lane, covered, scene.camera.horizon), 3) if painted else 0.0,
                "gap": frame - gap.first + 1 if gap else 0,
                "gap_length": gap.frames if gap else 0,
            }
        )
    return lanes


def _visible_share(lane: LabeledLane, covered: Image, horizon: float) -> float:
    """Returns the share of a boundary's near rows that aren't covered; of all its rows if none is near."""
    height = covered.shape[0]
    near = lane.points[lane.points[:, 1] >= horizon + _PAINT_SHARE * (height - 1.0 - horizon)]
    columns, rows = np.round(near if len(near) else lane.points).astype(int).T
    return float(np.mean(covered[rows, columns] == 0))
