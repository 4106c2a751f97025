"""A frame on its way from a source to the service, and the result that comes back for it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, needs_extra
from lanestream.protocol import ErrorMessage, Indicator, LanesMessage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    BgrImage = NDArray[np.uint8]  # (H, W, 3)

# High enough that compression artifacts do not disturb the detectors.
_JPEG_QUALITY: Final = 90


@dataclass(frozen=True)
class SourceFrame:
    """A frame as its source delivers it: an image file in `data`, or decoded `pixels`, BGR (H, W, 3) uint8.

    `timestamp` is the capture time in seconds on the source's clock. If it is None, the receiver assigns one. `speed`
    in m/s and `indicator` are the vehicle's then, for lane departure warnings.
    """

    seq: int
    timestamp: float | None
    data: bytes | None = None
    pixels: BgrImage | None = None
    name: str = ""
    speed: float | None = None
    indicator: Indicator | None = None

    def encoded(self) -> bytes:
        """Returns the frame as an image file: the original file, or a JPEG of `pixels`."""
        if self.data is not None:
            return self.data
        with needs_extra("video"):
            import cv2
        if self.pixels is None:
            return b""
        _, encoded = cv2.imencode(".jpg", self.pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        return encoded.tobytes()

    def image(self) -> BgrImage:
        """Returns the frame's pixels, BGR (H, W, 3) uint8. Raises ImageError if its file can't be decoded."""
        if self.pixels is not None:
            return self.pixels
        with needs_extra("video"):
            import cv2
            import numpy as np
        image = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_COLOR) if self.data else None
        if image is None:
            raise ImageError(f"{self.name or 'the frame'} can't be decoded")
        return np.asarray(image, np.uint8)


@dataclass(frozen=True)
class StreamResult:
    """The result of one frame: its `lanes`, or the `error` that replaced them. Exactly one of the two is set."""

    frame: SourceFrame
    lanes: LanesMessage | None = None
    error: ErrorMessage | None = None


@dataclass(frozen=True)
class StreamSummary:
    """Counts of a stream's frames, over all its connections.

    `frames` is the number of frames taken from the source, and the sum of the other four counts. `dropped` frames were
    replaced by newer ones; the results of `lost` frames were lost with a connection. `duration_s` starts at the first
    `ready`.
    """

    frames: int
    answered: int
    failed: int
    dropped: int
    lost: int
    duration_s: float


def as_source_frames(frames: Iterable[SourceFrame | bytes]) -> Iterator[SourceFrame]:
    """Yields the frames of a source. Numbers plain image files from 0 and leaves their capture times unset."""
    for seq, frame in enumerate(frames):
        yield frame if isinstance(frame, SourceFrame) else SourceFrame(seq, None, data=frame)
