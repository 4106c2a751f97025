"""Procedural road scenes and clips with exact ground truth."""

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
