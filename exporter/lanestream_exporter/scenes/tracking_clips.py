"""Kinds of clips that try a tracker: lane changes, curves, hidden paint, merges, cuts, bad weather and bad time."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from lanestream_exporter.scenes.clip import SPEEDS, Clip, without_collisions
from lanestream_exporter.scenes.lens import Lens
from lanestream_exporter.scenes.light import LineShadow, TreeShadow
from lanestream_exporter.scenes.motion import Drift, PitchBump, SidewaysMove, VehicleMotion
from lanestream_exporter.scenes.projection import REACH
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.road import Course, Pose, Taper
from lanestream_exporter.scenes.scene import START, Weather, compose_scene
from lanestream_exporter.scenes.surroundings_sampling import sample_vehicle
from lanestream_exporter.scenes.tracking_truth import (
    VEHICLE_WIDTH,
    Delivery,
    LineRider,
    PaintGap,
    TrackingClip,
    TruePart,
)

if TYPE_CHECKING:
    from lanestream_exporter.scenes.layout import RoadStyle
    from lanestream_exporter.scenes.road import Boundary, Road
    from lanestream_exporter.scenes.scene import Scene

GAP_LENGTHS: Final = (1, 3, 5, 10, 20, 30, 45)  # frames

_TRIES: Final = 400
_MOST_WEAR: Final = 0.65  # of the markings of the ego lane
_LEAST_CONTRAST: Final = 0.12  # of these markings to the lane, of 1
_MOST_SIDEWAYS_ACCELERATION: Final = 3.5  # in curves, m/s^2
_GAPS: Final = 4  # in a clip
_GAP_PAUSE: Final = (2.1, 2.8)  # seconds between two gaps
_RIDE_TIME: Final = 1.0  # in which a vehicle moves to the line or back, seconds


@dataclass(frozen=True)
class _Maker:
    """Samples the parts that all kinds of clips share. Seeds in a row run through the variants of a kind."""

    sampler: RandomSampler
    seed: int
    size: tuple[int, int]
    fps: float

    def variant(self, count: int) -> int:
        """Returns which of `count` variants of a kind this clip is."""
        return self.seed % count

    def weather(self) -> Weather:
        """Samples a dry day."""
        return Weather(night=False, overcast=self.sampler.bernoulli(0.25), wet=False, fog=math.inf)

    def style(self, highways: float = 0.75) -> RoadStyle:
        """Samples a highway or a country road."""
        return "highway" if self.sampler.bernoulli(highways) else "country"

    def drive(
        self,
        seconds: float,
        style: RoadStyle,
        accept: Callable[[Scene], bool] | None = None,
        *,
        weather: Weather | None = None,
        sway: tuple[float, float] = (0.05, 0.25),
        clutter: bool = False,
    ) -> Clip:
        """Samples a drive in a lane with two painted boundaries, on a road that `accept` accepts."""
        sampler = self.sampler
        speed = sampler.uniform(*SPEEDS[style])
        motion = VehicleMotion(
            speed, sampler.uniform(*sway), sampler.uniform(5.0, 12.0), sampler.uniform(0.0005, 0.003)
        )
        length = speed * seconds + REACH
        for _ in range(_TRIES):
            scene = compose_scene(sampler, self.size, style, weather or self.weather(), length)
            scene = replace(scene, pose=Pose(START, sampler.normal(0.12), 0.0))
            if _in_painted_lane(scene) and (accept is None or accept(scene)):
                break
        else:
            raise RuntimeError(f"none of {_TRIES} sampled roads suits the clip")
        camera = scene.camera
        pitch = math.radians(sampler.normal(1.4))
        camera = replace(camera, horizon=(camera.height - 1) / 2.0 - camera.focal * math.tan(pitch))
        sharpest = _MOST_SIDEWAYS_ACCELERATION / speed**2
        course = scene.road.course
        course = replace(course, curvatures=tuple(max(-sharpest, min(sharpest, part)) for part in course.curvatures))
        lens = replace(scene.lens, hood=None, quality=0) if weather else self._good_lens()
        scene = replace(scene, camera=camera, road=replace(scene.road, course=course), lens=lens)
        if not clutter:
            # Remains of old markings and dust on paint mislead any detector; other kinds are about tracking.
            scene = replace(
                scene,
                paintwork=replace(scene.paintwork, ghosts=()),
                surface=replace(scene.surface, dust=()),
            )
        return Clip(scene, motion, round(seconds * self.fps), self.fps)

    def _good_lens(self) -> Lens:
        sampler = self.sampler
        return Lens(
            exposure=sampler.uniform(0.85, 1.2),
            gamma=sampler.uniform(0.9, 1.15),
            saturation=sampler.uniform(0.7, 1.15),
            vignette=sampler.uniform(0.0, 0.3),
            defocus=sampler.uniform(0.0, 0.6),
            noise=sampler.uniform(1.0, 3.0),
            seed=sampler.seed(),
        )

    def yawed(self, clip: Clip) -> Clip:
        """Turns the camera of half of the clips by up to a degree."""
        yaw = math.radians(self.sampler.uniform(-1.0, 1.0)) if self.sampler.bernoulli(0.5) else 0.0
        return replace(clip, scene=replace(clip.scene, pose=replace(clip.scene.pose, heading=yaw)))


def sample_tracking_clip(kind: str, seed: int, size: tuple[int, int] = (640, 360), fps: float = 25.0) -> TrackingClip:
    """Samples a clip of one of the KINDS, of images of `size` (width, height) in pixels at `fps` frames a second.

    Equal arguments give equal clips. Raises KeyError for an unknown kind.
    """
    make = KINDS[kind]
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    return replace(make(_Maker(RandomSampler(rng), seed, size, fps)), name=f"{kind}-{seed}")


def _whole(*parts: TruePart, deliveries: tuple[Delivery, ...] | None = None) -> TrackingClip:
    """Returns the parts one after the other, without vehicles that ours would collide with, delivered on time."""
    joined: list[TruePart] = []
    start, first_id = 0.0, 0
    for part in parts:
        clip = replace(part.clip, scene=replace(part.clip.scene, traffic=without_collisions(part.clip)))
        joined.append(replace(part, clip=clip, start=start, first_id=first_id))
        start, first_id = start + clip.frames / clip.fps, first_id + len(clip.scene.road.boundaries)
    on_time = (
        Delivery(number, frame, part.start + frame / part.clip.fps)
        for number, part in enumerate(joined)
        for frame in range(part.clip.frames)
    )
    return TrackingClip("", tuple(joined), tuple(on_time) if deliveries is None else deliveries)


def _ego_boundaries(road: Road, pose: Pose) -> tuple[int, int] | None:
    left, right = road.beside(pose.s, pose.u)
    return (left[0], right[0]) if left and right else None


def _in_painted_lane(scene: Scene) -> bool:
    """Returns whether both boundaries of the ego lane have paint that people can see."""
    ego = _ego_boundaries(scene.road, scene.pose)
    lane = [part for part in scene.surface.materials if part.low <= scene.pose.u <= part.high][-1]
    tone = sum(lane.color) / 3.0
    markings = [scene.road.boundaries[index].marking for index in ego or ()]
    return bool(markings) and all(
        marking is not None and marking.wear < _MOST_WEAR and marking.brightness > tone + _LEAST_CONTRAST
        for marking in markings
    )


def _lane_beyond(scene: Scene, side: float) -> float | None:
    """Returns the center of the next lane in our direction on a side (+1 left, -1 right), if there is one."""
    beyond = [lane for lane in scene.road.lanes if 2.0 < side * lane < 4.5]
    return beyond[0] if beyond else None


def _keeping(maker: _Maker) -> TrackingClip:
    """Makes a drive in one lane with some sway."""
    return _whole(TruePart(maker.yawed(maker.drive(10.0, maker.style()))))


def _long(maker: _Maker) -> TrackingClip:
    """Makes a drive in one lane that is long enough for the direction of the camera to settle."""
    return _whole(TruePart(maker.yawed(maker.drive(24.0, "highway", sway=(0.03, 0.15)))))


def _lane_change(maker: _Maker) -> TrackingClip:
    """Makes a change to the left or the right in 2 to 6 seconds."""
    sampler, side = maker.sampler, 1.0 - 2.0 * maker.variant(2)
    clip = maker.drive(11.0, "highway", lambda scene: _lane_beyond(scene, side) is not None, sway=(0.03, 0.12))
    duration = sampler.uniform(2.0, 6.0)
    start = sampler.uniform(2.0, 9.0 - duration)
    shift = (_lane_beyond(clip.scene, side) or 0.0) - clip.scene.pose.u + sampler.normal(0.12)
    move = SidewaysMove(start, shift, duration)
    return _whole(TruePart(maker.yawed(replace(clip, motion=replace(clip.motion, moves=(move,))))))


def _curve(maker: _Maker) -> TrackingClip:
    """Makes a drive through curves of 150 to 600 m radius."""
    sampler = maker.sampler
    clip = maker.drive(12.0, maker.style(0.5), sway=(0.03, 0.15))
    radius = 150.0 * 4.0 ** sampler.uniform(0.0, 1.0)
    speed = min(clip.motion.speed, math.sqrt(_MOST_SIDEWAYS_ACCELERATION * radius))
    spacing, side = 20.0, 1.0 - 2.0 * maker.variant(2)
    knots = [0.0] * sampler.integer(2, 5)
    while len(knots) * spacing < START + 12.0 * speed + REACH:
        ramp = np.linspace(0.0, side / radius, sampler.integer(3, 5))
        knots += [*ramp, *[side / radius] * sampler.integer(4, 9), *ramp[::-1]]
        side = -side if sampler.bernoulli(0.7) else side
        knots += [0.0] * sampler.integer(0, 3)
    course = Course(spacing, tuple(float(knot) for knot in knots), clip.scene.road.course.vertical_curvature)
    scene = replace(clip.scene, road=replace(clip.scene.road, course=course))
    return _whole(TruePart(maker.yawed(replace(clip, scene=scene, motion=replace(clip.motion, speed=speed)))))


def _occlusion(maker: _Maker) -> TrackingClip:
    """Makes a drive in which the ego boundaries are hidden for 1 to 45 frames, by lost paint or by vehicles on them."""
    sampler, fps = maker.sampler, maker.fps
    lengths = [int(length) for length in sampler.rng.permutation(GAP_LENGTHS)[:_GAPS]]
    pauses = [sampler.uniform(*_GAP_PAUSE) for _ in range(_GAPS + 1)]
    clip = maker.drive(sum(pauses) + sum(lengths) / fps, maker.style(), sway=(0.03, 0.15))
    scene = clip.scene
    ego = _ego_boundaries(scene.road, scene.pose) or (0, 1)
    gaps: list[PaintGap] = []
    rides: dict[float, list[SidewaysMove]] = {}
    first = 0
    for pause, length in zip(pauses, lengths, strict=False):
        first += round(pause * fps)
        sides = sampler.choice(((1.0,), (-1.0,), (1.0, -1.0)))
        worn = sampler.bernoulli(0.4)
        gaps += [PaintGap(ego[0] if side > 0.0 else ego[1], first, length, worn) for side in sides]
        lane = _lane_beyond(scene, sides[0])
        if lane is not None and sampler.bernoulli(0.5):
            shift = scene.road.boundaries[ego[0] if sides[0] > 0.0 else ego[1]].u - lane
            begin, end = first / fps - _RIDE_TIME, (first + length) / fps
            moves = (SidewaysMove(begin, shift, _RIDE_TIME), SidewaysMove(end, -shift, _RIDE_TIME))
            rides.setdefault(lane, []).extend(moves)
        first += length
    riders = tuple(_rider(sampler, lane, moves) for lane, moves in rides.items())
    traffic = tuple(car for car in scene.traffic if all(abs(car.u - lane) > 1.5 for lane in rides))
    return _whole(TruePart(replace(clip, scene=replace(scene, traffic=traffic)), tuple(gaps), riders))


def _rider(sampler: RandomSampler, lane: float, moves: list[SidewaysMove]) -> LineRider:
    return LineRider(sample_vehicle(sampler, sampler.uniform(5.0, 8.0), lane, 0.1), tuple(moves))


def _merge(maker: _Maker) -> TrackingClip:
    """Makes a road on which the outermost lane of a side ends or begins; its pavement goes on."""
    sampler, side = maker.sampler, maker.sampler.choice((1.0, -1.0))
    clip = maker.drive(11.0, "highway", lambda scene: _lane_beyond(scene, side) is not None)
    scene = clip.scene
    start = scene.pose.s + clip.motion.speed * sampler.uniform(2.5, 4.5)
    taper = Taper(start, sampler.uniform(60.0, 140.0), 0.0)
    boundaries = list(scene.road.boundaries)
    painted = [index for index, boundary in enumerate(boundaries) if boundary.marking]
    outer, inner = painted[:2] if side > 0.0 else painted[:-3:-1]
    boundaries[outer], boundaries[inner] = _tapered(boundaries[outer], boundaries[inner], taper, maker.variant(4))
    lanes = sorted(scene.road.lanes)
    outermost = lanes[-1] if side > 0.0 else lanes[0]
    traffic = tuple(car for car in scene.traffic if abs(car.u - outermost) > 1.5)
    road = replace(scene.road, boundaries=tuple(boundaries))
    return _whole(TruePart(replace(clip, scene=replace(scene, road=road, traffic=traffic))))


def _tapered(outer: Boundary, divider: Boundary, taper: Taper, variant: int) -> tuple[Boundary, Boundary]:
    """Returns the outermost marking and the next one of a road whose outer lane ends (0, 1) or begins (2, 3).

    Either the divider ends before the taper or begins after it (0, 2), or the outermost one ends or begins at the
    divider.
    """
    inward = divider.u - outer.u
    start, end = taper.start, taper.start + taper.length
    if variant == 0:
        return replace(outer, taper=replace(taper, shift=inward)), replace(divider, last=start)
    if variant == 1:
        return replace(outer, taper=replace(taper, shift=inward), last=end), divider
    outward = replace(outer, u=divider.u, taper=replace(taper, shift=-inward))
    if variant == 2:
        return outward, replace(divider, first=end)
    return replace(outward, first=start), divider


def _bump(maker: _Maker) -> TrackingClip:
    """Makes a drive over bumps that pitch the camera by 0.5 to 2 degrees."""
    sampler = maker.sampler
    clip = maker.yawed(maker.drive(10.0, maker.style()))
    bumps = tuple(
        PitchBump(
            2.0 * (index + 1) + sampler.uniform(-0.4, 0.4),
            math.radians(sampler.uniform(0.5, 2.0)) * sampler.choice((-1.0, 1.0)),
        )
        for index in range(4)
    )
    return _whole(TruePart(replace(clip, motion=replace(clip.motion, bumps=bumps))))


def _cut(maker: _Maker) -> TrackingClip:
    """Makes two drives with the same camera, one after the other."""
    first, second = (maker.drive(maker.sampler.uniform(4.0, 6.0), maker.style()) for _ in range(2))
    second = replace(second, scene=replace(second.scene, camera=first.scene.camera))
    return _whole(TruePart(first), TruePart(second))


def _bad_weather(maker: _Maker) -> TrackingClip:
    """Makes a drive at night, in the rain or in fog, with all faults of cameras."""
    sampler = maker.sampler
    weather = (
        Weather(night=True, overcast=False, wet=sampler.bernoulli(0.3), fog=math.inf),
        Weather(night=False, overcast=True, wet=True, fog=sampler.choice((math.inf, sampler.uniform(80.0, 250.0)))),
        Weather(night=False, overcast=True, wet=False, fog=sampler.uniform(40.0, 150.0)),
    )[maker.variant(3)]
    return _whole(TruePart(maker.drive(10.0, maker.style(), weather=weather)))


def _bad_time(maker: _Maker) -> TrackingClip:
    """Makes a drive whose frames are lost, come twice or come late."""
    clip = maker.drive(10.0, maker.style())
    return _whole(TruePart(clip), deliveries=_disturbed(maker, clip.frames))


def _disturbed(maker: _Maker, frames: int) -> tuple[Delivery, ...]:
    """Returns deliveries that are disturbed in one of five ways.

    0: frames are lost; 1: frames come twice with the same timestamp; 2: frames come again in the place of the next;
    3: timestamps are late by up to two frames; 4: frames are lost, come twice and late.
    """
    sampler, variant, period = maker.sampler, maker.variant(5), 1.0 / maker.fps
    share = sampler.uniform(0.2, 0.5)
    deliveries: list[Delivery] = []
    frame = 0
    while frame < frames:
        disturbed = sampler.bernoulli(share)
        fault = sampler.choice((0, 1, 2)) if variant == 4 else variant
        late = sampler.uniform(0.0, 2.0 * period) if variant in {3, 4} else 0.0
        timestamp = frame * period + late
        if deliveries:  # a late frame does not overtake
            timestamp = max(timestamp, deliveries[-1].timestamp)
        if not (disturbed and fault == 0):
            deliveries.append(Delivery(0, frame, timestamp))
            if disturbed and fault == 1:
                deliveries.append(Delivery(0, frame, timestamp))
            elif disturbed and fault == 2 and frame + 1 < frames:
                frame += 1
                deliveries.append(Delivery(0, frame - 1, max(timestamp, frame * period)))
        frame += 1
    return tuple(deliveries)


def _clutter(maker: _Maker) -> TrackingClip:
    """Makes a drive on a road with seams, remains of old markings, repairs, shadows, words, kerbs and traffic."""
    style: RoadStyle = "street" if maker.sampler.bernoulli(0.3) else maker.style()
    return _whole(TruePart(maker.drive(10.0, style, _cluttered, clutter=True)))


def _cluttered(scene: Scene) -> bool:
    """Returns whether most kinds of lines that bound no lane are on the road."""
    surface, paintwork = scene.surface, scene.paintwork
    clutter = (
        paintwork.ghosts,
        paintwork.stencils,
        surface.seams,
        surface.joints,
        len(surface.repairs) > 3,
        any(isinstance(shadow, LineShadow | TreeShadow) for shadow in scene.light.shadows),
        scene.walls or scene.kerbs,
        len(scene.traffic) > 5,
    )
    return bool(paintwork.ghosts) and sum(map(bool, clutter)) >= 6


def _drift(maker: _Maker) -> TrackingClip:
    """Makes a vehicle that drifts over a line by half a meter or more, or turns back 0.3 m or more before it."""
    sampler, crosses, side = maker.sampler, maker.variant(2) == 0, maker.sampler.choice((1.0, -1.0))
    speed = 0.1 * 8.0 ** sampler.uniform(0.0, 1.0) if crosses else sampler.uniform(0.1, 0.3)
    start = sampler.uniform(1.5, 3.0)
    clip = maker.drive(start + 2.2 / speed, maker.style(), _in_wide_lane, sway=(0.0, 0.02))
    edges = [
        clip.scene.road.boundaries[index].u for index in _ego_boundaries(clip.scene.road, clip.scene.pose) or (0, 1)
    ]
    inside = side * ((edges[0] if side > 0.0 else edges[1]) - clip.scene.pose.u) - VEHICLE_WIDTH / 2.0
    if crosses:
        drift = Drift(start, side * (inside + sampler.uniform(0.53, 0.65)), speed)
        moves: tuple[SidewaysMove | Drift, ...] = (drift,)
    else:
        drift = Drift(start, side * (inside - sampler.uniform(0.33, 0.45)), speed)
        moves = (drift, SidewaysMove(start + drift.duration + 0.5, -drift.shift))
    frames = round((moves[-1].start + moves[-1].duration + 1.5) * maker.fps)
    return _whole(TruePart(replace(clip, motion=replace(clip.motion, moves=moves), frames=frames)))


def _in_wide_lane(scene: Scene) -> bool:
    left, right = _ego_boundaries(scene.road, scene.pose) or (0, 0)
    return scene.road.boundaries[left].u - scene.road.boundaries[right].u >= 3.3


KINDS: Mapping[str, Callable[[_Maker], TrackingClip]] = {
    "keeping": _keeping,
    "lane_change": _lane_change,
    "curve": _curve,
    "occlusion": _occlusion,
    "merge": _merge,
    "bump": _bump,
    "cut": _cut,
    "bad_weather": _bad_weather,
    "bad_time": _bad_time,
    "clutter": _clutter,
    "drift": _drift,
    "long": _long,
}
