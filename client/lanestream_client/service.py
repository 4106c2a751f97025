"""What finds lanes: the service behind a URL, or an engine in this process. Callers need not know which."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from lanestream.protocol import CameraModel, DetectorName, LanesMessage, Mode, ReadyMessage
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary


@dataclass(frozen=True)
class ServiceInfo:
    """What runs: the model's name, and the execution provider that really runs it."""

    model: str
    provider: str


class ResultStream(Protocol):
    """The results of a stream as they come; afterwards the summary."""

    @property
    def ready(self) -> ReadyMessage | None:
        """What the service said when it opened the stream last; None before, and where no service is needed."""
        ...

    @property
    def reconnects(self) -> int:
        """How often the stream was opened again after its connection was lost."""
        ...

    @property
    def summary(self) -> StreamSummary | None:
        """The final count; None until the stream came to its end."""
        ...

    def __iter__(self) -> Generator[StreamResult]: ...


class LaneService(Protocol):
    """What finds lanes."""

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """What runs, for a detector; for the default one where None."""
        ...

    def detect(
        self,
        image: bytes | str | Path,
        *,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
    ) -> LanesMessage:
        """The lanes of one image file."""
        ...

    def stream(
        self,
        frames: Iterable[SourceFrame | bytes],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        session: str | None = None,
    ) -> ResultStream:
        """The lanes of the frames of one camera; `session` names it in a service's logs."""
        ...


def as_frames(frames: Iterable[SourceFrame | bytes]) -> Iterator[SourceFrame]:
    """Frames of a source as they are; image files numbered from 0, without capture times of their own."""
    for seq, frame in enumerate(frames):
        yield frame if isinstance(frame, SourceFrame) else SourceFrame(seq, None, data=frame)
