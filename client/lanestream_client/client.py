"""The client that blocks. Inside, one thread reads the source and one sends, while the caller receives."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lanestream.errors import LanestreamError
from lanestream.protocol import CameraModel, DetectorName, LanesMessage, Mode, ReadyMessage
from lanestream_client import handshake, requests
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.endpoint import endpoints
from lanestream_client.failover import PASSING, Patience, Route
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary
from lanestream_client.service import ServiceInfo, as_frames

_TIMEOUT_S: Final = 30.0


class LaneClient:
    """A Lanestream service at `url`, or its replicas at several. `api_key` opens it where it asks for one.

    Waits `timeout` seconds for a connection and for a single image's answer. Of a stream, `in_flight` frames are
    unanswered at a time: one gives the freshest answers, a few hide a slow network. A stream whose connection is lost
    is opened again, on whichever replica is there, for `reconnect_s` seconds without one; 0 lets it end.

    Raises SettingsError where a URL or the key is none, ConnectionFailedError where the service can't be reached or is
    lost, and the errors that the service tells, as the classes of `lanestream.errors`.
    """

    def __init__(
        self,
        url: str | Sequence[str] = "http://127.0.0.1:8000",
        timeout: float = _TIMEOUT_S,
        in_flight: int = 1,
        *,
        api_key: str | None = None,
        reconnect_s: float = Patience.total_s,
    ) -> None:
        self._replicas = deque(endpoints(url, api_key))  # the one that answered last comes first
        self._timeout = timeout
        self._in_flight = in_flight
        self._patience = Patience(reconnect_s)
        self._http = httpx.Client(timeout=timeout, headers=self._replicas[0].headers)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections that are kept for further requests."""
        self._http.close()

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """The model that the service runs for a detector, for its default one where None, and what runs it."""
        return requests.info_of(self._answer(lambda place: self._http.get(f"{place}/v1/models")), detector)

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
        query = requests.parameters(horizon, detector, camera)
        return requests.lanes_of(
            self._answer(lambda place: self._http.post(f"{place}/v1/detect", content=data, params=query))
        )

    def stream(
        self,
        frames: Iterable[SourceFrame | bytes],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        session: str | None = None,
    ) -> LaneStream:
        """The lanes of the frames of one camera, in their order, as they come; `detector` and `camera` as for `detect`.

        A frame that the service refuses, or whose answer is lost with a connection, gives a result with an `error`, and
        the stream goes on. `session` names it in the service's logs. Raises ProtocolError where an argument is no good.
        """
        start = requests.start(mode, horizon, detector, camera, session)
        route = Route(self._replicas, self._patience, self._timeout)
        return LaneStream(route, as_frames(frames), ClientProtocol(start, in_flight=self._in_flight))

    def _answer(self, ask: Callable[[str], httpx.Response]) -> httpx.Response:
        """The good answer of the first replica that gives one. Raises the last one's error where none does."""
        for _ in range(len(self._replicas) - 1):
            with suppress(*PASSING):
                return self._answer_of_first(ask)
            self._replicas.rotate(-1)
        return self._answer_of_first(ask)

    def _answer_of_first(self, ask: Callable[[str], httpx.Response]) -> httpx.Response:
        replica = self._replicas[0]
        with requests.reaching(replica.base):
            return requests.checked(ask(replica.http))


class LaneStream:
    """The results of one stream: connects when iterated, which can be done once."""

    def __init__(self, route: Route, frames: Iterator[SourceFrame], conversation: ClientProtocol) -> None:
        self._route = route
        self._frames = frames
        self._conversation = conversation

    @property
    def ready(self) -> ReadyMessage | None:
        """What the service said when it opened the stream last; None before."""
        return self._conversation.ready

    @property
    def reconnects(self) -> int:
        """How often the stream was opened again after its connection was lost."""
        return self._conversation.reconnects

    @property
    def summary(self) -> StreamSummary | None:
        """What became of the frames, over all connections; None before the end."""
        return self._conversation.summary

    def __iter__(self) -> Generator[StreamResult]:
        conversation = self._conversation
        with _Exchange(conversation, self._frames) as exchange:
            while conversation.summary is None:
                failure = None
                try:
                    yield from self._over_one_socket(exchange)
                except LanestreamError as error:
                    failure = error
                if failure is not None:
                    yield from self._after(failure, exchange)
            exchange.check()

    def _over_one_socket(self, exchange: _Exchange) -> Generator[StreamResult]:
        timeout = self._route.timeout_s
        with _connected(self._route, timeout) as socket:
            socket.send(self._conversation.opening())
            results = exchange.take_in(self._conversation.opened, socket.recv(max(timeout, handshake.READY_S)))
            self._route.connected()
            with exchange.sending_over(socket):
                yield from results
                while self._conversation.summary is None:
                    results = exchange.take_in(self._conversation.incoming, socket.recv())
                    if results:
                        self._route.progressed()
                    yield from results

    def _after(self, failure: LanestreamError, exchange: _Exchange) -> Generator[StreamResult]:
        """Waits until it is time for another attempt. Raises `failure` where there will be none."""
        pause = self._route.after(failure, leaving=self._conversation.is_draining)
        if pause is None:
            yield from exchange.do(self._conversation.given_up)
            raise failure
        yield from exchange.do(self._conversation.lost_connection)
        if self._conversation.summary is None:
            time.sleep(pause)


@contextmanager
def _connected(route: Route, timeout: float) -> Iterator[ClientConnection]:
    endpoint = route.endpoint
    with handshake.telling(endpoint), connect(**handshake.options(endpoint, timeout)) as socket:
        yield socket


class _Exchange:
    """Where three threads share one conversation: the source's and, for each socket, the sender's, and the caller's."""

    def __init__(self, conversation: ClientProtocol, frames: Iterator[SourceFrame]) -> None:
        self._conversation = conversation
        self._frames = frames
        self._changed = threading.Condition()
        self._sends = False
        self._stopped = False
        self._failure: Exception | None = None
        self._source: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._source is not None:
            self._source.join()

    def do(self, act: Callable[[], list[StreamResult]]) -> list[StreamResult]:
        """Calls a method of the conversation when no other thread does."""
        with self._changed:
            results = act()
            self._changed.notify_all()
        return results

    def take_in(self, act: Callable[[str | bytes], list[StreamResult]], text: str | bytes) -> list[StreamResult]:
        """Hands a message to a method of the conversation when no other thread calls one."""
        return self.do(lambda: act(text))

    @contextmanager
    def sending_over(self, socket: ClientConnection) -> Iterator[None]:
        """Sends what there is to send, in the block. The source is read from the first block on."""
        self._sends = True
        sender = threading.Thread(target=self._send, args=(socket,), name="lanestream-sender", daemon=True)
        sender.start()
        if self._source is None:
            self._source = threading.Thread(target=self._read, name="lanestream-source", daemon=True)
            self._source.start()
        try:
            yield
        finally:
            with self._changed:
                self._sends = False
                self._changed.notify_all()
            # A send that waits for a service that no longer reads ends with its socket.
            socket.close()
            sender.join()

    def check(self) -> None:
        """Raises what the source failed with, after all that came before it was answered."""
        if self._failure is not None:
            raise self._failure

    def _send(self, socket: ClientConnection) -> None:
        # The receiving side meets a closed connection too, and tells it.
        with suppress(ConnectionClosed):
            while messages := self._next_messages():
                for message in messages:
                    socket.send(message)

    def _next_messages(self) -> list[str | bytes]:
        """What to send next, as soon as there is something; nothing at all when the socket is to be left."""
        with self._changed:
            while self._sends:
                if messages := self._conversation.outgoing():
                    self._changed.notify_all()
                    return messages
                self._changed.wait()
        return []

    def _read(self) -> None:
        try:
            for frame in self._frames:
                if not self._offered(frame):
                    return
        except Exception as error:
            self._failure = error
        with self._changed:
            self._conversation.no_more()
            self._changed.notify_all()

    def _offered(self, frame: SourceFrame) -> bool:
        """Hands a frame over and waits until the next is wanted. False where it will never be."""
        data = frame.encoded()
        with self._changed:
            if not self._stopped:
                self._conversation.offer(frame, data)
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._stopped or self._conversation.wants_frame)
            return not self._stopped
