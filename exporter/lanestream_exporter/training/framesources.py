"""Where the regressor's frames come from: rendered scenes, kept in a folder, and labelled real frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lanestream.host import processors
from lanestream_exporter.datasets.splits import data_root, real_frames, training_frames
from lanestream_exporter.samples.cache import files_of
from lanestream_exporter.samples.road_frames import read_frames, rendered_frames, road_frames
from lanestream_exporter.training.ownframes import own_frames
from lanestream_exporter.training.regressor import FrameData, FrameSource


def frame_sources(
    data: FrameData, folder: Path, root: Path | None, done: Callable[[int, int], None]
) -> list[FrameSource]:
    """The sources that `data` asks for; scenes are rendered where they are missing.

    `root` is the folder of the project's real frames, where it is not the default one. `done` is told (how many more
    scenes are rendered, how many there are). Raises LabelError for frames that can't be used.
    """
    sources: list[FrameSource] = []
    if data.train:
        to_train, to_check = own_frames(data)
        sources.append(FrameSource("real", road_frames(to_train), road_frames(to_check)))
    elif data.wants_real:
        place = data_root(root)
        to_train, to_check = training_frames(place, data.labelling), real_frames(place, "val")
        sources.append(FrameSource("real", road_frames(to_train), road_frames(to_check)))
    if data.rendered_scenes:
        scenes = [data.validation_scenes, *files_of(data.rendered_scenes)]
        paths = rendered_frames(folder, scenes, processors(), lambda more: done(more, sum(scenes)))
        frames = [frame for path in paths[1:] for frame in read_frames(path)]
        sources.append(FrameSource("rendered", frames, read_frames(paths[0])))
    return sources
