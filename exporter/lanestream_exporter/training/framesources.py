"""Where the regressor's frames come from: rendered scenes, kept in a folder, and labelled real frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lanestream.inference.providers import cpu_threads
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.rendering import files_of
from lanestream_exporter.roadframes import read_frames, real_road_frames, rendered_frames
from lanestream_exporter.training.regressor import FrameData, FrameSource


def frame_sources(
    data: FrameData, folder: Path, root: Path | None, done: Callable[[int, int], None]
) -> tuple[list[FrameSource], dict[str, Any]]:
    """The sources that `data` asks for, and what to remember of their origin; scenes are rendered where missing.

    `root` is the folder of the project's real frames, where it is not the default one. `done` is told (how many more
    scenes are rendered, how many there are). Raises LabelError for frames that can't be used.
    """
    sources: list[FrameSource] = []
    origin: dict[str, Any] = {}
    if data.wants_real:
        place = data_root(root)
        sources.append(FrameSource("real", real_road_frames(place, "train"), real_road_frames(place, "val")))
        origin["real_frames"] = "the project's splits: TuSimple 0313-1, Udacity"
    if data.rendered_scenes:
        scenes = [data.validation_scenes, *files_of(data.rendered_scenes)]
        paths = rendered_frames(folder, scenes, cpu_threads(), lambda more: done(more, sum(scenes)))
        frames = [frame for path in paths[1:] for frame in read_frames(path)]
        sources.append(FrameSource("rendered", frames, read_frames(paths[0])))
        origin["rendered_scenes"] = data.rendered_scenes
    return sources, origin
