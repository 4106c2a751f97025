"""The client that awaits. Inside, one task sends what a source gives while the caller receives."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator, Iterable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import httpx
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from lanestream.protocol import SUBPROTOCOL, CameraModel, DetectorName, LanesMessage, Mode, ReadyMessage, SummaryMessage
from lanestream_client import requests
from lanestream_client.conversation import Conversation, lost
from lanestream_client.endpoint import Endpoint
from lanestream_client.frames import SourceFrame, StreamResult
from lanestream_client.service import ServiceInfo, as_frames

_TIMEOUT_S: Final = 30.0

Frames = AsyncIterable[SourceFrame] | Iterable[SourceFrame | bytes]


class AsyncLaneClient:
    """What LaneClient does, for programs that await: the same arguments, results and errors."""

    def __init__(self, url: str = "http://127.0.0.1:8000", timeout: float = _TIMEOUT_S, in_flight: int = 1) -> None:
        self._endpoint = Endpoint.parse(url)
        self._timeout = timeout
        self._in_flight = in_flight
        self._http = httpx.AsyncClient(base_url=self._endpoint.http, timeout=timeout)

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
        with requests.reaching(self._endpoint.base):
            return requests.info_of(await self._http.get("/v1/models"), detector)

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
        with requests.reaching(self._endpoint.base):
            query = requests.parameters(horizon, detector, camera)
            response = await self._http.post("/v1/detect", content=data, params=query)
        return requests.lanes_of(response)

    def stream(
        self,
        frames: Frames,
        *,
        mode: Mode = "latest",
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
    ) -> AsyncLaneStream:
        """The lanes of the frames of one camera, in their order, as they come; see LaneClient.stream.

        A source that is no async iterable is read in a thread, because it may block.
        """
        source = frames if isinstance(frames, AsyncIterable) else _in_thread(frames)
        conversation = Conversation(mode, horizon, detector, camera, in_flight=self._in_flight)
        return AsyncLaneStream(self._endpoint, source, conversation, self._timeout)


class AsyncLaneStream:
    """The results of one stream: connects when iterated, which can be done once. `ready` and `summary` are kept."""

    def __init__(
        self, endpoint: Endpoint, frames: AsyncIterable[SourceFrame], conversation: Conversation, timeout: float
    ) -> None:
        self._endpoint = endpoint
        self._frames = frames
        self._conversation = conversation
        self._timeout = timeout
        self._changed = asyncio.Condition()

    @property
    def ready(self) -> ReadyMessage | None:
        """What the service said when it opened the stream; None before."""
        return self._conversation.ready

    @property
    def summary(self) -> SummaryMessage | None:
        """The service's final count; None before the end."""
        return self._conversation.summary

    async def __aiter__(self) -> AsyncIterator[StreamResult]:
        conversation = self._conversation
        async with _connected(self._endpoint, self._timeout) as socket:
            await socket.send(conversation.opening())
            conversation.opened(await asyncio.wait_for(socket.recv(), self._timeout))
            sender = asyncio.create_task(self._send_all(socket))
            try:
                while conversation.summary is None:
                    for result in await self._receive(socket):
                        yield result
                await sender
            finally:
                sender.cancel()
                await asyncio.gather(sender, return_exceptions=True)

    async def _receive(self, socket: ClientConnection) -> list[StreamResult]:
        text = await socket.recv()
        async with self._changed:
            results = self._conversation.incoming(text)
            self._changed.notify()
        return results

    async def _send_all(self, socket: ClientConnection) -> None:
        """Sends while there is room. Raises what the source failed with, after the `end` that follows it."""
        # The receiving side meets a closed connection too, and tells it.
        failure: Exception | None = None
        with suppress(ConnectionClosed):
            try:
                async for frame in self._frames:
                    await self._send(socket, frame)
            except ConnectionClosed:
                raise
            except Exception as error:
                failure = error
            await socket.send(self._conversation.ending())
        if failure is not None:
            raise failure

    async def _send(self, socket: ClientConnection, frame: SourceFrame) -> None:
        data = await asyncio.to_thread(frame.encoded) if frame.data is None else frame.data
        async with self._changed:
            await self._changed.wait_for(lambda: self._conversation.has_room)
            messages = self._conversation.outgoing(frame, data)
        for message in messages:
            await socket.send(message)


@asynccontextmanager
async def _connected(endpoint: Endpoint, timeout: float) -> AsyncIterator[ClientConnection]:
    try:
        async with connect(
            endpoint.stream, subprotocols=[Subprotocol(SUBPROTOCOL)], compression=None, open_timeout=timeout
        ) as socket:
            yield socket
    except ConnectionClosed as error:
        raise lost(error) from None
    except InvalidStatus as error:
        raise requests.refused(endpoint.base, error) from None
    except (OSError, TimeoutError, WebSocketException) as error:
        raise requests.unreachable(endpoint.base, error) from None


async def _in_thread(frames: Iterable[SourceFrame | bytes]) -> AsyncIterator[SourceFrame]:
    iterator = as_frames(frames)
    while (frame := await asyncio.to_thread(next, iterator, None)) is not None:
        yield frame
