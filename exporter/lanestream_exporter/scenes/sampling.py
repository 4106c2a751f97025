"""Sampling whole scenes: the kinds of road, weather and camera that training should meet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lanestream_exporter.scenes.camera import Camera
from lanestream_exporter.scenes.ground import grey, sample_paintwork, sample_patches, sample_surface
from lanestream_exporter.scenes.layout import Layout, Style, sample_layout
from lanestream_exporter.scenes.lens import Bonnet, Glare, Lens
from lanestream_exporter.scenes.light import Air, Light
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.road import Course, Pose, Road
from lanestream_exporter.scenes.scene import Scene
from lanestream_exporter.scenes.surroundings import (
    Stage,
    sample_backdrop,
    sample_bridges,
    sample_items,
    sample_shadows,
    sample_traffic,
    sample_walls,
)

if TYPE_CHECKING:
    from lanestream_exporter.scenes.surface import Colour

STILL_LENGTH = 260.0  # metres of road that a still can see
START = 20.0  # s of the vehicle at the start, metres: a little road lies behind it

STYLES: dict[Style, float] = {"highway": 0.52, "country": 0.27, "street": 0.14, "lane": 0.07}
SHARPEST: dict[Style, float] = {"highway": 1 / 250, "country": 1 / 30, "street": 1 / 60, "lane": 1 / 30}  # 1/m
CREST: dict[Style, float] = {"highway": 1.5e-4, "country": 6e-4, "street": 4e-4, "lane": 6e-4}  # usual vertical, 1/m
KNOT_SPACING: dict[Style, float] = {"highway": 40.0, "country": 20.0, "street": 25.0, "lane": 20.0}  # of curvature, m


@dataclass(frozen=True)
class Weather:
    """What the sampled parts of a scene must agree on."""

    night: bool
    dull: bool  # an overcast sky, without shadows
    wet: bool
    fog: float  # metres of sight, or infinity


def sample_scene(rng: np.random.Generator, width: int, height: int) -> Scene:
    """A random scene for a still picture of the given size in pixels."""
    dice = RandomSampler(rng)
    return compose_scene(dice, (width, height), dice.weighed(STYLES), sample_weather(dice), STILL_LENGTH)


def compose_scene(dice: RandomSampler, size: tuple[int, int], style: Style, weather: Weather, length: float) -> Scene:
    """A random scene of a given style and weather with `length` metres of road ahead."""
    layout = sample_layout(dice, style)
    course = sample_course(dice, style, length)
    walls = sample_walls(dice, layout)
    bridges = sample_bridges(dice, layout, length)
    shadows = () if weather.night or weather.dull else sample_shadows(dice, layout, Stage(walls, bridges, length))
    surface = replace(sample_surface(dice, layout), patches=sample_patches(dice, layout, length))
    backdrop = sample_backdrop(dice, night=weather.night, dull=weather.dull)
    return Scene(
        name=f"rendered-{style}-{dice.seed():08x}",
        camera=sample_camera(dice, size),
        pose=_pose(dice, layout),
        road=Road(course, layout.boundaries, layout.ahead),
        surface=surface,
        paintwork=sample_paintwork(dice, layout, length),
        light=replace(_light(dice, weather), shadows=shadows),
        air=_air(dice, weather, backdrop.skyline),
        backdrop=backdrop,
        lens=sample_lens(dice, weather),
        walls=walls,
        items=sample_items(dice, layout, length),
        bridges=bridges,
        traffic=sample_traffic(dice, layout, START, length),
        wetness=dice.between(0.15, 0.5) if weather.wet else 0.0,
    )


def sample_weather(dice: RandomSampler) -> Weather:
    """Mostly clear days; one scene in twelve at night."""
    night, dull = dice.chance(0.08), dice.chance(0.25)
    wet = dull and dice.chance(0.4)
    fog = dice.between(40.0, 250.0) if dice.chance(0.3 if wet else 0.06) else float("inf")
    return Weather(night, dull, wet, fog)


def sample_camera(dice: RandomSampler, size: tuple[int, int]) -> Camera:
    """A dash camera of the given picture size (width, height)."""
    width, height = size
    view = dice.between(42.0, 70.0) if dice.chance(0.7) else dice.between(70.0, 100.0)
    mount = dice.between(1.1, 1.6) if dice.chance(0.8) else dice.between(1.0, 2.4)
    return Camera(width, height, view, mount, height * dice.between(0.32, 0.63))


def sample_course(dice: RandomSampler, style: Style, length: float) -> Course:
    """A course whose curvature wanders; straight roads are as common as they are outside."""
    spacing = KNOT_SPACING[style]
    knots = int((length + 2.0 * START) / spacing) + 2
    sharpest = 0.0 if dice.chance(0.15) else SHARPEST[style] * dice.between(0.1, 1.0)
    value, values = dice.around(0.6 * sharpest), []
    for _ in range(knots):
        values.append(float(np.clip(value, -sharpest, sharpest)))
        value = 0.75 * value + dice.around(0.5 * sharpest)
    bend = 0.0 if dice.chance(0.4) else dice.around(CREST[style])
    return Course(spacing, tuple(values), bend)


def _pose(dice: RandomSampler, layout: Layout) -> Pose:
    """Somewhere in the lane, now and then changing it; the heading takes in the camera's own yaw."""
    between_lanes = dice.chance(0.08) and len(layout.ahead) > 1
    u = dice.between(-0.5, 0.5) * layout.lane_width if between_lanes else dice.around(0.22)
    return Pose(START, u, dice.around(0.025 if layout.style == "highway" else 0.04))


def _light(dice: RandomSampler, weather: Weather) -> Light:
    left = dice.between(0.22, 0.65)
    shade: Colour = (min(1.0, left * 1.12), left, left * 0.92)
    if weather.night:
        return Light(shade, headlights=dice.between(18.0, 50.0), glow=dice.between(0.01, 0.08))
    return Light(shade, sun=0.0 if weather.dull else dice.around(0.7))


def _air(dice: RandomSampler, weather: Weather, skyline: Colour) -> Air:
    if weather.night:
        return Air((0.02, 0.02, 0.02), 400.0)
    return Air(skyline, min(weather.fog, dice.between(500.0, 4000.0)))


def sample_lens(dice: RandomSampler, weather: Weather) -> Lens:
    """A camera's settings and faults: most pictures are good, some are poor in one or two ways."""
    dark = dice.chance(0.1) and not weather.night
    exposure = dice.between(0.1, 0.45) if dark else dice.between(0.75, 1.25)
    glare = None
    if dice.chance(0.1):
        glare = Glare(dice.between(0.0, 1.0), dice.between(0.0, 0.5), dice.between(0.1, 0.4), dice.between(0.15, 0.6))
    cast = dice.around(0.04)
    return Lens(
        exposure=dice.between(0.9, 1.7) if weather.night else exposure,
        gamma=dice.between(0.8, 1.25),
        cast=(1.0 + cast, 1.0 + dice.around(0.02), 1.0 - cast),
        saturation=dice.between(0.5, 1.25),
        lift=dice.between(0.0, 0.1) if dice.chance(0.3) else 0.0,
        vignette=dice.between(0.1, 0.5) if dice.chance(0.3) else 0.0,
        defocus=dice.between(0.3, 0.9) if dice.chance(0.5) else dice.between(0.0, 1.8) * float(dice.chance(0.2)),
        shake=dice.between(2.0, 6.0) if dice.chance(0.12) else 0.0,
        shake_angle=dice.between(60.0, 120.0),
        noise=dice.between(1.0, 3.0) if dice.chance(0.6) else dice.between(3.0, 9.0) * float(dice.chance(0.3)),
        quality=dice.whole(35, 95) if dice.chance(0.6) else 0,
        reflection=dice.between(0.2, 1.0) if dice.chance(0.12) else 0.0,
        glare=glare,
        bonnet=_bonnet(dice) if dice.chance(0.3) else None,
        seed=dice.seed(),
    )


def _bonnet(dice: RandomSampler) -> Bonnet:
    tone = dice.between(0.03, 0.15) if dice.chance(0.6) else dice.between(0.2, 0.6)
    colour = grey(dice, tone) if dice.chance(0.7) else (0.15 * tone, 0.2 * tone, tone)
    return Bonnet(dice.between(0.03, 0.14), dice.between(0.0, 0.06), colour, dice.between(0.0, 0.5))
