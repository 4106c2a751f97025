"""What measured and simulated nodes have in common: the load, the life of each frame, and what is reported about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.protocol import Mode

# A camera sends each frame up to this share of its interval earlier or later: cameras are not synchronized.
JITTER: Final = 0.5


@dataclass(frozen=True)
class Load:
    """Cameras that send to nodes.

    Each of the `cameras` has `fps` frames per second, or with None the next frame as soon as one may be sent. At most
    `in_flight` frames of a camera are unanswered.
    """

    cameras: int
    fps: float | None
    mode: Mode = "latest"
    in_flight: int = 8

    def phase_s(self, camera: int) -> float:
        """Returns when the first frame of a camera is due: the cameras take turns within the interval of a frame."""
        return 0.0 if self.fps is None else camera / (self.cameras * self.fps)


@dataclass(frozen=True)
class FrameLife:
    """A frame: its camera, and when it was captured and answered, in seconds. `answered` is None if it never was."""

    camera: int
    captured: float
    answered: float | None

    @property
    def response_s(self) -> float:
        """The seconds from capture to answer."""
        if self.answered is None:
            raise ValueError("the frame was not answered")
        return self.answered - self.captured


@dataclass(frozen=True)
class Outcome:
    """What a load experienced: frames answered per second, the share of frames dropped, and response times."""

    answered_per_s: float
    dropped_share: float
    p50_ms: float
    p95_ms: float
    p99_ms: float


def outcome(frames: Sequence[FrameLife], start: float, end: float) -> Outcome:
    """Returns the outcome of the time from `start` to `end`. Raises ValueError if nothing was answered in it."""
    responses = [
        1e3 * frame.response_s for frame in frames if frame.answered is not None and start <= frame.answered < end
    ]
    captured = [frame for frame in frames if start <= frame.captured < end]
    if not responses or not captured:
        raise ValueError("no frame was answered")
    p50, p95, p99 = (float(each) for each in np.percentile(responses, (50, 95, 99)))
    dropped = sum(frame.answered is None for frame in captured) / len(captured)
    return Outcome(len(responses) / (end - start), dropped, p50, p95, p99)
