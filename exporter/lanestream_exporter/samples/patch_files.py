"""Patch files: patches of rendered scenes and of labeled frames, made once and kept as JPEG bytes with their labels."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.proposals import MOST_CANDIDATES
from lanestream.errors import LabelError
from lanestream.road.crops import PatchGeometry
from lanestream.road.view import RoadView, Scaling
from lanestream_exporter.datasets.labels import LabeledImages, to_working
from lanestream_exporter.samples.cache import SAMPLES_VERSION, scene_files
from lanestream_exporter.samples.patches import PatchMaker
from lanestream_exporter.samples.prior_regressor import PriorRegressor, load_prior_regressor
from lanestream_exporter.scenes import render_still, sample_scene

# How often the labels of a frame to train on are jittered.
_JITTER_ROUNDS = 5

# More candidates of a frame to train on than are served: the weaker ones are real negatives, which are scarce.
_MOST_TO_TRAIN = 32

# Sizes of rendered stills and how often each is drawn: cameras differ, and so does the sharpness of a patch.
_SIZES = ((640, 360), (640, 480), (960, 540), (1280, 720))
_SHARES = (0.4, 0.2, 0.25, 0.15)

# High quality without chroma subsampling: compression must not give away which patches are rendered.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 93, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class PatchStore:
    """Encoded RGB patches one after another in `data`, patch i at `offsets[i]:offsets[i + 1]`; `labels` is (N,)."""

    data: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    labels: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.labels)

    def patch(self, index: int) -> NDArray[np.uint8]:
        """Returns one RGB patch (H, W, 3)."""
        encoded = self.data[self.offsets[index] : self.offsets[index + 1]]
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def write_store(path: Path, patches: Iterable[tuple[NDArray[np.uint8], int]]) -> int:
    """Writes RGB patches with their labels to `path` (.npz) atomically and returns their number."""
    encoded: list[NDArray[np.uint8]] = []
    labels: list[int] = []
    for patch, label in patches:
        encoded.append(cv2.imencode(".jpg", patch[:, :, ::-1], _JPEG)[1].ravel())
        labels.append(label)
    offsets = np.cumsum([0, *(len(data) for data in encoded)])
    data = np.concatenate(encoded) if encoded else np.zeros(0, np.uint8)
    unfinished = path.with_suffix(".part.npz")
    np.savez(unfinished, data=data, offsets=offsets, labels=np.asarray(labels, dtype=np.int64))
    unfinished.replace(path)
    return len(labels)


def read_stores(paths: Sequence[Path]) -> PatchStore:
    """Returns all patches of the files at `paths` as one store. Raises LabelError for a file without patches."""
    parts: list[PatchStore] = []
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as file:
                parts.append(PatchStore(file["data"], file["offsets"], file["labels"]))
        except (OSError, ValueError, KeyError) as error:
            raise LabelError(f"{path} is not a file of patches", "delete it, and it is made again") from error
    starts = np.cumsum([0, *(len(part.data) for part in parts)])
    offsets = [part.offsets[:-1] + start for part, start in zip(parts, starts, strict=False)]
    return PatchStore(
        np.concatenate([part.data for part in parts]),
        np.concatenate([*offsets, starts[-1:]]).astype(np.int64),
        np.concatenate([part.labels for part in parts]),
    )


@dataclass(frozen=True)
class PatchCache:
    """Files in `folder` with patches of `size` x `size` pixels. Existing files are kept.

    Candidates are proposed with the ego-lane prior of `regressor`, an ONNX file, if given.
    """

    folder: Path
    size: int
    regressor: Path | None = None

    def rendered(self, scenes: Sequence[int], workers: int, done: Callable[[int], None]) -> list[Path]:
        """Returns files of patches, the n-th from `scenes[n]` scenes and seeded by n; writes missing ones.

        `done` is called with the number of scenes of each file when it is finished. Raises ModelError for a bad
        regressor.
        """
        write = partial(_write_rendered, self.size, self.regressor)
        return scene_files(self.folder, f"rendered-{self._kind}", scenes, write, workers, done)

    def labeled(self, name: str, frames: Callable[[], LabeledImages], to_train: bool) -> Path:
        """Returns the file `name` of patches of labeled frames; writes it if missing.

        Patches are cut from the proposed candidates; for training also from jittered labels, several times. Raises
        ModelError for a bad regressor.
        """
        path = self.folder / f"{name}-{self._kind}-{SAMPLES_VERSION}.npz"
        if not path.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            limit = _MOST_TO_TRAIN if to_train else MOST_CANDIDATES
            maker = PatchMaker(PatchGeometry(self.size), _prior_or_none(self.regressor), limit)
            write_store(path, _labeled_patches(maker, frames(), to_train))
        return path

    @property
    def _kind(self) -> str:
        """The part of the file names that differs by patch size and regressor."""
        if self.regressor is None:
            return f"{self.size}"
        load_prior_regressor(self.regressor)  # reports a bad file here rather than in another process
        return f"{self.size}-prior-{hashlib.sha256(self.regressor.read_bytes()).hexdigest()[:8]}"


def _prior_or_none(regressor: Path | None) -> PriorRegressor | None:
    return None if regressor is None else load_prior_regressor(regressor)


def _write_rendered(size: int, regressor: Path | None, number: int, scenes: int, path: Path) -> None:
    maker = PatchMaker(PatchGeometry(size), _prior_or_none(regressor))
    write_store(path, _rendered_patches(maker, number, scenes))


def _rendered_patches(maker: PatchMaker, number: int, scenes: int) -> Iterator[tuple[NDArray[np.uint8], int]]:
    for index in range(scenes):
        rng = np.random.default_rng([number, index])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        still = render_still(sample_scene(rng, width, height))
        labels, image = to_working(still.labels, still.image)
        horizon = Scaling.to_working_width(width).to_working(still.horizon)
        yield from maker.all_of(image, labels, RoadView(labels.width, labels.height, horizon), rng)


def _labeled_patches(
    maker: PatchMaker, frames: LabeledImages, to_train: bool
) -> Iterator[tuple[NDArray[np.uint8], int]]:
    clear = partial(filter, lambda item: item[1] in (0, 1))
    for number, (frame, image) in enumerate(itertools.starmap(to_working, frames)):
        rng = np.random.default_rng([number, 1])
        proposals = maker.propose(image)
        yield from clear(zip(*maker.proposed(image, frame, proposals), strict=True))
        for _ in range(_JITTER_ROUNDS if to_train else 0):
            yield from clear(zip(*maker.jittered(image, frame, proposals.view, rng), strict=True))
