"""Detects cuts in a video: a frame that shows another scene than the one before."""

from __future__ import annotations

from base64 import b64decode, b64encode
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.view import Image

# Frames are compared at this size: driving changes little of so small a picture from one frame to the next.
_WIDTH, _HEIGHT = 16, 9
# Frames farther apart in time than this many seconds can't be compared.
_LONGEST_S: Final = 0.25
# Two frames of one scene are at least this similar, and as similar as usual in their stream less this. On the drives
# that this was chosen on, consecutive frames of one scene had at least 0.57, and 93 % of those of two scenes less than
# the first value.
_LEAST, _LESS_THAN_USUAL = 0.45, 0.3
_USUAL_GAIN: Final = 0.1


@dataclass(frozen=True)
class SceneMemory:
    """What is remembered of a stream's last frame: its `thumbnail` in base 64, and the `usual` similarity of frames."""

    thumbnail: str = ""
    usual: float = 1.0

    def validate(self) -> None:
        """Checks a memory from outside this process. Raises ValueError, on one line, if it is invalid."""
        if self.thumbnail:
            _decoded(self.thumbnail)
        if not -1.0 <= self.usual <= 1.0:
            raise ValueError("the usual similarity of frames is not between -1 and 1")

    def next(self, image: Image, seconds: float) -> tuple[SceneMemory, bool]:
        """Returns the memory after the next frame, and whether it shows another scene.

        `image` is a BGR image (H, W, 3) uint8, captured `seconds` after the last one.
        """
        green = cv2.extractChannel(image, 1)
        thumbnail = np.asarray(cv2.resize(green, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)
        encoded = b64encode(thumbnail.tobytes()).decode()
        if not self.thumbnail or seconds > _LONGEST_S:
            return SceneMemory(encoded, self.usual), False
        similarity = _similarity(thumbnail, _decoded(self.thumbnail))
        is_cut = similarity < min(_LEAST, self.usual - _LESS_THAN_USUAL)
        usual = self.usual if is_cut else self.usual + _USUAL_GAIN * (similarity - self.usual)
        return SceneMemory(encoded, usual), is_cut


def _decoded(thumbnail: str) -> NDArray[np.uint8]:
    try:
        data = b64decode(thumbnail, validate=True)
    except ValueError:
        raise ValueError("the thumbnail of the last frame is not valid base 64") from None
    if len(data) != _WIDTH * _HEIGHT:
        raise ValueError(f"the thumbnail of the last frame has {len(data)} bytes; expected {_WIDTH * _HEIGHT}")
    return np.frombuffer(data, np.uint8).reshape(_HEIGHT, _WIDTH)


def _similarity(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Returns the correlation of two pictures without what all roads share: rows get darker towards the ground."""
    a, b = _centered(one), _centered(other)
    # Noise of one gray level must not decide about pictures without any structure.
    return float((a * b).sum() + a.size) / float(np.sqrt(((a * a).sum() + a.size) * ((b * b).sum() + b.size)))


def _centered(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    values = picture - picture.mean(axis=0)
    return np.asarray(values - values.mean(axis=1, keepdims=True))
