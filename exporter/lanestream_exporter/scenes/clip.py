"""Clips: a scene with moving vehicles, sampled, rendered and written as a video with labels."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from av.video.stream import VideoStream

from lanestream_exporter.scenes.lens import Lens
from lanestream_exporter.scenes.light import Atmosphere
from lanestream_exporter.scenes.motion import LANE_CHANGE_TIME, SidewaysMove, VehicleMotion
from lanestream_exporter.scenes.projection import REACH
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.render import RenderedFrame, render_still
from lanestream_exporter.scenes.road import Pose
from lanestream_exporter.scenes.scene import STYLES, Weather, compose_scene, sample_weather

if TYPE_CHECKING:
    from pathlib import Path

    from lanestream.road.view import Image
    from lanestream_exporter.datasets.labels import LabeledFrame
    from lanestream_exporter.scenes.layout import RoadStyle
    from lanestream_exporter.scenes.scene import Scene
    from lanestream_exporter.scenes.traffic import Vehicle

ENCODERS = ("libx264", "libopenh264", "mpeg4")  # by preference; not every build of FFmpeg has all of them
ProgressCallback = Callable[[int], None]  # called with the number of frames done

SPEEDS: dict[RoadStyle, tuple[float, float]] = {  # meters per second
    "highway": (22.0, 31.0),
    "country": (13.0, 22.0),
    "street": (7.0, 13.0),
    "lane": (7.0, 13.0),
    "campus": (4.0, 9.0),
    "square": (3.0, 7.0),
}
FAIR_CLOUDS = 0.35  # largest share of the sky on a fair day
MIN_GAP = 6.0  # meters between our vehicle and others


@dataclass(frozen=True)
class Clip:
    """A drive: the scene at time 0, the motion, and the number and rate of the frames."""

    scene: Scene
    motion: VehicleMotion
    frames: int
    fps: float

    def scene_at(self, frame: int) -> Scene:
        """Returns the scene at one frame: road, paint and shadows stay, vehicles and the camera move."""
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
    """The kind of clip to sample."""

    style: RoadStyle = "highway"
    lane_change: bool = False  # if the road has a second lane in our direction
    fair: bool = False  # a clear day and a good camera


def sample_clip(
    rng: np.random.Generator, width: int, height: int, frames: int, fps: float, drive: Drive | None = None
) -> Clip:
    """Samples a clip of `frames` images of the given size in pixels; without a `drive`, of any kind."""
    sampler = RandomSampler(rng)
    drive = drive or Drive(sampler.weighted_choice(STYLES), lane_change=sampler.bernoulli(0.3))
    weather = Weather(night=False, overcast=False, wet=False, fog=math.inf) if drive.fair else sample_weather(sampler)
    motion = VehicleMotion(
        speed=sampler.uniform(*SPEEDS[drive.style]),
        sway=sampler.uniform(0.05, 0.25),
        sway_period=sampler.uniform(5.0, 12.0),
        bounce=sampler.uniform(0.0005, 0.003),
    )
    duration = frames / fps
    scene = compose_scene(sampler, (width, height), drive.style, weather, motion.speed * duration + REACH)
    if drive.fair:
        clean = Lens(saturation=1.05, noise=1.2, seed=sampler.seed())
        backdrop = replace(scene.backdrop, clouds=min(FAIR_CLOUDS, scene.backdrop.clouds))
        scene = replace(scene, lens=clean, atmosphere=Atmosphere(scene.atmosphere.color, 2500.0), backdrop=backdrop)
    # The video encoder already compresses the frames.
    scene = replace(scene, lens=replace(scene.lens, quality=0))
    if drive.lane_change:
        motion = replace(motion, moves=_lane_change(sampler, scene, duration))
    clip = Clip(scene, motion, frames, fps)
    return replace(clip, scene=replace(scene, traffic=without_collisions(clip)))


def _lane_change(sampler: RandomSampler, scene: Scene, duration: float) -> tuple[SidewaysMove, ...]:
    """Samples a change to an adjacent lane in our direction, mid-clip; nothing if there is no such lane."""
    shifts = [lane for lane in scene.road.lanes if 1.0 < abs(lane - scene.pose.u) < 4.5]
    if not shifts:
        return ()
    start = max(0.0, (duration - LANE_CHANGE_TIME) * sampler.uniform(0.35, 0.65))
    return (SidewaysMove(start, sampler.choice(shifts) - scene.pose.u),)


def without_collisions(clip: Clip) -> tuple[Vehicle, ...]:
    """Returns the traffic without the vehicles that ours would collide with."""
    times = np.arange(0.0, clip.frames / clip.fps + 0.2, 0.2)
    lateral = clip.scene.pose.u + np.array([clip.motion.lateral(float(time)) for time in times])
    along = clip.scene.pose.s + clip.motion.speed * times
    remaining = []
    for vehicle in clip.scene.traffic:
        gap = vehicle.s + vehicle.speed * times - along
        same_lane = np.abs(vehicle.u - lateral) < 2.4
        if not np.any(same_lane & (gap < MIN_GAP) & (gap > -vehicle.length - MIN_GAP)):
            remaining.append(vehicle)
    return tuple(remaining)


def render_clip(clip: Clip) -> Iterator[RenderedFrame]:
    """Yields the rendered frames of the clip in order, each with its timestamp."""
    for frame in range(clip.frames):
        yield replace(render_still(clip.scene_at(frame)), timestamp=frame / clip.fps)


def write_clip(clip: Clip, video: Path, labels: Path, progress: ProgressCallback | None = None) -> None:
    """Renders `clip` into an MP4 file at `video` and writes the labels of every frame to `labels`.

    `progress` is called with the number of frames done. Raises ValueError if the width or height is odd, because 4:2:0
    video halves both for color.
    """
    frames = (
        (frame.image, label_record(frame.labels, video.name, number)) for number, frame in enumerate(render_clip(clip))
    )
    write_frames(frames, clip.fps, video, labels, progress)


def write_frames(
    frames: Iterable[tuple[Image, dict[str, Any]]],
    fps: float,
    video: Path,
    labels: Path,
    progress: ProgressCallback | None = None,
) -> None:
    """Writes images (H, W, 3) into an MP4 file at `video`, and the record of each as a line of JSON to `labels`.

    `progress` is called with the number of frames done. Raises ValueError if the width or height is odd.
    """
    stream = None
    with av.open(str(video), "w", format="mp4") as container, labels.open("w", encoding="utf-8") as lines:
        for number, (image, record) in enumerate(frames):
            stream = stream or _add_stream(container, image, fps)
            video_frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            video_frame.pts = number
            video_frame.time_base = Fraction(1) / _rate(fps)
            container.mux(stream.encode(video_frame))
            lines.write(json.dumps(record) + "\n")
            if progress:
                progress(number + 1)
        if stream:
            container.mux(stream.encode(None))


def label_record(labels: LabeledFrame, clip: str, frame: int) -> dict[str, Any]:
    """Returns the labels of one frame as a record of the clip's label file."""
    return {
        "clip": clip,
        "frame": frame,
        "width": labels.width,
        "height": labels.height,
        "lanes": [
            {
                "id": lane.lane_id,
                "position": lane.position,
                "type": lane.type,
                "color": lane.color,
                "points": lane.points.round(1).tolist(),
            }
            for lane in labels.lanes
        ],
    }


def _add_stream(container: av.container.OutputContainer, image: Image, fps: float) -> VideoStream:
    height, width = image.shape[:2]
    if width % 2 or height % 2:
        raise ValueError(f"a video needs an even width and height, got {width}x{height}")
    encoder = next(name for name in ENCODERS if name in av.codecs_available)
    stream = container.add_stream(encoder, rate=_rate(fps))
    if not isinstance(stream, VideoStream):
        raise TypeError(f"{encoder} created a {type(stream).__name__} instead of a video stream")
    stream.width, stream.height = width, height
    stream.pix_fmt = "yuv420p"
    if encoder == "libx264":
        stream.options = {"crf": "18", "preset": "veryfast"}
    else:
        stream.bit_rate = round(0.2 * width * height * fps)
    return stream


def _rate(fps: float) -> Fraction:
    """Returns the frame rate as a fraction that every container supports."""
    return Fraction(fps).limit_denominator(1001)
