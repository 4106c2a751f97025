"""Patches of rendered scenes and of real frames, made once and kept in a folder."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.detection.patches import PatchCutter, PatchGeometry
from lanestream.detection.proposals import CandidateSearch
from lanestream.road.view import Image, RoadView
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.samples.cache import scene_files
from lanestream_exporter.samples.patch_store import write_store
from lanestream_exporter.samples.patches import PatchMaker
from lanestream_exporter.samples.prior_regressor import prior_estimator
from lanestream_exporter.scenes import render_still, sample_scene

Frames = Iterable[tuple[LabelledFrame, Image]]

_ROUNDS = 5

# Sizes of rendered stills and how often each is drawn: cameras differ, and so does how sharp a strip is.
_SIZES = ((640, 360), (640, 480), (960, 540), (1280, 720))
_SHARES = (0.4, 0.2, 0.25, 0.15)


@dataclass(frozen=True)
class PatchStores:
    """Files in `folder` with patches of `size` x `size` pixels; those already there are kept.

    Candidates are proposed as with the regressor at `guide`, an ONNX file, where there is one, else without.
    """

    folder: Path
    size: int
    guide: Path | None = None

    def rendered(self, scenes: Sequence[int], workers: int, done: Callable[[int], None]) -> list[Path]:
        """Files of patches, the n-th from `scenes[n]` scenes and seeded by n.

        `done` is called with the number of scenes of each file as it is finished.
        """
        write = partial(_render_file, self.size, self.guide)
        return scene_files(self.folder, f"rendered-{self._kind}", scenes, write, workers, done)

    def labelled(self, name: str, frames: Callable[[], Frames], to_train: bool) -> Path:
        """One file of patches, told by its `name`, from labelled frames and their BGR pictures.

        Frames give their own candidates; those to train on also candidates beside their labels, a few times.
        """
        path = self.folder / f"{name}-{self._kind}.npz"
        if not path.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            # More candidates than are served: the weaker ones are the real negatives, of which there are too few.
            search = CandidateSearch(limit=32) if to_train else CandidateSearch()
            maker = PatchMaker(search, PatchCutter(PatchGeometry(self.size)), glance=_glanced(self.guide))
            write_store(path, _labelled_patches(maker, frames(), to_train))
        return path

    @property
    def _kind(self) -> str:
        """What files of these patches are told by: another guide's are others. Raises ModelError for a bad one."""
        if self.guide is None:
            return f"{self.size}"
        prior_estimator(self.guide)  # what is no guide is told now, not by another process in the middle of a file
        return f"{self.size}-guided-{hashlib.sha256(self.guide.read_bytes()).hexdigest()[:8]}"


def _glanced(guide: Path | None) -> EgoPriorEstimator | None:
    return None if guide is None else prior_estimator(guide)


def _render_file(size: int, guide: Path | None, number: int, scenes: int, path: Path) -> None:
    maker = PatchMaker(cutter=PatchCutter(PatchGeometry(size)), glance=_glanced(guide))
    write_store(path, _rendered_patches(maker, number, scenes))


def _rendered_patches(maker: PatchMaker, number: int, scenes: int) -> Iterator[tuple[NDArray[np.uint8], int]]:
    for index in range(scenes):
        rng = np.random.default_rng([number, index])
        width, height = _SIZES[rng.choice(len(_SIZES), p=_SHARES)]
        still = render_still(sample_scene(rng, width, height))
        view = RoadView(width, height, still.horizon)
        yield from maker.all_of(still.image, still.labels, view, rng)


def _labelled_patches(maker: PatchMaker, frames: Frames, to_train: bool) -> Iterator[tuple[NDArray[np.uint8], int]]:
    clear = partial(filter, lambda item: item[1] in (0, 1))
    for number, (frame, image) in enumerate(frames):
        rng = np.random.default_rng([number, 1])
        proposals = maker.propose(image)
        yield from clear(zip(*maker.proposed(image, frame, proposals), strict=True))
        for _ in range(_ROUNDS if to_train else 0):
            yield from clear(zip(*maker.jittered(image, frame, proposals.view, rng), strict=True))
