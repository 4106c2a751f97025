"""Sources of frames, a frame on its way from one to the service, and the result that comes back for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from lanestream.errors import ImageError, needs_extra
from lanestream.protocol import ErrorMessage, Indicator, LanesMessage
from lanestream_client.pixels import check_pixels, encode_jpeg

if TYPE_CHECKING:
    from lanestream_client.pixels import BgrImage

# Where a capture time is from: the file or the camera itself, the arrival of the frame here, or only the number of the
# frame and the frame rate.
Clock = Literal["source", "arrival", "frame_rate"]

# High enough that compression artifacts do not disturb the detectors.
_JPEG_QUALITY: Final = 90


@dataclass(frozen=True)
class SourceFrame:
    """A frame as its source delivers it: an image file in `data`, or decoded `pixels`, BGR (H, W, 3) uint8.

    The order of the colors is that of OpenCV and of PyAV's format `bgr24`; RGB pixels become BGR with `rgb[..., ::-1]`.
    `timestamp` is the capture time in seconds on the source's clock. If it is None, the receiver assigns one. `speed`
    in m/s and `indicator` are the vehicle's then, for lane departure warnings. `clock` says where the capture time is
    from, and `reconnects` how often the source had been lost and opened again before this frame.

    Raises ImageError if `pixels` has another type or shape.
    """

    seq: int
    timestamp: float | None
    data: bytes | None = None
    pixels: BgrImage | None = None
    name: str = ""
    speed: float | None = None
    indicator: Indicator | None = None
    clock: Clock | None = None
    reconnects: int = 0

    def __post_init__(self) -> None:
        if self.pixels is not None:
            check_pixels(self.pixels)

    def encoded(self) -> bytes:
        """Returns the frame as an image file: the original file, or a JPEG of `pixels`.

        Raises ImageError if the image is too large for a JPEG.
        """
        if self.data is not None:
            return self.data
        if self.pixels is None:
            return b""
        return encode_jpeg(self.pixels, _JPEG_QUALITY)

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


@dataclass
class SourceCounts:
    """What a source has lost so far: frames that were damaged or empty, and its connections.

    `outage_s` is the time in seconds without frames, from the last one before to the first one after each outage.
    """

    lost_frames: int = 0
    reconnects: int = 0
    outage_s: float = 0.0


@dataclass(frozen=True)
class CameraSource:
    """The frames of one camera, to be read once.

    A `live` source delivers frames at its own pace; any other delivers them as fast as they are read. `length` is the
    number of frames if known, `fps` the rate at which to play them. `counts` says what was lost so far. `stop` ends the
    frames of a live source, also from another thread.
    """

    name: str
    frames: Iterator[SourceFrame]
    live: bool
    fps: float
    length: int | None = None
    counts: SourceCounts = field(default_factory=SourceCounts)
    stop: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class StreamResult:
    """The result of one frame: its `lanes`, or the `error` that replaced them. Exactly one of the two is set."""

    frame: SourceFrame
    lanes: LanesMessage | None = None
    error: ErrorMessage | None = None

    def draw(self, frame: BgrImage | None = None) -> BgrImage:
        """Returns a picture of the frame with its lanes, or with its error written on it: BGR (H, W, 3) uint8.

        Draws on a copy of `frame`, BGR (H, W, 3) uint8 of the same size, if given. Raises ImageError if the frame can't
        be decoded, or if `frame` does not fit, and MissingExtraError without `lanestream[video]`.
        """
        from lanestream_client.overlays import draw_error, draw_lanes

        if frame is not None:
            check_pixels(frame, None if self.lanes is None else (self.lanes.width, self.lanes.height))
        image = self.frame.image() if frame is None else frame
        if self.lanes is not None:
            return draw_lanes(image, self.lanes)
        return image.copy() if self.error is None else draw_error(image, self.error)


class DetectedLanes(LanesMessage):
    """The lanes of a single image, as `detect` returns them."""

    def draw(self, image: BgrImage) -> BgrImage:
        """Returns a copy of `image`, BGR (H, W, 3) uint8, with these lanes drawn on it.

        Raises ImageError if `image` does not have the size of the image that was sent, and MissingExtraError without
        `lanestream[video]`.
        """
        from lanestream_client.overlays import draw_lanes

        check_pixels(image, (self.width, self.height))
        return draw_lanes(image, self)


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


def as_source_frames(frames: Iterable[SourceFrame | bytes | BgrImage]) -> Iterator[SourceFrame]:
    """Yields the frames of a source. Numbers image files and pixels from 0 and leaves their capture times unset."""
    for seq, frame in enumerate(frames):
        yield frame if isinstance(frame, SourceFrame) else as_source_frame(frame, seq)


def as_source_frame(image: bytes | BgrImage, seq: int = 0) -> SourceFrame:
    """Returns the frame of an image file or of BGR pixels (H, W, 3) uint8. Raises ImageError if it is neither."""
    if isinstance(image, bytes):
        return SourceFrame(seq, None, data=image)
    return SourceFrame(seq, None, pixels=image)
