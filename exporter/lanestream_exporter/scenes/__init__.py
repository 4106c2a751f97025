"""Procedural road scenes and clips with exact ground truth.

A scene is one frozen value (`scene.py`) that `sampling.py` draws at random and `render.py` turns into pixels and
labels. Everything on the ground is a function of road coordinates: s metres along the road and u metres to the left of
its reference line. `view.py` maps every pixel to (s, u) once a frame, so paint, wear and shadows move with the road,
and labels come from the inverse of the same map.
"""

from lanestream_exporter.scenes.clip import Clip, Drive, render_clip, sample_clip
from lanestream_exporter.scenes.render import RenderedFrame, render_still
from lanestream_exporter.scenes.sampling import sample_scene
from lanestream_exporter.scenes.scene import Scene
from lanestream_exporter.scenes.video import write_clip

__all__ = [
    "Clip",
    "Drive",
    "RenderedFrame",
    "Scene",
    "render_clip",
    "render_still",
    "sample_clip",
    "sample_scene",
    "write_clip",
]
