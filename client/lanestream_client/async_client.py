"""The async client. For each stream one task reads the source, one sends, and the caller's task receives."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import aclosing, asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

import httpx
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

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
from lanestream_client.frames import (
    DetectedLanes,
    SourceFrame,
    StreamResult,
    StreamSummary,
    as_source_frame,
    as_source_frames,
)
from lanestream_client.oversize import smaller_image
from lanestream_client.requests import ServiceInfo
from lanestream_client.tls import tls_context

if TYPE_CHECKING:
    from lanestream_client.pixels import BgrImage

_log: Final = logging.getLogger(__name__)


class AsyncLaneClient:
    """The async version of LaneClient, with the same arguments, results and errors."""

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
        options = http_options(self._endpoints, httpx.AsyncHTTPTransport)
        self._http = httpx.AsyncClient(timeout=timeout, headers=self._endpoints[0].headers, **options)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the HTTP connections that were kept open for further requests."""
        await self._http.aclose()

    async def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """Returns the model behind a detector and the provider that runs it; of the default detector if None.

        Raises NoDetectorError if the service has not loaded the detector.
        """
        response = await self._request(lambda base: self._http.get(f"{base}/v1/models"))
        return requests.parse_service_info(response, detector)

    async def detect(
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
        frame = await asyncio.to_thread(requests.read_image, image)
        data = await asyncio.to_thread(frame.encoded)
        query = partial(requests.detect_query, horizon, detector, kinds=kinds)
        try:
            return await self._detect(data, query(camera=camera))
        except ImageTooLargeError:
            smaller = await asyncio.to_thread(smaller_image, frame)
            if smaller is None:
                raise
        _log.warning("%s", smaller.describe())
        return smaller.restore(await self._detect(smaller.data, query(camera=smaller.camera(camera))))

    async def _detect(self, data: bytes, query: requests.Query) -> DetectedLanes:
        response = await self._request(lambda base: self._http.post(f"{base}/v1/detect", content=data, params=query))
        return requests.parse_lanes(response)

    def stream(
        self,
        frames: AsyncIterable[SourceFrame | bytes | BgrImage] | Iterable[SourceFrame | bytes | BgrImage],
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        departure: DepartureOptions | None = None,
        kinds: Sequence[BoundaryKind] | None = None,
        session: str | None = None,
    ) -> AsyncLaneStream:
        """Returns the results of one camera's frames, in frame order, as they arrive; see LaneClient.stream.

        A source that is not an async iterable is read in a thread, because it may block.
        """
        source = _numbered(frames) if isinstance(frames, AsyncIterable) else _read_in_thread(frames)
        start = requests.start_message(mode, horizon, detector, camera, departure, kinds, session)
        failover = FailoverPolicy(self._endpoints, self._retry, self._timeout)
        return AsyncLaneStream(failover, source, ClientProtocol(start, in_flight=self._in_flight))

    async def _request(self, send: Callable[[str], Awaitable[httpx.Response]]) -> httpx.Response:
        """Returns the first successful response of a replica. Raises the last replica's error if all fail."""
        for _ in range(len(self._endpoints) - 1):
            with suppress(*RETRYABLE):
                return await self._request_from_first(send)
            self._endpoints.rotate(-1)
        return await self._request_from_first(send)

    async def _request_from_first(self, send: Callable[[str], Awaitable[httpx.Response]]) -> httpx.Response:
        endpoint = self._endpoints[0]
        with http_errors(endpoint):
            return requests.check_response(await send(endpoint.http), endpoint)


class AsyncLaneStream:
    """The results of one stream. Connects when iterated over, which is possible once."""

    def __init__(self, failover: FailoverPolicy, frames: AsyncIterable[SourceFrame], protocol: ClientProtocol) -> None:
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

    async def __aiter__(self) -> AsyncIterator[StreamResult]:
        async with _StreamTasks(self._protocol, self._frames) as tasks:
            while self._protocol.summary is None:
                failure = None
                try:
                    async with aclosing(self._results_of_connection(tasks)) as results:
                        async for result in results:
                            yield result
                except LanestreamError as error:
                    failure = error
                if failure is not None:
                    async with aclosing(self._handle_failure(failure, tasks)) as results:
                        async for result in results:
                            yield result
            tasks.raise_source_error()

    async def _results_of_connection(self, tasks: _StreamTasks) -> AsyncGenerator[StreamResult]:
        """Yields results until the stream has finished. Raises LanestreamError if the connection fails."""
        protocol, failover, timeout = self._protocol, self._failover, self._failover.timeout_s
        with websocket_errors(failover.endpoint):
            with handshake_errors(failover.endpoint):
                connection = await connect(**connect_options(failover.endpoint, timeout))
            async with connection as socket:
                with stream_errors(socket.response):
                    await socket.send(protocol.start_message())
                    answer = await asyncio.wait_for(socket.recv(), max(timeout, READY_TIMEOUT_S))
                    results = await tasks.locked(partial(protocol.receive_ready, answer))
                    failover.connected()
                    async with tasks.sending_to(socket):
                        for result in results:
                            yield result
                        while protocol.summary is None:
                            results = await tasks.locked(partial(protocol.receive, await socket.recv()))
                            if results:
                                failover.progressed()
                            for result in results:
                                yield result

    async def _handle_failure(self, failure: LanestreamError, tasks: _StreamTasks) -> AsyncGenerator[StreamResult]:
        """Yields the results that were lost and waits for the next attempt. Raises `failure` if there is none."""
        pause = self._failover.pause_after(failure, draining=self._protocol.is_draining)
        if pause is None:
            for result in await tasks.locked(self._protocol.give_up):
                yield result
            raise failure
        for result in await tasks.locked(self._protocol.connection_lost):
            yield result
        if self._protocol.summary is None:
            await asyncio.sleep(pause)


class _StreamTasks:
    """The tasks of one stream, which share its protocol: one reads the source, and one per connection sends."""

    def __init__(self, protocol: ClientProtocol, frames: AsyncIterable[SourceFrame]) -> None:
        self._protocol = protocol
        self._frames = frames
        self._changed = asyncio.Condition()
        self._source_error: Exception | None = None
        self._reader: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        if self._reader is not None:
            await _cancel(self._reader)

    async def locked(self, call: Callable[[], list[StreamResult]]) -> list[StreamResult]:
        """Calls a method of the protocol under the lock, then wakes the other tasks."""
        async with self._changed:
            results = call()
            self._changed.notify_all()
        return results

    @asynccontextmanager
    async def sending_to(self, socket: ClientConnection) -> AsyncIterator[None]:
        """Sends the protocol's messages to `socket` during the block. The first call starts to read the source."""
        sender = asyncio.create_task(self._send(socket))
        if self._reader is None:
            self._reader = asyncio.create_task(self._read_source())
        try:
            yield
        finally:
            await _cancel(sender)

    def raise_source_error(self) -> None:
        """Raises the exception of the source, if any. To be called after all frames before it have their results."""
        if self._source_error is not None:
            raise self._source_error

    async def _send(self, socket: ClientConnection) -> None:
        # The receiving task meets the closed connection too, and reports it.
        with suppress(ConnectionClosed):
            while True:
                for message in await self._next_messages():
                    await socket.send(message)

    async def _next_messages(self) -> list[str | bytes]:
        """Waits for messages to send and returns them."""
        async with self._changed:
            while not (messages := self._protocol.messages_to_send()):
                await self._changed.wait()
            self._changed.notify_all()
        return messages

    async def _read_source(self) -> None:
        try:
            async for frame in self._frames:
                smaller = await asyncio.to_thread(self._protocol.smaller_image, frame)
                data = frame.data if frame.data is not None else await asyncio.to_thread(frame.encoded)
                async with self._changed:
                    self._protocol.add_frame(frame, data, smaller)
                    self._changed.notify_all()
                    await self._changed.wait_for(lambda: self._protocol.wants_frame)
        except Exception as error:
            self._source_error = error
        async with self._changed:
            self._protocol.end_source()
            self._changed.notify_all()


async def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def _numbered(frames: AsyncIterable[SourceFrame | bytes | BgrImage]) -> AsyncIterator[SourceFrame]:
    """Yields the frames of a source, as `as_source_frames` does."""
    seq = 0
    async for frame in frames:
        yield frame if isinstance(frame, SourceFrame) else as_source_frame(frame, seq)
        seq += 1


async def _read_in_thread(frames: Iterable[SourceFrame | bytes | BgrImage]) -> AsyncIterator[SourceFrame]:
    iterator = as_source_frames(frames)
    while (frame := await asyncio.to_thread(next, iterator, None)) is not None:
        yield frame
