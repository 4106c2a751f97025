"""Procedural road scenes and clips with exact ground truth.

A scene is one frozen value: `scene.py` samples it at random and `render.py` turns it into pixels and labels. Everything
on the ground is a function of road coordinates: s meters along the road and u meters to the left of its reference line.
`projection.py` maps every pixel to (s, u) once per frame, so that paint, wear and shadows move with the road. Labels
come from the inverse of the same mapping. `tracking_clips.py` samples clips for measuring trackers.

`no_road` makes pictures in which a detector must find nothing.
"""

from lanestream_exporter.scenes.clip import Clip, Drive, render_clip, sample_clip, write_clip
from lanestream_exporter.scenes.no_road import sample_picture
from lanestream_exporter.scenes.render import RenderedFrame, render_still
from lanestream_exporter.scenes.scene import Scene, sample_scene

__all__ = [
    "Clip",
    "Drive",
    "RenderedFrame",
    "Scene",
    "render_clip",
    "render_still",
    "sample_clip",
    "sample_picture",
    "sample_scene",
    "write_clip",
]
