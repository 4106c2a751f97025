"""The frames that an export uses: training frames for ranks and ranges, validation frames for calibration and proof."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledImages
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.samples.road_frames import RoadFrame, road_frames
from lanestream_exporter.scenes import render_still, sample_scene

# An export never uses test frames.
Part = Literal["train", "val"]

T = TypeVar("T")

# Seed of the rendered frames, different from the seeds of rendered training data.
_SEED: Final = 7001
_SIZES: Final = ((640, 360), (640, 480), (960, 540))
_JPEG: Final = (cv2.IMWRITE_JPEG_QUALITY, 95)


@dataclass(frozen=True)
class LabeledJpeg:
    """A frame as a client would send it, with its labels."""

    jpeg: bytes
    labels: LabeledFrame


@dataclass(frozen=True)
class ExportFrames:
    """Rendered frames, `rendered` per part, and labeled real frames of `datasets`, if given.

    At most `real` frames per part and data set are used, evenly spaced among all, so that no data set dominates.
    """

    datasets: DatasetCollection | None
    rendered: int = 48
    real: int = 24

    @property
    def origin(self) -> str:
        """Returns a description of where the frames come from."""
        if self.datasets is None:
            return "rendered scenes"
        return f"rendered scenes and real frames of {', '.join(credit['name'] for credit in self.datasets.credits())}"

    def jpegs(self, part: Part) -> list[LabeledJpeg]:
        """Returns full frames of `part` as JPEG files. Raises LabelError for unreadable real frames."""
        rendered = [LabeledJpeg(_encode(image), labels) for labels, image, _ in self._rendered(part)]
        real = [LabeledJpeg(_encode(image), labels) for labels, image in self._real(part)]
        return [*_evenly_spaced(real, self.real, lambda frame: frame.labels.dataset), *rendered]

    def road_frames(self, part: Part) -> list[RoadFrame]:
        """Returns downscaled frames of `part` with known horizons. Raises LabelError for unreadable real frames."""
        rendered = [RoadFrame.of(labels, image, horizon) for labels, image, horizon in self._rendered(part)]
        real = _evenly_spaced(road_frames(self._real(part)), self.real, lambda frame: frame.dataset)
        return [*real, *(frame for frame in rendered if frame is not None)]

    def _real(self, part: Part) -> LabeledImages:
        return iter(()) if self.datasets is None else self.datasets.frames(part)

    def _rendered(self, part: Part) -> Iterator[tuple[LabeledFrame, Image, float]]:
        for index in range(self.rendered):
            rng = np.random.default_rng([_SEED, 0 if part == "train" else 1, index])
            still = render_still(sample_scene(rng, *_SIZES[index % len(_SIZES)]))
            yield still.labels, still.image, still.horizon


def _evenly_spaced(items: list[T], limit: int, dataset_of: Callable[[T], str]) -> list[T]:
    """Returns at most `limit` items of each data set, evenly spaced."""
    sets: dict[str, list[T]] = {}
    for item in items:
        sets.setdefault(dataset_of(item), []).append(item)
    return [
        part[i]
        for part in sets.values()
        for i in np.unique(np.linspace(0, len(part) - 1, min(limit, len(part))).astype(int))
    ]


def _encode(image: Image) -> bytes:
    return cv2.imencode(".jpg", image, _JPEG)[1].tobytes()
