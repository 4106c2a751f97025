"""Where a run's patches come from: rendered scenes and labelled real frames, cut once and kept in a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lanestream.inference.providers import cpu_threads
from lanestream_exporter.datasets.splits import data_root
from lanestream_exporter.patchstore import read_stores
from lanestream_exporter.rendering import files_of, real_store, rendered_stores
from lanestream_exporter.training.classifier import PatchSource
from lanestream_exporter.training.config import PatchData


def patch_sources(
    data: PatchData, folder: Path, root: Path | None, done: Callable[[int, int], None]
) -> tuple[list[PatchSource], dict[str, Any]]:
    """The sources that `data` asks for, and what to remember of their origin; patches are made where they are missing.

    `root` is the folder of the project's real frames, where it is not the default one. `done` is told (how many more
    scenes are rendered, how many there are). Raises LabelError for frames that can't be used.
    """
    sources: list[PatchSource] = []
    origin: dict[str, Any] = {}
    if data.wants_real:
        sources.append(_real(folder, data_root(root)))
        origin["real_frames"] = "the project's splits: TuSimple 0313-1, Udacity"
    if data.rendered_scenes:
        sources.append(_rendered(data, folder, done))
        origin["rendered_scenes"] = data.rendered_scenes
    return sources, origin


def _real(folder: Path, root: Path) -> PatchSource:
    train, check = (read_stores([real_store(folder, root, split)]) for split in ("train", "val"))
    return PatchSource("real", train, check)


def _rendered(data: PatchData, folder: Path, done: Callable[[int, int], None]) -> PatchSource:
    """The first file validates; scenes of the others are trained on."""
    scenes = [data.validation_scenes, *files_of(data.rendered_scenes)]
    paths = rendered_stores(folder, scenes, cpu_threads(), lambda more: done(more, sum(scenes)))
    return PatchSource("rendered", read_stores(paths[1:]), read_stores(paths[:1]))
