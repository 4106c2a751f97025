"""Lanes without a service: an engine of this process, handed in, behind the interface of a client."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from lanestream.errors import LanestreamError
from lanestream.protocol import CameraModel, DetectorName, LanesMessage, Mode, ReadyMessage, error_message
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary
from lanestream_client.requests import image_bytes
from lanestream_client.service import ServiceInfo, as_frames

if TYPE_CHECKING:
    from lanestream_client.frames import Image


class Camera(Protocol):
    """One camera's session with an engine."""

    def lanes(self, image: bytes | Image, *, seq: int, timestamp: float) -> LanesMessage:
        """The lanes of one frame, an image file or BGR pixels (H, W, 3) uint8."""
        ...


class Network(Protocol):
    """A network of this process."""

    @property
    def name(self) -> str:
        """The model's name and version."""
        ...

    @property
    def provider(self) -> str:
        """The execution provider that really runs it."""
        ...


class LocalEngine(Protocol):
    """An engine of this process."""

    def network(self, detector: DetectorName | None = None) -> Network:
        """The network of a detector, of the default one where None."""
        ...

    def open_camera(
        self, horizon: float | None = None, detector: DetectorName | None = None, camera: CameraModel | None = None
    ) -> Camera:
        """A session for one camera."""
        ...


class InProcess:
    """What LaneClient offers, by an engine of this process."""

    def __init__(self, engine: LocalEngine) -> None:
        self._engine = engine

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """The model of a detector, of the default one where None, and what runs it. Raises NoDetectorError."""
        network = self._engine.network(detector)
        return ServiceInfo(network.name, network.provider)

    def detect(
        self,
        image: bytes | str | Path,
        *,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
    ) -> LanesMessage:
        """The lanes of one image file. Raises ImageError, SourceError and NoDetectorError."""
        return self._engine.open_camera(horizon, detector, camera).lanes(image_bytes(image), seq=0, timestamp=0.0)

    def stream(
        self,
        frames: Iterable[SourceFrame | bytes],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        session: str | None = None,
    ) -> LocalStream:
        """The lanes of the frames of one camera. In either mode a frame is taken when the one before is done.

        Raises NoDetectorError where `detector` is not loaded.
        """
        del mode, session  # nothing waits here that a newer frame could replace, and no log tells streams apart
        return LocalStream(self._engine.open_camera(horizon, detector, camera), as_frames(frames))


class LocalStream:
    """The results of one stream, to be iterated over once; `summary` is there afterwards.

    No service had to be `ready`, and no connection is ever lost.
    """

    ready: ReadyMessage | None = None
    reconnects: int = 0

    def __init__(
        self, camera: Camera, frames: Iterator[SourceFrame], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._camera = camera
        self._frames = frames
        self._clock = clock
        self.summary: StreamSummary | None = None

    def __iter__(self) -> Generator[StreamResult]:
        started = self._clock()
        answered = failed = 0
        for frame in self._frames:
            timestamp = self._clock() - started if frame.timestamp is None else frame.timestamp
            image = frame.encoded() if frame.pixels is None else frame.pixels
            try:
                lanes = self._camera.lanes(image, seq=frame.seq, timestamp=timestamp)
            except LanestreamError as error:
                failed += 1
                yield StreamResult(frame, error=error_message(error, seq=frame.seq))
            else:
                answered += 1
                yield StreamResult(frame, lanes=lanes)
        self.summary = StreamSummary(
            frames=answered + failed,
            answered=answered,
            failed=failed,
            dropped=0,
            lost=0,
            duration_s=round(self._clock() - started, 3),
        )
