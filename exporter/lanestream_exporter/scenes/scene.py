"""A scene as one value, and sampling of whole scenes: the roads, weather and cameras that training should cover."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lanestream_exporter.scenes.layout import Layout, RoadStyle, sample_layout
from lanestream_exporter.scenes.lens import Glare, Hood, Lens
from lanestream_exporter.scenes.light import Atmosphere, SceneLight
from lanestream_exporter.scenes.paint_sampling import sample_humps, sample_paintwork
from lanestream_exporter.scenes.projection import PinholeCamera
from lanestream_exporter.scenes.random_sampler import RandomSampler
from lanestream_exporter.scenes.road import Course, Pose, Road
from lanestream_exporter.scenes.surface_sampling import gray, sample_repairs, sample_surface
from lanestream_exporter.scenes.surroundings_sampling import (
    ShadowCasters,
    sample_backdrop,
    sample_bridges,
    sample_items,
    sample_kerbs,
    sample_queues,
    sample_shadows,
    sample_traffic,
    sample_walls,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from lanestream_exporter.scenes.backdrop import Backdrop
    from lanestream_exporter.scenes.kerbs import Kerb
    from lanestream_exporter.scenes.markings import Paintwork
    from lanestream_exporter.scenes.roadside import Bridge, RoadsideItem, Wall
    from lanestream_exporter.scenes.surface import Color, Surface
    from lanestream_exporter.scenes.traffic import Vehicle

STILL_LENGTH = 260.0  # meters of road that are visible in a still
START = 20.0  # s of the vehicle at the start, meters, so that there is some road behind it

STYLES: dict[RoadStyle, float] = {
    "highway": 0.39,
    "country": 0.21,
    "street": 0.18,
    "lane": 0.08,
    "campus": 0.11,
    "square": 0.03,
}
MAX_CURVATURE: dict[RoadStyle, float] = {
    "highway": 1 / 250,
    "country": 1 / 30,
    "street": 1 / 60,
    "lane": 1 / 30,
    "campus": 1 / 40,
    "square": 1 / 60,
}  # 1/m
VERTICAL_CURVATURE: dict[RoadStyle, float] = {
    "highway": 1.5e-4,
    "country": 6e-4,
    "street": 4e-4,
    "lane": 6e-4,
    "campus": 3e-4,
    "square": 0.0,
}  # sigma of the vertical curvature, 1/m
KNOT_SPACING: dict[RoadStyle, float] = {
    "highway": 40.0,
    "country": 20.0,
    "street": 25.0,
    "lane": 20.0,
    "campus": 20.0,
    "square": 40.0,
}  # meters
QUEUE_SHARES: dict[RoadStyle, float] = {"highway": 0.1, "street": 0.25}  # stills with standing traffic, by style


@dataclass(frozen=True)
class Scene:
    """One moment on a road. Equal scenes render to equal frames, because every seed is part of the scene."""

    name: str
    camera: PinholeCamera
    pose: Pose
    road: Road
    surface: Surface
    paintwork: Paintwork
    light: SceneLight
    atmosphere: Atmosphere
    backdrop: Backdrop
    lens: Lens
    kerbs: tuple[Kerb, ...] = ()
    walls: tuple[Wall, ...] = ()
    items: tuple[RoadsideItem, ...] = ()
    bridges: tuple[Bridge, ...] = ()
    traffic: tuple[Vehicle, ...] = ()
    wetness: float = 0.0  # share of the scene that a wet road reflects


@dataclass(frozen=True)
class Weather:
    """Conditions that all sampled parts of a scene share."""

    night: bool
    overcast: bool  # no shadows
    wet: bool
    fog: float  # visibility in meters, or infinity


def sample_scene(
    rng: np.random.Generator, width: int, height: int, styles: Mapping[RoadStyle, float] = STYLES
) -> Scene:
    """Samples a scene for a still of the given size in pixels, on a road of one of the `styles` by their weights."""
    sampler = RandomSampler(rng)
    style = sampler.weighted_choice(styles)
    scene = compose_scene(sampler, (width, height), style, sample_weather(sampler), STILL_LENGTH)
    if sampler.bernoulli(QUEUE_SHARES.get(style, 0.0)):
        elsewhere = tuple(car for car in scene.traffic if all(abs(car.u - lane) > 1.5 for lane in scene.road.lanes))
        queues = sample_queues(sampler, scene.road.lanes, START, STILL_LENGTH)
        scene = replace(scene, traffic=(*elsewhere, *queues))
    return _seen_by_other_cameras(sampler, scene)


def _seen_by_other_cameras(sampler: RandomSampler, scene: Scene) -> Scene:
    """Returns 12 % of the scenes as a camera sees them that looks down on the road, and 8 % near the ground.

    The horizon of a camera that looks down may lie above the image.
    """
    camera, place = scene.camera, sampler.uniform(0.0, 1.0)
    if place < 0.12:
        camera = replace(
            camera,
            field_of_view=sampler.uniform(42.0, 75.0),
            mount_height=sampler.uniform(1.8, 2.8),
            horizon=camera.height * sampler.uniform(-0.35, 0.05),
        )
        return replace(scene, camera=camera, lens=replace(scene.lens, hood=None))
    if place < 0.2:
        return replace(scene, camera=replace(camera, mount_height=sampler.uniform(0.4, 0.9)))
    return scene


def compose_scene(
    sampler: RandomSampler, size: tuple[int, int], style: RoadStyle, weather: Weather, length: float
) -> Scene:
    """Samples a scene of the given style and weather with `length` meters of road ahead."""
    layout = sample_layout(sampler, style)
    course = sample_course(sampler, style, length)
    walls = sample_walls(sampler, layout)
    bridges = sample_bridges(sampler, layout, length)
    shadows = (
        ()
        if weather.night or weather.overcast
        else sample_shadows(sampler, layout, ShadowCasters(walls, bridges, length))
    )
    surface = replace(sample_surface(sampler, layout), repairs=sample_repairs(sampler, layout, length))
    humps, bars = sample_humps(sampler.branch(), layout, length)
    surface = replace(surface, repairs=(*surface.repairs, *humps))
    backdrop = sample_backdrop(sampler, night=weather.night, overcast=weather.overcast)
    scene = Scene(
        name=f"rendered-{style}-{sampler.seed():08x}",
        camera=sample_camera(sampler, size),
        pose=_pose(sampler, layout),
        road=Road(course, layout.boundaries, layout.ahead),
        surface=surface,
        paintwork=sample_paintwork(sampler, layout, length),
        light=replace(_light(sampler, weather), shadows=shadows),
        atmosphere=_atmosphere(sampler, weather, backdrop.skyline),
        backdrop=backdrop,
        lens=sample_lens(sampler, weather),
        kerbs=sample_kerbs(sampler.branch(), layout),
        walls=walls,
        items=sample_items(sampler, layout, length),
        bridges=bridges,
        traffic=sample_traffic(sampler, layout, START, length),
        wetness=sampler.uniform(0.15, 0.5) if weather.wet else 0.0,
    )
    return replace(scene, paintwork=replace(scene.paintwork, bars=(*scene.paintwork.bars, *bars)))


def sample_weather(sampler: RandomSampler) -> Weather:
    """Samples the weather: mostly clear days, 8 % nights."""
    night, overcast = sampler.bernoulli(0.08), sampler.bernoulli(0.25)
    wet = overcast and sampler.bernoulli(0.4)
    fog = sampler.uniform(40.0, 250.0) if sampler.bernoulli(0.3 if wet else 0.06) else float("inf")
    return Weather(night, overcast, wet, fog)


def sample_camera(sampler: RandomSampler, size: tuple[int, int]) -> PinholeCamera:
    """Samples a dash camera with the given image size (width, height)."""
    width, height = size
    field_of_view = sampler.uniform(42.0, 70.0) if sampler.bernoulli(0.7) else sampler.uniform(70.0, 100.0)
    mount = sampler.uniform(1.1, 1.6) if sampler.bernoulli(0.8) else sampler.uniform(1.0, 2.4)
    return PinholeCamera(width, height, field_of_view, mount, height * sampler.uniform(0.32, 0.63))


def sample_course(sampler: RandomSampler, style: RoadStyle, length: float) -> Course:
    """Samples a course whose curvature follows a random walk; 15 % of the roads are straight."""
    spacing = KNOT_SPACING[style]
    knots = int((length + 2.0 * START) / spacing) + 2
    max_curvature = 0.0 if sampler.bernoulli(0.15) else MAX_CURVATURE[style] * sampler.uniform(0.1, 1.0)
    value, values = sampler.normal(0.6 * max_curvature), []
    for _ in range(knots):
        values.append(float(np.clip(value, -max_curvature, max_curvature)))
        value = 0.75 * value + sampler.normal(0.5 * max_curvature)
    vertical_curvature = 0.0 if sampler.bernoulli(0.4) else sampler.normal(VERTICAL_CURVATURE[style])
    return Course(spacing, tuple(values), vertical_curvature)


def _pose(sampler: RandomSampler, layout: Layout) -> Pose:
    """Samples a pose in the lane, sometimes between two lanes; the heading includes the camera's own yaw."""
    if layout.style == "campus":
        return Pose(START, _place_on_unmarked_road(sampler, layout), sampler.normal(0.06))
    changing_lanes = sampler.bernoulli(0.08) and len(layout.ahead) > 1
    u = sampler.uniform(-0.5, 0.5) * layout.lane_width if changing_lanes else sampler.normal(0.22)
    return Pose(START, u, sampler.normal(0.025 if layout.style == "highway" else 0.04))


def _place_on_unmarked_road(sampler: RandomSampler, layout: Layout) -> float:
    """Samples u in meters anywhere between the near edge and a little beyond the middle of the road."""
    side = 1.0 if layout.oncoming[0] > 0.0 else -1.0  # of the oncoming lane
    half = layout.lane_width / 2.0  # the middle of the road is at half, the near edge at -half
    return side * sampler.uniform(1.0 - half, half + 0.2)


def _light(sampler: RandomSampler, weather: Weather) -> SceneLight:
    remaining = sampler.uniform(0.22, 0.65)
    shade: Color = (min(1.0, remaining * 1.12), remaining, remaining * 0.92)
    if weather.night:
        return SceneLight(shade, headlights=sampler.uniform(18.0, 50.0), glow=sampler.uniform(0.01, 0.08))
    return SceneLight(shade, sun=0.0 if weather.overcast else sampler.normal(0.7))


def _atmosphere(sampler: RandomSampler, weather: Weather, skyline: Color) -> Atmosphere:
    if weather.night:
        return Atmosphere((0.02, 0.02, 0.02), 400.0)
    return Atmosphere(skyline, min(weather.fog, sampler.uniform(500.0, 4000.0)))


def sample_lens(sampler: RandomSampler, weather: Weather) -> Lens:
    """Samples camera settings and faults: most images are good, some are poor in one or two ways."""
    dark = sampler.bernoulli(0.1) and not weather.night
    exposure = sampler.uniform(0.1, 0.45) if dark else sampler.uniform(0.75, 1.25)
    glare = None
    if sampler.bernoulli(0.1):
        glare = Glare(
            sampler.uniform(0.0, 1.0), sampler.uniform(0.0, 0.5), sampler.uniform(0.1, 0.4), sampler.uniform(0.15, 0.6)
        )
    color_cast = sampler.normal(0.04)
    return Lens(
        exposure=sampler.uniform(0.9, 1.7) if weather.night else exposure,
        gamma=sampler.uniform(0.8, 1.25),
        cast=(1.0 + color_cast, 1.0 + sampler.normal(0.02), 1.0 - color_cast),
        saturation=sampler.uniform(0.5, 1.25),
        lift=sampler.uniform(0.0, 0.1) if sampler.bernoulli(0.3) else 0.0,
        vignette=sampler.uniform(0.1, 0.5) if sampler.bernoulli(0.3) else 0.0,
        defocus=sampler.uniform(0.3, 0.9)
        if sampler.bernoulli(0.5)
        else sampler.uniform(0.0, 1.8) * float(sampler.bernoulli(0.2)),
        shake=sampler.uniform(2.0, 6.0) if sampler.bernoulli(0.12) else 0.0,
        shake_angle=sampler.uniform(60.0, 120.0),
        noise=sampler.uniform(1.0, 3.0)
        if sampler.bernoulli(0.6)
        else sampler.uniform(3.0, 9.0) * float(sampler.bernoulli(0.3)),
        quality=sampler.integer(35, 95) if sampler.bernoulli(0.6) else 0,
        reflection=sampler.uniform(0.2, 1.0) if sampler.bernoulli(0.12) else 0.0,
        glare=glare,
        hood=_hood(sampler) if sampler.bernoulli(0.3) else None,
        seed=sampler.seed(),
    )


def _hood(sampler: RandomSampler) -> Hood:
    tone = sampler.uniform(0.03, 0.15) if sampler.bernoulli(0.6) else sampler.uniform(0.2, 0.6)
    color = gray(sampler, tone) if sampler.bernoulli(0.7) else (0.15 * tone, 0.2 * tone, tone)
    return Hood(sampler.uniform(0.03, 0.14), sampler.uniform(0.0, 0.06), color, sampler.uniform(0.0, 0.5))
