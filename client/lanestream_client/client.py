"""The blocking client. For each stream one thread reads the source, one sends, and the caller's thread receives."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

import httpx
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lanestream.errors import ImageTooLargeError, LanestreamError
from lanestream.protocol import (
    BoundaryKind,
    CameraModel,
    DepartureOptions,
    DetectorName,
    Mode,
    ReadyMessage,
    WarningMessage,
)
from lanestream_client import requests
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.endpoint import (
    READY_TIMEOUT_S,
    connect_options,
    handshake_errors,
    http_errors,
    http_options,
    parse_endpoints,
    stream_errors,
    websocket_errors,
)
from lanestream_client.failover import RETRYABLE, FailoverPolicy, RetryPolicy
from lanestream_client.frames import DetectedLanes, SourceFrame, StreamResult, StreamSummary, as_source_frames
from lanestream_client.oversize import smaller_image
from lanestream_client.requests import ServiceInfo
from lanestream_client.tls import tls_context

if TYPE_CHECKING:
    from lanestream_client.pixels import BgrImage

_log: Final = logging.getLogger(__name__)


class LaneClient:
    """A client of the Lanestream service at `url`, or of its replicas at several URLs.

    `timeout` limits, in seconds, a first connection and the response to a single image. A stream keeps up to
    `in_flight` frames unanswered: one gives the freshest results, a few hide a slow network. A stream that loses its
    connection reconnects to any replica, and ends after `reconnect_s` seconds without a connection; 0 disables this.

    For https, `ca_file` is a PEM file of the authorities to trust instead of the system's, and `client_certificate` one
    with a certificate and its private key, for services that ask for it.

    Raises SettingsError if a URL, `api_key` or a file is not valid. The methods raise ConnectionFailedError if the
    service can't be reached or is lost, and the errors that the service sends, as the classes of `lanestream.errors`.
    """

    def __init__(
        self,
        url: str | Sequence[str] = "http://127.0.0.1:8000",
        timeout: float = 30.0,
        in_flight: int = 1,
        *,
        api_key: str | None = None,
        reconnect_s: float = RetryPolicy.total_s,
        ca_file: str | Path | None = None,
        client_certificate: str | Path | None = None,
    ) -> None:
        tls = tls_context(ca_file, client_certificate)
        self._endpoints = deque(parse_endpoints(url, api_key, tls))  # the replica that answered last comes first
        self._timeout = timeout
        self._in_flight = in_flight
        self._retry = RetryPolicy(reconnect_s)
        options = http_options(self._endpoints, httpx.HTTPTransport)
        self._http = httpx.Client(timeout=timeout, headers=self._endpoints[0].headers, **options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Closes the HTTP connections that were kept open for further requests."""
        self._http.close()

    def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """Returns the model behind a detector and the provider that runs it; of the default detector if None.

        Raises NoDetectorError if the service has not loaded the detector.
        """
        response = self._request(lambda base: self._http.get(f"{base}/v1/models"))
        return requests.parse_service_info(response, detector)

    def detect(
        self,
        image: bytes | str | Path | BgrImage,
        *,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
    ) -> DetectedLanes:
        """Returns the lanes of one image: the bytes of a JPEG, PNG or WebP file, its path, or its pixels.

        Pixels are a NumPy array BGR (H, W, 3) uint8, as OpenCV reads them, and are sent as a JPEG.
        `horizon` is the row of the horizon as a share of the image height, from -0.6 (above the image) to 1, estimated
        if None. `detector` defaults to the service's. With a `camera` the lanes are also given in meters. `kinds` are
        those of the boundaries to report, by default the service's. Raises SourceError if the file can't be read, and
        ImageError if pixels have another type or shape.
        """
        frame = requests.read_image(image)
        query = partial(requests.detect_query, horizon, detector, kinds=kinds)
        try:
            return self._detect(frame.encoded(), query(camera=camera))
        except ImageTooLargeError:
            smaller = smaller_image(frame)
            if smaller is None:
                raise
        _log.warning("%s", smaller.describe())
        return smaller.restore(self._detect(smaller.data, query(camera=smaller.camera(camera))))

    def _detect(self, data: bytes, query: requests.Query) -> DetectedLanes:
        response = self._request(lambda base: self._http.post(f"{base}/v1/detect", content=data, params=query))
        return requests.parse_lanes(response)

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
    ) -> LaneStream:
        """Returns the results of one camera's frames, in frame order, as they arrive.

        A frame is a SourceFrame, an image file, or its pixels, a NumPy array BGR (H, W, 3) uint8.
        `horizon`, `detector`, `camera` and `kinds` are as for `detect`; `departure` says when to warn of lane
        departures, which needs a camera; `session` is a name for the service's logs. A frame that the service refuses,
        or whose result is lost with a connection, yields a result with an `error`, and the stream continues. Raises
        ProtocolError if an argument is not valid.
        """
        start = requests.start_message(mode, horizon, detector, camera, departure, kinds, session)
        failover = FailoverPolicy(self._endpoints, self._retry, self._timeout)
        return LaneStream(failover, as_source_frames(frames), ClientProtocol(start, in_flight=self._in_flight))

    def _request(self, send: Callable[[str], httpx.Response]) -> httpx.Response:
        """Returns the first successful response of a replica. Raises the last replica's error if all fail."""
        for _ in range(len(self._endpoints) - 1):
            with suppress(*RETRYABLE):
                return self._request_from_first(send)
            self._endpoints.rotate(-1)
        return self._request_from_first(send)

    def _request_from_first(self, send: Callable[[str], httpx.Response]) -> httpx.Response:
        endpoint = self._endpoints[0]
        with http_errors(endpoint):
            return requests.check_response(send(endpoint.http), endpoint)


class LaneStream:
    """The results of one stream. Connects when iterated over, which is possible once."""

    def __init__(self, failover: FailoverPolicy, frames: Iterator[SourceFrame], protocol: ClientProtocol) -> None:
        self._failover = failover
        self._frames = frames
        self._protocol = protocol

    @property
    def ready(self) -> ReadyMessage | None:
        """The `ready` message of the latest connection, or None before the first."""
        return self._protocol.ready

    @property
    def reconnects(self) -> int:
        """How often the stream was opened again after its connection was lost."""
        return self._protocol.reconnects

    @property
    def warnings(self) -> tuple[WarningMessage, ...]:
        """The warnings that the service has sent so far, for example of timestamps in milliseconds."""
        return self._protocol.warnings

    @property
    def summary(self) -> StreamSummary | None:
        """The frame counts over all connections, or None before the end."""
        return self._protocol.summary

    def __iter__(self) -> Generator[StreamResult]:
        with _StreamThreads(self._protocol, self._frames) as threads:
            while self._protocol.summary is None:
                failure = None
                try:
                    yield from self._results_of_connection(threads)
                except LanestreamError as error:
                    failure = error
                if failure is not None:
                    yield from self._handle_failure(failure, threads)
            threads.raise_source_error()

    def _results_of_connection(self, threads: _StreamThreads) -> Generator[StreamResult]:
        """Yields results until the stream has finished. Raises LanestreamError if the connection fails."""
        protocol, failover, timeout = self._protocol, self._failover, self._failover.timeout_s
        with websocket_errors(failover.endpoint):
            with handshake_errors(failover.endpoint):
                connection = connect(**connect_options(failover.endpoint, timeout))
            with connection as socket, stream_errors(socket.response):
                socket.send(protocol.start_message())
                answer = socket.recv(max(timeout, READY_TIMEOUT_S))
                results = threads.locked(partial(protocol.receive_ready, answer))
                failover.connected()
                with threads.sending_to(socket):
                    yield from results
                    while protocol.summary is None:
                        results = threads.locked(partial(protocol.receive, socket.recv()))
                        if results:
                            failover.progressed()
                        yield from results

    def _handle_failure(self, failure: LanestreamError, threads: _StreamThreads) -> Generator[StreamResult]:
        """Yields the results that were lost and waits for the next attempt. Raises `failure` if there is none."""
        pause = self._failover.pause_after(failure, draining=self._protocol.is_draining)
        if pause is None:
            yield from threads.locked(self._protocol.give_up)
            raise failure
        yield from threads.locked(self._protocol.connection_lost)
        if self._protocol.summary is None:
            time.sleep(pause)


class _StreamThreads:
    """The threads of one stream, which share its protocol: one reads the source, and one per connection sends."""

    def __init__(self, protocol: ClientProtocol, frames: Iterator[SourceFrame]) -> None:
        self._protocol = protocol
        self._frames = frames
        self._changed = threading.Condition()
        self._sending = False
        self._stopped = False
        self._source_error: Exception | None = None
        self._reader: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        if self._reader is not None:
            self._reader.join()

    def locked(self, call: Callable[[], list[StreamResult]]) -> list[StreamResult]:
        """Calls a method of the protocol under the lock, then wakes the other threads."""
        with self._changed:
            results = call()
            self._changed.notify_all()
        return results

    @contextmanager
    def sending_to(self, socket: ClientConnection) -> Iterator[None]:
        """Sends the protocol's messages to `socket` during the block. The first call starts to read the source."""
        self._sending = True
        sender = threading.Thread(target=self._send, args=(socket,), name="lanestream-sender", daemon=True)
        sender.start()
        if self._reader is None:
            self._reader = threading.Thread(target=self._read_source, name="lanestream-source", daemon=True)
            self._reader.start()
        try:
            yield
        finally:
            with self._changed:
                self._sending = False
                self._changed.notify_all()
            # Closing the socket also ends a send that blocks because the service no longer reads.
            socket.close()
            sender.join()

    def raise_source_error(self) -> None:
        """Raises the exception of the source, if any. To be called after all frames before it have their results."""
        if self._source_error is not None:
            raise self._source_error

    def _send(self, socket: ClientConnection) -> None:
        # The receiving thread meets the closed connection too, and reports it.
        with suppress(ConnectionClosed):
            while messages := self._next_messages():
                for message in messages:
                    socket.send(message)

    def _next_messages(self) -> list[str | bytes]:
        """Waits for messages to send and returns them. Returns none when sending over this socket should stop."""
        with self._changed:
            while self._sending:
                if messages := self._protocol.messages_to_send():
                    self._changed.notify_all()
                    return messages
                self._changed.wait()
        return []

    def _read_source(self) -> None:
        try:
            for frame in self._frames:
                if not self._add_frame(frame):
                    return
        except Exception as error:
            self._source_error = error
        with self._changed:
            self._protocol.end_source()
            self._changed.notify_all()

    def _add_frame(self, frame: SourceFrame) -> bool:
        """Adds a frame and waits until the next one is wanted. Returns False if the stream has stopped."""
        smaller = self._protocol.smaller_image(frame)
        data = frame.encoded() if smaller is None else smaller.data
        with self._changed:
            if not self._stopped:
                self._protocol.add_frame(frame, data, smaller)
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._stopped or self._protocol.wants_frame)
            return not self._stopped
