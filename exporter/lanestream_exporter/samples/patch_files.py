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
from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame, LabeledImages, to_working
from lanestream_exporter.samples.cache import FIRST_HARD_FILE, NO_ROAD, SAMPLES_VERSION, scene_files
from lanestream_exporter.samples.hard_scenes import Committee, Disagreement
from lanestream_exporter.samples.patches import Patches, PatchMaker
from lanestream_exporter.samples.prior_regressor import PriorRegressor, load_prior_regressor
from lanestream_exporter.samples.truth import NOTHING
from lanestream_exporter.scenes import render_still, sample_picture, sample_scene

# The name of the data set of rendered scenes.
RENDERED = "rendered scenes"

# How often the labels of a frame to train on are jittered.
_JITTER_ROUNDS = 5

# More candidates of a frame to train on than are served: the weaker ones are real negatives, which are scarce.
_MOST_TO_TRAIN = 32

# Sizes of rendered stills and how often each is drawn: cameras differ, and so does the sharpness of a patch.
_SIZES = ((640, 360), (640, 480), (640, 640), (960, 540), (1280, 720))
_SHARES = (0.37, 0.2, 0.05, 0.23, 0.15)

# High quality without chroma subsampling: compression must not give away which patches are rendered.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 93, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True)
class PatchStore:
    """Encoded RGB patches one after another in `data`, patch i at `offsets[i]:offsets[i + 1]`.

    `targets` (N, 3) are those of `patches.Patches`, and `sets` (N,) the index of each patch's data set in `names`.
    """

    data: NDArray[np.uint8]
    offsets: NDArray[np.int64]
    targets: NDArray[np.int8]
    sets: NDArray[np.int16]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.targets)

    @property
    def has_nothing(self) -> bool:
        """Whether any patch certainly shows no boundary."""
        return bool((self.targets[:, 0] == NOTHING).any())

    def patch(self, index: int) -> NDArray[np.uint8]:
        """Returns one RGB patch (H, W, 3)."""
        encoded = self.data[self.offsets[index] : self.offsets[index + 1]]
        return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR_RGB), dtype=np.uint8)


def write_store(path: Path, patches: Iterable[tuple[str, Patches]]) -> int:
    """Writes patches, each batch with the name of its data set, to `path` (.npz) atomically; returns their number."""
    encoded: list[NDArray[np.uint8]] = []
    targets, sets = [np.zeros((0, 3), np.int8)], [np.zeros(0, np.int16)]
    names: dict[str, int] = {}
    for name, batch in patches:
        encoded += [cv2.imencode(".jpg", patch[:, :, ::-1], _JPEG)[1].ravel() for patch in batch.pixels]
        targets.append(batch.targets)
        sets.append(np.full(len(batch.targets), names.setdefault(name, len(names)), np.int16))
    offsets = np.cumsum([0, *(len(data) for data in encoded)])
    unfinished = path.with_suffix(".part.npz")
    np.savez(
        unfinished,
        data=np.concatenate(encoded) if encoded else np.zeros(0, np.uint8),
        offsets=offsets,
        targets=np.concatenate(targets),
        sets=np.concatenate(sets),
        names=np.array(list(names), dtype=np.str_),
    )
    unfinished.replace(path)
    return len(encoded)


def read_stores(paths: Sequence[Path]) -> PatchStore:
    """Returns all patches of the files at `paths` as one store. Raises LabelError for a file without patches."""
    parts: list[PatchStore] = []
    names: dict[str, int] = {}
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as file:
                own = [names.setdefault(str(name), len(names)) for name in file["names"]]
                sets = np.array(own, np.int16)[file["sets"]]
                parts.append(PatchStore(file["data"], file["offsets"], file["targets"], sets, ()))
        except (OSError, ValueError, KeyError) as error:
            raise LabelError(f"{path} is not a file of patches", "delete it, and it is made again") from error
    starts = np.cumsum([0, *(len(part.data) for part in parts)])
    offsets = [part.offsets[:-1] + start for part, start in zip(parts, starts, strict=False)]
    return PatchStore(
        np.concatenate([part.data for part in parts]),
        np.concatenate([*offsets, starts[-1:]]).astype(np.int64),
        np.concatenate([part.targets for part in parts]),
        np.concatenate([part.sets for part in parts]),
        tuple(names),
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

    def hard(
        self, scenes: Sequence[int], committee: Committee, workers: int, done: Callable[[int], None]
    ) -> list[Path]:
        """Returns files of patches like `rendered`, of those scenes about which the detectors disagree.

        Raises ModelError for a bad file of the `committee`.
        """
        committee.load()  # reports a bad file here rather than in another process
        write = partial(_write_rendered, self.size, self.regressor, committee=committee)
        return scene_files(self.folder, f"hard-{committee.digest}-{self._kind}", scenes, write, workers, done)

    def no_road(self, pictures: Sequence[int], workers: int, done: Callable[[int], None]) -> list[Path]:
        """Returns files of patches of pictures without a road, the n-th of `pictures[n]` and seeded by n."""
        write = partial(_write_no_road, self.size, self.regressor)
        return scene_files(self.folder, f"no-road-{self._kind}", pictures, write, workers, done)

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


def _write_rendered(
    size: int, regressor: Path | None, number: int, scenes: int, path: Path, committee: Committee | None = None
) -> None:
    maker = PatchMaker(PatchGeometry(size), _prior_or_none(regressor))
    disagreement = None if committee is None else committee.load()
    first = 0 if committee is None else FIRST_HARD_FILE
    write_store(path, _rendered_patches(maker, first + number, scenes, disagreement))


def _rendered_patches(
    maker: PatchMaker, number: int, scenes: int, disagreement: Disagreement | None
) -> Iterator[tuple[str, Patches]]:
    for index in range(scenes):
        rng = np.random.default_rng([number, index])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        still = render_still(sample_scene(rng, width, height))
        if disagreement is not None and not disagreement.about(still.image):
            continue
        labels, image = to_working(still.labels, still.image)
        horizon = Scaling.to_working_width(width).to_working(still.horizon)
        for patches in maker.all_of(image, labels, RoadView(labels.width, labels.height, horizon), rng):
            yield RENDERED, patches


def _write_no_road(size: int, regressor: Path | None, number: int, pictures: int, path: Path) -> None:
    maker = PatchMaker(PatchGeometry(size), _prior_or_none(regressor), _MOST_TO_TRAIN)
    write_store(path, ((NO_ROAD, patches) for patches in _no_road_patches(maker, number, pictures)))


def _no_road_patches(maker: PatchMaker, number: int, pictures: int) -> Iterator[Patches]:
    for index in range(pictures):
        rng = np.random.default_rng([number, index, 3])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        nothing = LabeledFrame(width, height, (), NO_ROAD, NO_ROAD, WHOLE)
        labels, image = to_working(nothing, sample_picture(rng, width, height))
        yield maker.proposed(image, labels, maker.propose(image))


def _labeled_patches(maker: PatchMaker, frames: LabeledImages, to_train: bool) -> Iterator[tuple[str, Patches]]:
    for number, (frame, image) in enumerate(itertools.starmap(to_working, frames)):
        rng = np.random.default_rng([number, 1])
        proposals = maker.propose(image)
        yield frame.dataset, maker.proposed(image, frame, proposals).known
        for _ in range(_JITTER_ROUNDS if to_train else 0):
            yield frame.dataset, maker.jittered(image, frame, proposals.view, rng).known
