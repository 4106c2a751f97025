"""Streams frames to a service from a thread of its own, and hands each result back with its header.

Nothing here imports ROS.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from lanestream.errors import LanestreamError, SettingsError
from lanestream.protocol import DetectorName, Mode
from lanestream_client import CameraModel, LaneClient, SourceFrame

if TYPE_CHECKING:
    from lanestream.protocol import LanesMessage

Level = Literal["OK", "WARN", "ERROR"]

# How many frames may wait: in mode `latest` the newest one, in mode `all` so many that a short delay loses none.
_WAITING: Final[dict[Mode, int]] = {"latest": 1, "all": 64}
# The client reconnects by itself. After it has given up, or was refused, the bridge tries again after this pause.
_RETRY_PAUSE_S: Final = 5.0
# Without an image or an answer for this long (seconds), something is slow or being restored.
_LATE_S: Final = 2.0


@dataclass(frozen=True)
class BridgeSettings:
    """The service and what to ask of it. `camera` is None if unknown, then lanes are in pixels only."""

    url: str
    api_key: str | None = field(default=None, repr=False)
    mode: Mode = "latest"
    detector: DetectorName | None = None
    camera: CameraModel | None = None
    session: str | None = None

    @classmethod
    def of(
        cls,
        parameters: Mapping[str, Any],
        environment: Mapping[str, str],
        camera: CameraModel | None = None,
        session: str | None = None,
    ) -> BridgeSettings:
        """Returns the settings for the node's `parameters`. The API key is usually in the `environment`.

        Raises SettingsError for a mode or a detector that does not exist.
        """
        for name, accepted in (("mode", get_args(Mode)), ("detector", ("", *get_args(DetectorName)))):
            if parameters[name] not in accepted:
                options = ", ".join(repr(each) for each in accepted)
                raise SettingsError(f"the parameter {name} is {parameters[name]!r}", f"{options} are accepted")
        return cls(
            url=parameters["url"],
            api_key=parameters["api_key"] or environment.get("LANESTREAM_API_KEY") or None,
            mode=parameters["mode"],
            detector=parameters["detector"] or None,
            camera=camera,
            session=session,
        )


@dataclass(frozen=True)
class BridgeStatus:
    """The state of the bridge, for diagnostics. `error` is what went wrong last, None after an answer.

    `replaced` counts the frames that newer ones replaced before they were sent, or for which no place was left;
    `failed` those that the service refused or whose answer was lost.
    """

    error: str | None = None
    model: str = ""
    provider: str = ""
    received: int = 0
    replaced: int = 0
    answered: int = 0
    failed: int = 0
    reconnects: int = 0
    service_ms: float = 0.0
    received_at: float | None = None
    answered_at: float | None = None

    def diagnosis(self, now: float) -> tuple[Level, str]:
        """Returns the level and a line of text; `now` and the other times are of time.monotonic, in seconds."""
        if self.error is not None:
            return "ERROR", self.error
        if self.received_at is None:
            return "WARN", "no image yet"
        if now - self.received_at > _LATE_S:
            return "WARN", f"no image for {now - self.received_at:.0f} s"
        if self.answered_at is None:
            return "WARN", "no answer yet"
        if now - self.answered_at > _LATE_S:
            return "WARN", f"no answer for {now - self.answered_at:.0f} s"
        return "OK", f"streaming, {self.service_ms:.0f} ms in the service"


class FrameQueue:
    """Frames between the thread that receives them and the one that sends them; if it is full, the oldest goes."""

    def __init__(self, limit: int) -> None:
        self._frames: deque[SourceFrame] = deque(maxlen=limit)
        self._changed = threading.Condition()
        self._closed = False
        self._iteration = 0

    def put(self, frame: SourceFrame) -> bool:
        """Adds a frame. Returns whether it replaced another one."""
        with self._changed:
            replaced = len(self._frames) == self._frames.maxlen
            self._frames.append(frame)
            self._changed.notify_all()
        return replaced

    def interrupt(self) -> None:
        """Ends the iterations that have begun; a new one continues with the next frame."""
        with self._changed:
            self._iteration += 1
            self._changed.notify_all()

    def close(self) -> None:
        """Ends the frames."""
        with self._changed:
            self._closed = True
            self._frames.clear()
            self._changed.notify_all()

    def __iter__(self) -> Iterator[SourceFrame]:
        with self._changed:
            iteration = self._iteration
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._frames or self._closed or self._iteration != iteration)
                if self._closed or self._iteration != iteration:
                    return
                frame = self._frames.popleft()
            yield frame


class Bridge:
    """Sends frames to a service and calls `publish(header, lanes)` for each result, in another thread.

    It never gives up: lost connections are restored, and a service that refuses the stream is asked again.
    """

    def __init__(
        self,
        settings: BridgeSettings,
        publish: Callable[[Any, LanesMessage], None],
        *,
        retry_pause_s: float = _RETRY_PAUSE_S,
    ) -> None:
        self._settings = settings
        self._publish = publish
        self._retry_pause_s = retry_pause_s
        self._frames = FrameQueue(_WAITING[settings.mode])
        self._headers: dict[int, Any] = {}
        self._next_seq = 0
        self._status = BridgeStatus()
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lanestream-bridge", daemon=True)

    @property
    def status(self) -> BridgeStatus:
        """The state and the counts so far."""
        with self._lock:
            return self._status

    def start(self) -> None:
        """Starts to connect. Call it once."""
        self._thread.start()

    def close(self) -> None:
        """Ends the stream and waits for its thread."""
        self._closed.set()
        self._frames.close()
        self._thread.join(timeout=10.0)

    def send(self, convert: Callable[[Any, int], SourceFrame], message: Any) -> None:
        """Converts the image `message` with `convert(message, seq)` and queues it. Never waits for the service.

        Raises what `convert` raises. Call it from one thread only.
        """
        frame = convert(message, self._next_seq)
        self._next_seq += 1
        with self._lock:
            self._headers[frame.seq] = message.header
        replaced = self._frames.put(frame)
        self._count(received=1, replaced=int(replaced))
        self._update(received_at=time.monotonic())

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                self._stream()
            except LanestreamError as error:
                self._frames.interrupt()  # a thread of the stream may still wait for the next frame
                self._update(error=str(error))
                self._closed.wait(self._retry_pause_s)

    def _stream(self) -> None:
        """Streams frames until the bridge is closed. Raises LanestreamError if the client gives up."""
        settings = self._settings
        with LaneClient(settings.url, api_key=settings.api_key) as client:
            stream = client.stream(
                self._frames,
                mode=settings.mode,
                detector=settings.detector,
                camera=settings.camera,
                session=settings.session,
            )
            before = self.status.reconnects
            for result in stream:
                ready = stream.ready
                header = self._header_of(result.frame.seq)
                if result.lanes is None or header is None:
                    self._count(failed=1)
                    self._update(error=result.error and result.error.message)
                    continue
                self._count(answered=1)
                self._update(
                    error=None,
                    model=ready.model if ready else "",
                    provider=ready.provider if ready else "",
                    reconnects=before + stream.reconnects,
                    service_ms=result.lanes.timing_ms.total,
                    answered_at=time.monotonic(),
                )
                self._publish(header, result.lanes)

    def _header_of(self, seq: int) -> Any | None:
        """Returns the header of a frame, and forgets it and all older ones: results come in the order of frames."""
        with self._lock:
            header = self._headers.pop(seq, None)
            self._headers = {each: kept for each, kept in self._headers.items() if each > seq}
        return header

    def _count(self, *, received: int = 0, replaced: int = 0, answered: int = 0, failed: int = 0) -> None:
        with self._lock:
            status = self._status
            self._status = replace(
                status,
                received=status.received + received,
                replaced=status.replaced + replaced,
                answered=status.answered + answered,
                failed=status.failed + failed,
            )

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._status = replace(self._status, **changes)
