"""Patches of one's own labelled frames: read in any known form, divided by drive, never by frame."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from lanestream.road.view import Image
from lanestream_exporter.datasets.label_propagation import frames_between
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.reading import read_dataset
from lanestream_exporter.datasets.splits import refuse_leak, split_by_group
from lanestream_exporter.samples.patch_files import PatchStores
from lanestream_exporter.training.config import Frames, PatchData

FrameStream = Iterator[tuple[LabelledFrame, Image]]


def own_frames(data: PatchData) -> tuple[FrameStream, FrameStream]:
    """The frames that `data` names, with their BGR pictures: to train on, and to validate with.

    Raises LabelError for a record that can't be used, and where a drive or clip is on both sides.
    """
    groups = [frame.group for frame, _ in _frames(data.train)]
    if not data.validation:
        split = split_by_group(groups, data.validation_share)
        return _of(_to_train(data), split.train), _of(_frames(data.train), split.validation)
    refuse_leak(groups, [frame.group for frame, _ in _frames(data.validation)])
    return _to_train(data), _frames(data.validation)


def own_stores(data: PatchData, stores: PatchStores) -> tuple[Path, Path]:
    """Files of patches of the frames that `data` names: to train on, and to validate with.

    They are cut anew where the frames have changed. Raises LabelError as `own_frames` does.
    """
    key = _fingerprint(data)
    train = stores.labelled(f"own-train-{key}", lambda: own_frames(data)[0], to_train=True)
    return train, stores.labelled(f"own-validation-{key}", lambda: own_frames(data)[1], to_train=False)


def _frames(sources: Sequence[Frames]) -> FrameStream:
    for source in sources:
        yield from read_dataset(Path(source.path), source.format)


def _to_train(data: PatchData) -> FrameStream:
    """All frames of the sources to train on, and those between labelled ones of their videos."""
    yield from _frames(data.train)
    if data.labelling is not None:
        for source in data.train:
            yield from frames_between(Path(source.path), source.format, data.labelling)


def _of(frames: FrameStream, groups: Collection[str]) -> FrameStream:
    return ((frame, image) for frame, image in frames if frame.group in groups)


def _fingerprint(data: PatchData) -> str:
    """Changes with the sources, how they are divided, and the files in them."""
    digest = hashlib.sha256(repr((data.train, data.validation, data.validation_share, data.between)).encode())
    for source in (*data.train, *data.validation):
        path = Path(source.path)
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.is_file():
                status = file.stat()
                digest.update(f"{file} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:12]
