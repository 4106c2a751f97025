"""Finds lanes without a service: wraps an engine of this process, which the caller hands in, as a client.

`LaneService` is what this client and LaneClient have in common. The commands work with either.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from lanestream.errors import LanestreamError
from lanestream.protocol import (
    BoundaryKind,
    CameraModel,
    DepartureOptions,
    DetectorName,
    Indicator,
    LanesMessage,
    Mode,
    ReadyMessage,
    WarningMessage,
    error_message,
)
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary, as_source_frames
from lanestream_client.requests import ServiceInfo, read_image

if TYPE_CHECKING:
    from lanestream_client.pixels import BgrImage


class ResultStream(Protocol):
    """The results of a stream."""

    @property
    def ready(self) -> ReadyMessage | None:
        """The `ready` message of the latest connection; None before the first, and in process."""
        ...

    @property
    def reconnects(self) -> int:
        """How often the stream was opened again after its connection was lost."""
        ...

    @property
    def warnings(self) -> tuple[WarningMessage, ...]:
        """What was wrong with the frames so far without being an error."""
        ...

    @property
    def summary(self) -> StreamSummary | None:
        """The frame counts, or None before the end."""
        ...

    def __iter__(self) -> Generator[StreamResult]: ...


class LaneService(Protocol):
    """Finds lanes, in this process or elsewhere. See LaneClient for the arguments."""

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """Returns the model behind a detector and the provider that runs it; of the default detector if None."""
        ...

    def detect(
        self,
        image: bytes | str | Path | BgrImage,
        *,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
    ) -> LanesMessage:
        """Returns the lanes of one image, a file or BGR pixels (H, W, 3) uint8."""
        ...

    def stream(
        self,
        frames: Iterable[SourceFrame | bytes | BgrImage],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        departure: DepartureOptions | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
        session: str | None = None,
    ) -> ResultStream:
        """Returns the results of one camera's frames."""
        ...


class InProcessPlacement(Protocol):
    """Where a network runs."""

    @property
    def provider(self) -> str:
        """The execution provider that runs it."""
        ...


class InProcessNetwork(Protocol):
    """A network of the engine."""

    @property
    def name(self) -> str:
        """The model's name and version."""
        ...

    @property
    def sha256(self) -> str:
        """The hash of its file in hexadecimal."""
        ...

    @property
    def placement(self) -> InProcessPlacement:
        """Where it runs."""
        ...


class InProcessSession(Protocol):
    """One camera's session with the engine."""

    @property
    def warnings(self) -> tuple[WarningMessage, ...]:
        """What was wrong with the frames so far without being an error."""
        ...

    def lanes(
        self,
        image: bytes | BgrImage,
        *,
        seq: int,
        timestamp: float,
        speed: float | None = None,
        indicator: Indicator | None = None,
    ) -> LanesMessage:
        """Returns the lanes of one frame, an image file or BGR pixels (H, W, 3) uint8."""
        ...


class InProcessEngine(Protocol):
    """What this module needs of an engine."""

    def network(self, detector: DetectorName | None = None) -> InProcessNetwork:
        """Returns the network of a detector; of the default detector if None. Raises NoDetectorError."""
        ...

    def open_camera(
        self,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        departure: DepartureOptions | None = None,
        *,
        kinds: Sequence[BoundaryKind] | None = None,
        single_image: bool = False,
    ) -> InProcessSession:
        """Opens a session for one camera, or for a single image. Raises NoDetectorError."""
        ...


class InProcessClient:
    """A LaneService on an engine of this process."""

    def __init__(self, engine: InProcessEngine) -> None:
        self._engine = engine

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """Returns the model behind a detector and the provider that runs it; of the default detector if None.

        Raises NoDetectorError if the detector is not loaded.
        """
        network = self._engine.network(detector)
        return ServiceInfo(network.name, network.placement.provider)

    def detect(
        self,
        image: bytes | str | Path | BgrImage,
        *,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
    ) -> LanesMessage:
        """Returns the lanes of one image. Raises ImageError, SourceError and NoDetectorError."""
        session = self._engine.open_camera(horizon, detector, camera, kinds=kinds, single_image=True)
        frame = read_image(image)
        return session.lanes(frame.encoded() if frame.pixels is None else frame.pixels, seq=0, timestamp=0.0)

    def stream(
        self,
        frames: Iterable[SourceFrame | bytes | BgrImage],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        departure: DepartureOptions | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
        session: str | None = None,
    ) -> InProcessStream:
        """Returns the results of one camera's frames. In either mode a frame is read when the previous one is done.

        Raises NoDetectorError if the detector is not loaded.
        """
        del mode, session  # frames are never queued, so no mode applies; streams are not logged
        opened = self._engine.open_camera(horizon, detector, camera, departure, kinds=kinds)
        return InProcessStream(opened, as_source_frames(frames))


class InProcessStream:
    """The results of one stream, to be iterated over once. `summary` is set afterwards.

    Without a connection, `ready` stays None and `reconnects` stays 0.
    """

    ready: ReadyMessage | None = None
    reconnects: int = 0

    def __init__(
        self, session: InProcessSession, frames: Iterator[SourceFrame], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._session = session
        self._frames = frames
        self._clock = clock
        self.summary: StreamSummary | None = None

    @property
    def warnings(self) -> tuple[WarningMessage, ...]:
        """What was wrong with the frames so far without being an error, for example timestamps in milliseconds."""
        return self._session.warnings

    def __iter__(self) -> Generator[StreamResult]:
        started = self._clock()
        answered = failed = 0
        for frame in self._frames:
            timestamp = self._clock() - started if frame.timestamp is None else frame.timestamp
            image = frame.encoded() if frame.pixels is None else frame.pixels
            try:
                lanes = self._session.lanes(
                    image, seq=frame.seq, timestamp=timestamp, speed=frame.speed, indicator=frame.indicator
                )
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
