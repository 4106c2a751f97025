"""Images that are larger than the service accepts: scaled down before they are sent, and their lanes back afterwards.

So the lanes of such an image are in its own pixels, as they are if it is processed without a service.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Final, TypeVar

from lanestream.protocol import CameraModel, LaneModel, LanesMessage, LineModel, Point
from lanestream_client.frames import SourceFrame

if TYPE_CHECKING:
    from lanestream.protocol import Limits

_Lanes = TypeVar("_Lanes", bound=LanesMessage)

# The most pixels of an image that is scaled down: detectors use images 640 pixels wide.
_SENT_PIXELS: Final = 1920 * 1080
_JPEG_FRAME: Final = re.compile(rb"\xff[\xc0-\xc3\xc5-\xc7\xc9-\xcb\xcd-\xcf]")
_JPEG_QUALITY: Final = 90


@dataclass(frozen=True)
class SmallerImage:
    """A JPEG `data` of `size` (width, height) that replaces an image of the size `original`."""

    data: bytes
    size: tuple[int, int]
    original: tuple[int, int]

    def camera(self, camera: CameraModel | None) -> CameraModel | None:
        """Returns the camera for this image: one in pixels of the original image has to say so."""
        if camera is None or camera.image_size is not None:
            return camera
        if camera.focal_length is None and camera.principal_point is None:
            return camera
        return camera.model_copy(update={"image_size": self.original})

    def restore(self, message: _Lanes) -> _Lanes:
        """Returns the lanes of this image in pixels of the original one."""
        width, height = self.original
        lanes = [self._restore_lane(lane) for lane in message.lanes]
        horizon = self._point((0.0, message.horizon))[1]
        return message.model_copy(update={"width": width, "height": height, "horizon": horizon, "lanes": lanes})

    def describe(self) -> str:
        """Returns what was done, for the user."""
        (width, height), (sent_width, sent_height) = self.original, self.size
        return (
            f"images of {width} x {height} are larger than the service accepts: they are sent as {sent_width} x "
            f"{sent_height}; lanes are in pixels of the original"
        )

    @property
    def _factors(self) -> tuple[float, float]:
        return self.original[0] / self.size[0], self.original[1] / self.size[1]

    def _point(self, point: Point) -> Point:
        """Pixel centers are at integers."""
        (x, y), (across, down) = point, self._factors
        return (x + 0.5) * across - 0.5, (y + 0.5) * down - 0.5

    def _restore_lane(self, lane: LaneModel) -> LaneModel:
        across, down = self._factors
        v, b, k = lane.coefficients
        scales = across, across / down, across * down
        line = LineModel(bottom=self._point(lane.line.bottom), top=self._point(lane.line.top))
        changed = {
            "points": [self._point(point) for point in lane.points],
            "line": line,
            "horizon": self._point((0.0, lane.horizon))[1],
            "coefficients": (self._point((v, 0.0))[0], scales[1] * b, scales[2] * k),
            "covariance": _scaled(lane.covariance, scales),
        }
        return lane.model_copy(update=changed)


def fit_frame(frame: SourceFrame, limits: Limits) -> SmallerImage | None:
    """Returns a smaller image for a frame that exceeds the limits of the service; None if it fits."""
    size = _size_of(frame)
    if size is None or (size[0] * size[1] <= limits.max_pixels and len(frame.data or b"") <= limits.max_bytes):
        return None
    return smaller_image(frame, limits.max_pixels)


def smaller_image(frame: SourceFrame, max_pixels: int = _SENT_PIXELS) -> SmallerImage | None:
    """Returns a smaller image for a frame, of at most `max_pixels`; None if it can't be decoded here."""
    if find_spec("cv2") is None:
        return None
    import cv2

    from lanestream.errors import ImageError

    try:
        image = frame.image()
    except ImageError:
        return None
    height, width = image.shape[:2]
    factor = min(1.0, (min(max_pixels, _SENT_PIXELS) / (width * height)) ** 0.5)
    size = max(1, int(width * factor)), max(1, int(height * factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
    return SmallerImage(data, size, (width, height))


def _size_of(frame: SourceFrame) -> tuple[int, int] | None:
    """Returns width and height of a frame, as its file says; None if it has no known format."""
    if frame.pixels is not None:
        return frame.pixels.shape[1], frame.pixels.shape[0]
    data = frame.data or b""
    if data.startswith(b"\x89PNG"):
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data.startswith(b"RIFF"):
        return _webp_size(data)
    return _jpeg_size(data) if data.startswith(b"\xff\xd8\xff") else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(data):
        if _JPEG_FRAME.match(data, at):
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        # A marker may be padded; a segment begins with its length.
        at += 1 if data[at] != 0xFF or data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _webp_size(data: bytes) -> tuple[int, int] | None:
    if data[12:16] == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    if data[12:16] == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(data[28:30], "little") & 0x3FFF


def _scaled(covariance: Sequence[Sequence[float]], scales: Sequence[float]) -> list[list[float]]:
    return [
        [a * b * value for b, value in zip(scales, row, strict=True)] for a, row in zip(scales, covariance, strict=True)
    ]
