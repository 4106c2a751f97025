"""Frames that an export works with: those that set ranges and ranks, and those that calibrate and prove the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

import cv2
import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.samples.road_frames import RoadFrame, road_frames
from lanestream_exporter.scenes import render_still, sample_scene

# No test frame has a part in an export.
Part = Literal["train", "val"]

T = TypeVar("T")

# Rendered frames are seeded apart from those that networks are trained on.
_SEED: Final = 7001
_SIZES: Final = ((640, 360), (640, 480), (960, 540))
_JPEG: Final = (cv2.IMWRITE_JPEG_QUALITY, 95)


@dataclass(frozen=True)
class LabelledJpeg:
    """A frame as a client would send it, and its labels."""

    jpeg: bytes
    labels: LabelledFrame


@dataclass(frozen=True)
class FrameSource:
    """Rendered frames, `rendered` of each part, and labeled real ones of `datasets`, if given.

    At most `real` real ones of a part are taken, evenly spread.
    """

    datasets: DatasetCollection | None
    rendered: int = 48
    real: int = 96

    @property
    def origin(self) -> str:
        """Where the frames come from, for people."""
        if self.datasets is None:
            return "rendered scenes"
        return f"rendered scenes and real frames of {', '.join(credit['name'] for credit in self.datasets.credits())}"

    def jpegs(self, part: Part) -> list[LabelledJpeg]:
        """Whole frames of `part` as JPEG files. Raises LabelError for real frames that can't be read."""
        rendered = [LabelledJpeg(_jpeg(image), labels) for labels, image, _ in self._rendered(part)]
        real = [LabelledJpeg(_jpeg(image), labels) for labels, image in self._labelled(part)]
        return [*_thinned(real, self.real), *rendered]

    def roads(self, part: Part) -> list[RoadFrame]:
        """Frames of `part` with their horizon, small. Raises LabelError for real frames that can't be read."""
        rendered = [RoadFrame.of(labels, image, horizon) for labels, image, horizon in self._rendered(part)]
        real = _thinned(road_frames(self._labelled(part)), self.real)
        return [*real, *(frame for frame in rendered if frame is not None)]

    def _labelled(self, part: Part) -> Iterator[tuple[LabelledFrame, Image]]:
        return iter(()) if self.datasets is None else self.datasets.frames(part)

    def _rendered(self, part: Part) -> Iterator[tuple[LabelledFrame, Image, float]]:
        for index in range(self.rendered):
            rng = np.random.default_rng([_SEED, 0 if part == "train" else 1, index])
            still = render_still(sample_scene(rng, *_SIZES[index % len(_SIZES)]))
            yield still.labels, still.image, still.horizon


def _thinned(items: list[T], most: int) -> list[T]:
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).astype(int))]


def _jpeg(image: Image) -> bytes:
    return cv2.imencode(".jpg", image, _JPEG)[1].tobytes()
