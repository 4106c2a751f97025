"""The frames that all runners get: a drive as JPEG files in memory, in both sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Final

import cv2
import numpy as np

from bench.workload import Size
from lanestream.road.view import Image
from lanestream_client.sources import open_source
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

SEED: Final = 24
FPS: Final = 25.0
JPEG_QUALITY: Final = 90

# The JPEG files of each size, in the order of the drive.
Clips = Mapping[Size, Sequence[bytes]]


def load_clips(sizes: Sequence[Size], count: int, clip: str | None = None) -> Clips:
    """Returns the first `count` frames of `clip` (a video or a folder of images), or of a rendered drive if None.

    Raises SourceError if `clip` can't be read.
    """
    images = _render(max(sizes), count) if clip is None else _read(clip, count)
    return {size: [_encode(_fit(image, size)) for image in images] for size in sizes}


def forward_and_backward(number: int, count: int) -> int:
    """Returns the index, among `count` frames, of frame `number` of an endless drive that alternates direction."""
    if count == 1:
        return 0
    index = number % (2 * count - 2)
    return min(index, 2 * count - 2 - index)


def _render(size: Size, count: int) -> list[Image]:
    drive = Drive("highway", fair=True)
    clip = sample_clip(np.random.default_rng(SEED), *size, frames=count, fps=FPS, drive=drive)
    return [frame.image for frame in render_clip(clip)]


def _read(clip: str, count: int) -> list[Image]:
    with open_source(clip) as source:
        frames = list(islice(source.frames, count))
    return [_decode(frame.data) if frame.pixels is None else frame.pixels for frame in frames]


def _decode(data: bytes | None) -> Image:
    image = cv2.imdecode(np.frombuffer(data or b"", np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(image, np.uint8)


def _fit(image: Image, size: Size) -> Image:
    """Returns the image at `size`. If it is too high, its top is cut off, where the sky is."""
    width, height = size
    scale = width / image.shape[1]
    interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    resized = cv2.resize(image, (width, max(height, round(image.shape[0] * scale))), interpolation=interpolation)
    return np.asarray(resized[resized.shape[0] - height :], np.uint8)


def _encode(image: Image) -> bytes:
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])
