"""One frame on its way from a source to the service, and what came back for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, needs_extra
from lanestream.protocol import ErrorMessage, LanesMessage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Image = NDArray[np.uint8]

JPEG_QUALITY: Final = 90


@dataclass(frozen=True)
class SourceFrame:
    """A frame as its source has it: an image file in `data`, or decoded `pixels`, BGR (H, W, 3) uint8.

    `timestamp` is the capture time in seconds on the source's clock; None leaves it to whoever receives the frame.
    """

    seq: int
    timestamp: float | None
    data: bytes | None = None
    pixels: Image | None = None
    name: str = ""

    def encoded(self) -> bytes:
        """The frame as an image file: as it came, or as a JPEG where it came decoded."""
        if self.data is not None:
            return self.data
        with needs_extra("video"):
            import cv2
        if self.pixels is None:
            return b""
        _, encoded = cv2.imencode(".jpg", self.pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return encoded.tobytes()

    def image(self) -> Image:
        """The frame's pixels, to draw on. Raises ImageError where its file can't be decoded."""
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
    """What became of one frame: its lanes, or the error that it cost. Exactly one of the two is there."""

    frame: SourceFrame
    lanes: LanesMessage | None = None
    error: ErrorMessage | None = None


@dataclass(frozen=True)
class StreamSummary:
    """What became of the frames of a stream, over all its connections.

    `frames` counts those that the source gave, each of them answered, failed, dropped or lost: `dropped` for a newer
    one, `lost` with a connection. `duration_s` runs from the first `ready` on.
    """

    frames: int
    answered: int
    failed: int
    dropped: int
    lost: int
    duration_s: float
