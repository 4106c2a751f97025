"""A whole scene as one value: what is there, before anything is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lanestream_exporter.scenes.backdrop import Backdrop
    from lanestream_exporter.scenes.camera import Camera
    from lanestream_exporter.scenes.lens import Lens
    from lanestream_exporter.scenes.light import Air, Light
    from lanestream_exporter.scenes.markings import Paintwork
    from lanestream_exporter.scenes.road import Pose, Road
    from lanestream_exporter.scenes.roadside import Bridge, Item, Wall
    from lanestream_exporter.scenes.surface import Surface
    from lanestream_exporter.scenes.traffic import Vehicle


@dataclass(frozen=True)
class Scene:
    """One moment on a road. Equal scenes render to equal frames: every seed lies inside."""

    name: str
    camera: Camera
    pose: Pose
    road: Road
    surface: Surface
    paintwork: Paintwork
    light: Light
    air: Air
    backdrop: Backdrop
    lens: Lens
    walls: tuple[Wall, ...] = ()
    items: tuple[Item, ...] = ()
    bridges: tuple[Bridge, ...] = ()
    traffic: tuple[Vehicle, ...] = ()
    wetness: float = 0.0  # share of the scene that a wet road mirrors
