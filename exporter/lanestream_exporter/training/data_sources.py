"""The data of a run: patches or frames, rendered and real, to train on and to validate with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lanestream.errors import LabelError
from lanestream.host import processors
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.samples.cache import scenes_per_file
from lanestream_exporter.samples.patch_files import PatchCache, PatchStore, read_stores
from lanestream_exporter.samples.road_frames import RoadFrame, read_frames, rendered_frames, road_frames
from lanestream_exporter.training.config import TrainingData


@dataclass(frozen=True)
class PatchSource:
    """Patches of one kind, `rendered` or `real`: those to train on, and those that choose the best network.

    Raises LabelError if either lacks true or false patches.
    """

    name: str
    train: PatchStore
    check: PatchStore

    def __post_init__(self) -> None:
        for store, use in ((self.train, "train on"), (self.check, "validate with")):
            for label, verdict in ((1, "true"), (0, "false")):
                if not (store.labels == label).any():
                    raise LabelError(f"there are no {verdict} {self.name} patches to {use}", "give more frames")

    @property
    def counts(self) -> dict[str, int]:
        """The number of patches, and how many of them are true."""
        return {
            "train": len(self.train),
            "train_true": int(self.train.labels.sum()),
            "check": len(self.check),
            "check_true": int(self.check.labels.sum()),
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
        paths = cache.rendered(scenes, processors(), lambda more: done(more, sum(scenes)))
        files.append(PatchFiles("rendered", tuple(paths[1:]), tuple(paths[:1])))
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
        paths = rendered_frames(folder, scenes, processors(), lambda more: done(more, sum(scenes)))
        frames = [frame for path in paths[1:] for frame in read_frames(path)]
        sources.append(RoadFrameSource("rendered", frames, read_frames(paths[0])))
    return sources
