"""The data of a run: patches or frames, rendered and real, to train on and to validate with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lanestream.errors import LabelError
from lanestream.host import processors
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.samples.cache import scenes_per_file
from lanestream_exporter.samples.hard_scenes import Committee
from lanestream_exporter.samples.patch_files import PatchCache, PatchStore, read_stores
from lanestream_exporter.samples.road_frames import RoadFrame, no_road_frames, read_frames, rendered_frames, road_frames
from lanestream_exporter.samples.truth import MARKING, NOTHING, ROAD_EDGE
from lanestream_exporter.training.config import TrainingData


@dataclass(frozen=True)
class PatchSource:
    """Patches of one kind, `rendered` or `real`: those to train on, and those that choose the best network.

    Raises LabelError if either lacks patches with a boundary, or those to train on lack others. A few frames may have
    none of these to validate with.
    """

    name: str
    train: PatchStore
    check: PatchStore

    def __post_init__(self) -> None:
        for store, use in ((self.train, "train on"), (self.check, "validate with")):
            if (store.targets[:, 0] == NOTHING).all():
                raise LabelError(f"no {self.name} patches of boundaries to {use}", "give more frames")
        if not self.train.has_nothing:
            raise LabelError(f"no {self.name} patches without a boundary to train on", "give more frames")

    @property
    def counts(self) -> dict[str, Any]:
        """The numbers of patches in all, of each kind, type and color, and of each data set."""
        return {"train": _counts(self.train), "check": _counts(self.check)}


def _counts(store: PatchStore) -> dict[str, Any]:
    kinds, types, colors = store.targets.T
    return {
        "patches": len(store),
        "nothing": int((kinds == NOTHING).sum()),
        "marking": int((kinds == MARKING).sum()),
        "road_edge": int((kinds == ROAD_EDGE).sum()),
        **{name: int((types == index).sum()) for index, name in enumerate(MARKING_TYPES)},
        **{name: int((colors == index).sum()) for index, name in enumerate(MARKING_COLORS)},
        "sets": {name: int((store.sets == index).sum()) for index, name in enumerate(store.names)},
    }


@dataclass(frozen=True)
class PatchFiles:
    """The files of one kind of patches, `rendered` or `real`: to train on, and to validate with."""

    name: str
    train: tuple[Path, ...]
    check: tuple[Path, ...]

    def read(self) -> PatchSource:
        """Returns the patches in the files. Raises LabelError if there are too few."""
        return PatchSource(self.name, read_stores(self.train), read_stores(self.check))


@dataclass(frozen=True)
class RoadFrameSource:
    """Frames of one kind, `rendered` or `real`: those to train on, and those that choose the best network."""

    name: str
    train: Sequence[RoadFrame]
    check: Sequence[RoadFrame]

    def __post_init__(self) -> None:
        if not self.train or not self.check:
            raise LabelError(f"there are no {self.name} frames whose labels determine a horizon", "give more frames")


def open_datasets(data: TrainingData, folder: Path | None) -> DatasetCollection | None:
    """Returns the data sets that a recipe trains on, in the data folder `folder`; None if it has no real frames.

    Raises SettingsError for a bad manifest, LabelError for unusable labels and if there are no validation frames.
    """
    if not data.has_real_frames:
        return None
    datasets = DatasetCollection.open(None if data.manifest is None else Path(data.manifest), folder)
    datasets = datasets.without(data.without)
    datasets.require_splits("train", "val")
    return datasets


def patch_files(
    data: TrainingData, datasets: DatasetCollection | None, cache: PatchCache, done: Callable[[int, int], None]
) -> list[PatchFiles]:
    """Returns the files of patches that a recipe asks for; missing ones are made.

    Files of real patches are made again if the manifest or a file of its data sets changes. `done` is called with the
    number of scenes just rendered and the number of all. Raises LabelError for unusable frames.
    """
    files: list[PatchFiles] = []
    if datasets is not None:
        key, stride = datasets.fingerprint(), data.propagation_stride
        train = cache.labeled(
            f"real-train-{key}-{stride}", lambda: datasets.training_frames(data.propagation), to_train=True
        )
        check = cache.labeled(f"real-val-{key}", lambda: datasets.frames("val"), to_train=False)
        files.append(PatchFiles("real", (train,), (check,)))
    if data.rendered_scenes:
        # The first file validates; the scenes of the others are trained on.
        scenes = [data.validation_scenes, *scenes_per_file(data.rendered_scenes)]
        hard, no_road = scenes_per_file(data.hard_scenes), scenes_per_file(data.no_road_pictures)
        total = sum(scenes) + sum(hard) + sum(no_road)
        checked, *trained = cache.rendered(scenes, processors(), lambda more: done(more, total))
        trained += cache.no_road(no_road, processors(), lambda more: done(more, total))
        if data.committee is not None:
            committee = Committee(*map(Path, data.committee))
            trained += cache.hard(hard, committee, processors(), lambda more: done(more, total))
        files.append(PatchFiles("rendered", tuple(trained), (checked,)))
    return files


def frame_sources(
    data: TrainingData, datasets: DatasetCollection | None, folder: Path, done: Callable[[int, int], None]
) -> list[RoadFrameSource]:
    """Returns the frames that a recipe asks for; missing files of rendered frames are written to `folder`.

    `done` is called with the number of scenes just rendered and the number of all. Raises LabelError for unusable
    frames.
    """
    sources: list[RoadFrameSource] = []
    if datasets is not None:
        train = road_frames(datasets.training_frames(data.propagation))
        sources.append(RoadFrameSource("real", train, road_frames(datasets.frames("val"))))
    if data.rendered_scenes:
        scenes = [data.validation_scenes, *scenes_per_file(data.rendered_scenes)]
        hard, no_road = scenes_per_file(data.hard_scenes), scenes_per_file(data.no_road_pictures)
        total = sum(scenes) + sum(hard) + sum(no_road)
        checked, *trained = rendered_frames(folder, scenes, processors(), lambda more: done(more, total))
        trained += no_road_frames(folder, no_road, processors(), lambda more: done(more, total))
        if data.committee is not None:
            committee = Committee(*map(Path, data.committee))
            trained += rendered_frames(folder, hard, processors(), lambda more: done(more, total), committee)
        frames = [frame for path in trained for frame in read_frames(path)]
        sources.append(RoadFrameSource("rendered", frames, read_frames(checked)))
    return sources
