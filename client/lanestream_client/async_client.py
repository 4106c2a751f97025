"""The client that awaits. Inside, one task reads the source and one sends, while the caller receives."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterable, AsyncIterator, Awaitable, Callable, Iterable, Sequence
from contextlib import aclosing, asynccontextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import httpx
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from lanestream.errors import LanestreamError
from lanestream.protocol import CameraModel, DetectorName, LanesMessage, Mode, ReadyMessage
from lanestream_client import handshake, requests
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.endpoint import endpoints
from lanestream_client.failover import PASSING, Patience, Route
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary
from lanestream_client.service import ServiceInfo, as_frames

_TIMEOUT_S: Final = 30.0

Frames = AsyncIterable[SourceFrame] | Iterable[SourceFrame | bytes]


class AsyncLaneClient:
    """What LaneClient does, for programs that await: the same arguments, results and errors."""

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
        self._http = httpx.AsyncClient(timeout=timeout, headers=self._replicas[0].headers)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connections that are kept for further requests."""
        await self._http.aclose()

    async def describe(self, detector: DetectorName | None = None) -> ServiceInfo:
        """The model that the service runs for a detector, for its default one where None, and what runs it."""
        return requests.info_of(await self._answer(lambda place: self._http.get(f"{place}/v1/models")), detector)

    async def detect(
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
        data = await asyncio.to_thread(requests.image_bytes, image)
        query = requests.parameters(horizon, detector, camera)
        return requests.lanes_of(
            await self._answer(lambda place: self._http.post(f"{place}/v1/detect", content=data, params=query))
        )

    def stream(
        self,
        frames: Frames,
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        session: str | None = None,
    ) -> AsyncLaneStream:
        """The lanes of the frames of one camera, in their order, as they come; see LaneClient.stream.

        A source that is no async iterable is read in a thread, because it may block.
        """
        source = frames if isinstance(frames, AsyncIterable) else _in_thread(frames)
        start = requests.start(mode, horizon, detector, camera, session)
        route = Route(self._replicas, self._patience, self._timeout)
        return AsyncLaneStream(route, source, ClientProtocol(start, in_flight=self._in_flight))

    async def _answer(self, ask: Callable[[str], Awaitable[httpx.Response]]) -> httpx.Response:
        """The good answer of the first replica that gives one. Raises the last one's error where none does."""
        for _ in range(len(self._replicas) - 1):
            with suppress(*PASSING):
                return await self._answer_of_first(ask)
            self._replicas.rotate(-1)
        return await self._answer_of_first(ask)

    async def _answer_of_first(self, ask: Callable[[str], Awaitable[httpx.Response]]) -> httpx.Response:
        replica = self._replicas[0]
        with requests.reaching(replica.base):
            return requests.checked(await ask(replica.http))


class AsyncLaneStream:
    """The results of one stream: connects when iterated, which can be done once."""

    def __init__(self, route: Route, frames: AsyncIterable[SourceFrame], conversation: ClientProtocol) -> None:
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

    async def __aiter__(self) -> AsyncIterator[StreamResult]:
        conversation = self._conversation
        async with _Exchange(conversation, self._frames) as exchange:
            while conversation.summary is None:
                failure = None
                try:
                    async with aclosing(self._over_one_socket(exchange)) as results:
                        async for result in results:
                            yield result
                except LanestreamError as error:
                    failure = error
                if failure is None:
                    continue
                pause = self._route.after(failure, leaving=conversation.is_draining)
                for result in await exchange.do(
                    conversation.given_up if pause is None else conversation.lost_connection
                ):
                    yield result
                if pause is None:
                    raise failure
                if conversation.summary is None:
                    await asyncio.sleep(pause)
            exchange.check()

    async def _over_one_socket(self, exchange: _Exchange) -> AsyncGenerator[StreamResult]:
        timeout = self._route.timeout_s
        async with _connected(self._route, timeout) as socket:
            await socket.send(self._conversation.opening())
            text = await asyncio.wait_for(socket.recv(), max(timeout, handshake.READY_S))
            results = await exchange.take_in(self._conversation.opened, text)
            self._route.connected()
            async with exchange.sending_over(socket):
                for result in results:
                    yield result
                while self._conversation.summary is None:
                    results = await exchange.take_in(self._conversation.incoming, await socket.recv())
                    if results:
                        self._route.progressed()
                    for result in results:
                        yield result


@asynccontextmanager
async def _connected(route: Route, timeout: float) -> AsyncIterator[ClientConnection]:
    endpoint = route.endpoint
    with handshake.telling(endpoint):
        async with connect(**handshake.options(endpoint, timeout)) as socket:
            yield socket


class _Exchange:
    """Where three tasks share one conversation: the source's and, for each socket, the sender's, and the caller's."""

    def __init__(self, conversation: ClientProtocol, frames: AsyncIterable[SourceFrame]) -> None:
        self._conversation = conversation
        self._frames = frames
        self._changed = asyncio.Condition()
        self._failure: Exception | None = None
        self._source: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None
    ) -> None:
        if self._source is not None:
            await _cancelled(self._source)

    async def do(self, act: Callable[[], list[StreamResult]]) -> list[StreamResult]:
        """Calls a method of the conversation, and has the other tasks look what it changed."""
        async with self._changed:
            results = act()
            self._changed.notify_all()
        return results

    async def take_in(self, act: Callable[[str | bytes], list[StreamResult]], text: str | bytes) -> list[StreamResult]:
        """Hands a message to a method of the conversation, and has the other tasks look what it changed."""
        return await self.do(lambda: act(text))

    @asynccontextmanager
    async def sending_over(self, socket: ClientConnection) -> AsyncIterator[None]:
        """Sends what there is to send, in the block. The source is read from the first block on."""
        sender = asyncio.create_task(self._send(socket))
        if self._source is None:
            self._source = asyncio.create_task(self._read())
        try:
            yield
        finally:
            await _cancelled(sender)

    def check(self) -> None:
        """Raises what the source failed with, after all that came before it was answered."""
        if self._failure is not None:
            raise self._failure

    async def _send(self, socket: ClientConnection) -> None:
        # The receiving side meets a closed connection too, and tells it.
        with suppress(ConnectionClosed):
            while True:
                for message in await self._next_messages():
                    await socket.send(message)

    async def _next_messages(self) -> list[str | bytes]:
        """What to send next, as soon as there is something."""
        async with self._changed:
            while not (messages := self._conversation.outgoing()):
                await self._changed.wait()
            self._changed.notify_all()
        return messages

    async def _read(self) -> None:
        try:
            async for frame in self._frames:
                data = frame.data if frame.data is not None else await asyncio.to_thread(frame.encoded)
                async with self._changed:
                    self._conversation.offer(frame, data)
                    self._changed.notify_all()
                    await self._changed.wait_for(lambda: self._conversation.wants_frame)
        except Exception as error:
            self._failure = error
        async with self._changed:
            self._conversation.no_more()
            self._changed.notify_all()


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def _in_thread(frames: Iterable[SourceFrame | bytes]) -> AsyncIterator[SourceFrame]:
    iterator = as_frames(frames)
    while (frame := await asyncio.to_thread(next, iterator, None)) is not None:
        yield frame
