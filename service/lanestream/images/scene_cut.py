"""Detects cuts in a video: a frame that shows another scene than the one before."""

from __future__ import annotations

from base64 import b64decode, b64encode
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.view import Image

# Frames are compared at this size, in blocks and as a whole: driving changes little of so small a picture from one
# frame to the next. A bump changes the whole but not the blocks, and a bridge many blocks but not the whole.
_WIDTH, _HEIGHT = 16, 9
_BLOCK_WIDTH, _BLOCK_HEIGHT = 4, 3
# Noise of this many gray levels must not decide about blocks without any structure.
_NOISE: Final = 2.0
# Two frames of one scene are at least this similar if they are this many seconds apart, and less with more time between
# them. On the drives that this was chosen on, consecutive frames of one scene had at least 0.81 at 20 to 30 frames per
# second, and 95 % of pairs of two scenes at most 0.65 (real) and 0.81 (rendered).
_LEAST, _STEP_S = 0.7, 0.05
# The same for the whole pictures, for any time between them: 97 % of pairs of two scenes are less similar.
_LEAST_OF_WHOLE: Final = 0.5
_LOSS_PER_SECOND: Final = 3.0
# Frames farther apart can't be compared.
_LONGEST_S: Final = 0.15


@dataclass(frozen=True)
class SceneMemory:
    """What is remembered of a stream's last frame: its `thumbnail` in base 64."""

    thumbnail: str = ""

    def validate(self) -> None:
        """Checks a memory from outside this process. Raises ValueError, on one line, if it is invalid."""
        if self.thumbnail:
            _decoded(self.thumbnail)

    def next(self, image: Image, seconds: float) -> tuple[SceneMemory, bool]:
        """Returns the memory after the next frame, and whether it shows another scene.

        `image` is a BGR image (H, W, 3) uint8, captured `seconds` after the last one.
        """
        green = cv2.extractChannel(image, 1)
        thumbnail = np.asarray(cv2.resize(green, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)
        memory = SceneMemory(b64encode(thumbnail.tobytes()).decode())
        if not self.thumbnail or seconds > _LONGEST_S:
            return memory, False
        last = _decoded(self.thumbnail)
        least = _LEAST - _LOSS_PER_SECOND * max(0.0, seconds - _STEP_S)
        is_cut = _similarity(_blocks(thumbnail), _blocks(last)) < least
        return memory, is_cut and _similarity(_whole(thumbnail), _whole(last)) < _LEAST_OF_WHOLE


def _decoded(thumbnail: str) -> NDArray[np.uint8]:
    try:
        data = b64decode(thumbnail, validate=True)
    except ValueError:
        raise ValueError("the thumbnail of the last frame is not valid base 64") from None
    if len(data) != _WIDTH * _HEIGHT:
        raise ValueError(f"the thumbnail of the last frame has {len(data)} bytes; expected {_WIDTH * _HEIGHT}")
    return np.frombuffer(data, np.uint8).reshape(_HEIGHT, _WIDTH)


def _similarity(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Returns the median correlation of the blocks (N, P) of two pictures."""
    noise = _NOISE**2 * a.shape[1]
    powers = ((a * a).sum(axis=1) + noise) * ((b * b).sum(axis=1) + noise)
    return float(np.median(((a * b).sum(axis=1) + noise) / np.sqrt(powers)))


def _whole(thumbnail: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns a picture as one block (1, P), without what all roads share: rows get darker towards the ground."""
    values = thumbnail - thumbnail.mean(axis=0)
    return np.asarray(values - values.mean(axis=1, keepdims=True)).reshape(1, -1)


def _blocks(thumbnail: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Returns the pixels of each block (N, P), less their mean."""
    grid = thumbnail.reshape(_HEIGHT // _BLOCK_HEIGHT, _BLOCK_HEIGHT, _WIDTH // _BLOCK_WIDTH, _BLOCK_WIDTH)
    blocks = grid.swapaxes(1, 2).reshape(-1, _BLOCK_HEIGHT * _BLOCK_WIDTH).astype(np.float64)
    return np.asarray(blocks - blocks.mean(axis=1, keepdims=True))
