"""Clips: a scene and how the vehicle and the traffic move through it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lanestream_exporter.scenes.lens import Lens
from lanestream_exporter.scenes.light import Air
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.render import RenderedFrame, render_still
from lanestream_exporter.scenes.road import Pose
from lanestream_exporter.scenes.sampling import STYLES, Weather, compose_scene, sample_weather
from lanestream_exporter.scenes.view import REACH

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lanestream_exporter.scenes.layout import Style
    from lanestream_exporter.scenes.scene import Scene
    from lanestream_exporter.scenes.traffic import Vehicle

SPEEDS: dict[Style, tuple[float, float]] = {  # metres a second
    "highway": (22.0, 31.0),
    "country": (13.0, 22.0),
    "street": (7.0, 13.0),
    "lane": (7.0, 13.0),
}
CHANGE_TIME = 4.0  # seconds a lane change takes
FAIR_CLOUDS = 0.35  # share of the sky on a fair day, at most
CLEAR_AHEAD = 6.0  # metres that the vehicle keeps from others


@dataclass(frozen=True)
class LaneChange:
    """A smooth move to another lane."""

    start: float  # seconds
    shift: float  # metres to the left

    def moved(self, time: float) -> float:
        """Metres to the left at `time` seconds: no sideways speed or acceleration at either end."""
        share = min(1.0, max(0.0, (time - self.start) / CHANGE_TIME))
        return self.shift * share**3 * (10.0 + share * (6.0 * share - 15.0))


@dataclass(frozen=True)
class Motion:
    """How the vehicle moves along the road."""

    speed: float  # metres a second
    sway: float  # metres to either side of its line
    sway_period: float  # seconds
    bounce: float  # pitch to either side, radians
    change: LaneChange | None = None

    def lateral(self, time: float) -> float:
        """Metres to the left of the starting position at `time` seconds."""
        sway = self.sway * math.sin(math.tau * time / self.sway_period)
        return sway + (self.change.moved(time) if self.change else 0.0)

    def heading(self, time: float) -> float:
        """Direction of travel against the road's, radians to the left."""
        step = 0.01
        return math.atan2(self.lateral(time + step) - self.lateral(time - step), 2.0 * step * self.speed)

    def pitch(self, time: float) -> float:
        """Pitch in radians: two springs of a car's suspension."""
        return self.bounce * (0.65 * math.sin(math.tau * 1.3 * time) + 0.35 * math.sin(math.tau * 2.9 * time + 1.0))


@dataclass(frozen=True)
class Clip:
    """A drive: the scene at time 0, the motion, and how many pictures are taken of it."""

    scene: Scene
    motion: Motion
    frames: int
    fps: float

    def scene_at(self, frame: int) -> Scene:
        """The scene at one frame. Road, paint and shadows stay; vehicles and the camera move."""
        time, start = frame / self.fps, self.scene
        camera = replace(start.camera, horizon=start.camera.horizon + start.camera.focal * self.motion.pitch(time))
        pose = Pose(
            start.pose.s + self.motion.speed * time,
            start.pose.u + self.motion.lateral(time),
            start.pose.heading + self.motion.heading(time),
        )
        traffic = tuple(replace(vehicle, s=vehicle.s + vehicle.speed * time) for vehicle in start.traffic)
        return replace(start, camera=camera, pose=pose, traffic=traffic, lens=replace(start.lens, frame=frame))


@dataclass(frozen=True)
class Drive:
    """What kind of clip to sample."""

    style: Style = "highway"
    lane_change: bool = False  # where the road has a second lane in our direction
    fair: bool = False  # a clear day and a good camera, as for a demonstration


def sample_clip(
    rng: np.random.Generator, width: int, height: int, frames: int, fps: float, drive: Drive | None = None
) -> Clip:
    """A random clip of `frames` pictures of the given size in pixels; without a `drive`, of any kind."""
    dice = RandomSampler(rng)
    drive = drive or Drive(dice.weighed(STYLES), lane_change=dice.chance(0.3))
    weather = Weather(night=False, dull=False, wet=False, fog=math.inf) if drive.fair else sample_weather(dice)
    motion = Motion(
        speed=dice.between(*SPEEDS[drive.style]),
        sway=dice.between(0.05, 0.25),
        sway_period=dice.between(5.0, 12.0),
        bounce=dice.between(0.0005, 0.003),
    )
    duration = frames / fps
    scene = compose_scene(dice, (width, height), drive.style, weather, motion.speed * duration + REACH)
    if drive.fair:
        clean = Lens(saturation=1.05, noise=1.2, seed=dice.seed())
        backdrop = replace(scene.backdrop, clouds=min(FAIR_CLOUDS, scene.backdrop.clouds))
        scene = replace(scene, lens=clean, air=Air(scene.air.color, 2500.0), backdrop=backdrop)
    # A file of its own would only repeat what the video's encoder does to the picture.
    scene = replace(scene, lens=replace(scene.lens, quality=0))
    if drive.lane_change:
        motion = replace(motion, change=_lane_change(dice, scene, duration))
    clip = Clip(scene, motion, frames, fps)
    return replace(clip, scene=replace(scene, traffic=_out_of_the_way(clip)))


def _lane_change(dice: RandomSampler, scene: Scene, duration: float) -> LaneChange | None:
    """A change to a neighbouring lane of our direction, in the middle of the clip."""
    shifts = [lane for lane in scene.road.lanes if 1.0 < abs(lane - scene.pose.u) < 4.5]
    if not shifts:
        return None
    return LaneChange(max(0.0, (duration - CHANGE_TIME) * dice.between(0.35, 0.65)), dice.pick(shifts) - scene.pose.u)


def _out_of_the_way(clip: Clip) -> tuple[Vehicle, ...]:
    """The traffic without those vehicles that ours would run into."""
    times = np.arange(0.0, clip.frames / clip.fps + 0.2, 0.2)
    lateral = clip.scene.pose.u + np.array([clip.motion.lateral(float(time)) for time in times])
    along = clip.scene.pose.s + clip.motion.speed * times
    kept = []
    for vehicle in clip.scene.traffic:
        gap = vehicle.s + vehicle.speed * times - along
        beside = np.abs(vehicle.u - lateral) < 2.4
        if not np.any(beside & (gap < CLEAR_AHEAD) & (gap > -vehicle.length - CLEAR_AHEAD)):
            kept.append(vehicle)
    return tuple(kept)


def render_clip(clip: Clip) -> Iterator[RenderedFrame]:
    """Renders the clip's frames in order, each with its timestamp."""
    for frame in range(clip.frames):
        yield replace(render_still(clip.scene_at(frame)), timestamp=frame / clip.fps)
