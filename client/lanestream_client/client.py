"""The client that blocks. Inside, one thread sends what a source gives while the caller receives."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import httpx
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from lanestream.protocol import SUBPROTOCOL, CameraModel, DetectorName, LanesMessage, Mode, ReadyMessage, SummaryMessage
from lanestream_client import requests
from lanestream_client.conversation import Conversation, lost
from lanestream_client.endpoint import Endpoint
from lanestream_client.frames import SourceFrame, StreamResult
from lanestream_client.service import ServiceInfo, as_frames

_TIMEOUT_S: Final = 30.0


class LaneClient:
    """A Lanestream service at `url`. Waits `timeout` seconds for a connection and for a single image's answer.

    Of a stream, `in_flight` frames are unanswered at a time: one gives the freshest answers, a few hide a slow network.

    Raises SettingsError where the URL is none, ConnectionFailedError where the service can't be reached or is lost, and
    the errors that the service tells, as the classes of `lanestream.errors`.
    """

    def __init__(self, url: str = "http://127.0.0.1:8000", timeout: float = _TIMEOUT_S, in_flight: int = 1) -> None:
        self._endpoint = Endpoint.parse(url)
        self._timeout = timeout
        self._in_flight = in_flight
        self._http = httpx.Client(base_url=self._endpoint.http, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections that are kept for further requests."""
        self._http.close()

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """The model that the service runs for a detector, for its default one where None, and what runs it."""
        with requests.reaching(self._endpoint.base):
            return requests.info_of(self._http.get("/v1/models"), detector)

    def detect(
        self,
        image: bytes | str | Path,
        *,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
    ) -> LanesMessage:
        """The lanes of one image: a JPEG, PNG or WebP file, or its path; `horizon` as a share of the image height.

        `detector` says what finds them, the service's default where None. With a `camera` they are told in metres too.
        """
        data = requests.image_bytes(image)
        with requests.reaching(self._endpoint.base):
            query = requests.parameters(horizon, detector, camera)
            return requests.lanes_of(self._http.post("/v1/detect", content=data, params=query))

    def stream(
        self,
        frames: Iterable[SourceFrame | bytes],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
    ) -> LaneStream:
        """The lanes of the frames of one camera, in their order, as they come; `detector` and `camera` as for `detect`.

        A frame that the service refuses gives a result with an `error`, and the stream goes on.
        """
        conversation = Conversation(mode, horizon, detector, camera, in_flight=self._in_flight)
        return LaneStream(self._endpoint, as_frames(frames), conversation, self._timeout)


class LaneStream:
    """The results of one stream: connects when iterated, which can be done once. `ready` and `summary` are kept."""

    def __init__(
        self, endpoint: Endpoint, frames: Iterator[SourceFrame], conversation: Conversation, timeout: float
    ) -> None:
        self._endpoint = endpoint
        self._frames = frames
        self._conversation = conversation
        self._timeout = timeout

    @property
    def ready(self) -> ReadyMessage | None:
        """What the service said when it opened the stream; None before."""
        return self._conversation.ready

    @property
    def summary(self) -> SummaryMessage | None:
        """The service's final count; None before the end."""
        return self._conversation.summary

    def __iter__(self) -> Generator[StreamResult]:
        conversation = self._conversation
        with _connected(self._endpoint, self._timeout) as socket:
            socket.send(conversation.opening())
            conversation.opened(socket.recv(self._timeout))
            with _Sender(socket, conversation, self._frames) as sender:
                while conversation.summary is None:
                    yield from sender.receive()
                sender.check()


@contextmanager
def _connected(endpoint: Endpoint, timeout: float) -> Iterator[ClientConnection]:
    try:
        with connect(
            endpoint.stream, subprotocols=[Subprotocol(SUBPROTOCOL)], compression=None, open_timeout=timeout
        ) as socket:
            yield socket
    except ConnectionClosed as error:
        raise lost(error) from None
    except InvalidStatus as error:
        raise requests.refused(endpoint.base, error) from None
    except (OSError, TimeoutError, WebSocketException) as error:
        raise requests.unreachable(endpoint.base, error) from None


class _Sender:
    """A thread that sends frames while there is room, and `end` after the last; and the lock around both ways."""

    def __init__(self, socket: ClientConnection, conversation: Conversation, frames: Iterator[SourceFrame]) -> None:
        self._socket = socket
        self._conversation = conversation
        self._frames = frames
        self._changed = threading.Condition()
        self._stopped = False
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="lanestream-sender", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify()
        # A send that waits for a service that no longer reads ends with its socket.
        self._socket.close()
        self._thread.join()

    def receive(self) -> list[StreamResult]:
        """The results that the next message settles."""
        text = self._socket.recv()
        with self._changed:
            results = self._conversation.incoming(text)
            self._changed.notify()
        return results

    def check(self) -> None:
        """Raises what the source failed with, after all that came before it was answered."""
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        # The receiving side meets a closed connection too, and tells it.
        with suppress(ConnectionClosed):
            try:
                for frame in self._frames:
                    if not self._send(frame):
                        return
            except ConnectionClosed:
                raise
            except Exception as error:
                self._failure = error
            self._socket.send(self._conversation.ending())

    def _send(self, frame: SourceFrame) -> bool:
        data = frame.encoded()
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._conversation.has_room)
            if self._stopped:
                return False
            messages = self._conversation.outgoing(frame, data)
        for message in messages:
            self._socket.send(message)
        return True
