"""Where a run's patches come from: rendered scenes and labelled real frames, cut once and kept in a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lanestream.host import processors
from lanestream_exporter.datasets.splits import data_root, real_frames, training_frames
from lanestream_exporter.samples.cache import files_of
from lanestream_exporter.samples.patch_files import PatchStores
from lanestream_exporter.training.config import PatchData
from lanestream_exporter.training.ownframes import own_stores
from lanestream_exporter.training.patchfiles import PatchFiles


def patch_files(
    data: PatchData, stores: PatchStores, root: Path | None, done: Callable[[int, int], None]
) -> list[PatchFiles]:
    """The patches that `data` asks for, as files of `stores`; they are made where they are missing.

    `root` is the folder of the project's real frames, where it is not the default one. `done` is told (how many more
    scenes are rendered, how many there are). Raises LabelError for frames that can't be used.
    """
    files: list[PatchFiles] = []
    if data.train:
        train, check = own_stores(data, stores)
        files.append(PatchFiles("real", (train,), (check,)))
    elif data.wants_real:
        real, between = data_root(root), data.labelling
        train = stores.labelled(f"real-train-{data.between}", lambda: training_frames(real, between), to_train=True)
        check = stores.labelled("real-val", lambda: real_frames(real, "val"), to_train=False)
        files.append(PatchFiles("real", (train,), (check,)))
    if data.rendered_scenes:
        # The first file validates; scenes of the others are trained on.
        scenes = [data.validation_scenes, *files_of(data.rendered_scenes)]
        paths = stores.rendered(scenes, processors(), lambda more: done(more, sum(scenes)))
        files.append(PatchFiles("rendered", tuple(paths[1:]), tuple(paths[:1])))
    return files


def origin_of(data: PatchData) -> dict[str, Any]:
    """What to remember of where a run's patches came from, in plain types."""
    if data.train:
        real = ", ".join(frames.path for frames in data.train)
    else:
        real = "TuSimple 0313-1 and Udacity, training splits" if data.wants_real else "none"
    return {"real_frames": real, "rendered_scenes": data.rendered_scenes}
