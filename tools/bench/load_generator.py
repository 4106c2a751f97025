"""The load generator, a process of its own: sends encoded frames and records when the replies arrive."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import time
from collections import deque
from collections.abc import Sequence
from itertools import count
from multiprocessing.connection import Connection
from typing import Final
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect

from bench.frames import FPS, Clips, forward_and_backward
from bench.workload import LoadRequest, LoadResult, Reply

# Replies are not parsed as JSON: that would cost the generator more than everything else.
_TYPE: Final = re.compile(r'"type":\s*"(\w+)"')
_SEQ: Final = re.compile(r'"seq":\s*(\d+)')
_CONTENT_LENGTH: Final = re.compile(rb"content-length: (\d+)", re.IGNORECASE)
_OPEN_TIMEOUT_S: Final = 60.0
_CLOSE_TIMEOUT_S: Final = 0.2


def generate(pipe: Connection, clips: Clips) -> None:
    """Serves load requests from `pipe` until it is closed; the target of a process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe.send({})
    asyncio.run(_serve(pipe, clips))


async def _serve(pipe: Connection, clips: Clips) -> None:
    while True:
        request: LoadRequest = await asyncio.to_thread(pipe.recv)
        load = Load(request, clips[request.size])
        stop = asyncio.create_task(asyncio.to_thread(pipe.recv))
        streams = [asyncio.create_task(load.stream(number)) for number in range(request.sessions)]
        settled = asyncio.create_task(load.settled.wait())
        await asyncio.wait({stop, settled, *streams}, return_when=asyncio.FIRST_COMPLETED)
        if settled.done():
            pipe.send(None)
        await asyncio.wait({stop, *streams}, return_when=asyncio.FIRST_COMPLETED)
        broken = [stream.exception() for stream in streams if stream.done()]
        settled.cancel()
        for stream in streams:
            stream.cancel()
        await asyncio.gather(*streams, return_exceptions=True)
        if broken:
            pipe.send(f"a stream to {request.url} ended early: {broken[0]!r}")
        await stop
        pipe.send(load.result)


class Load:
    """The sessions of one load request, and the replies to them."""

    def __init__(self, request: LoadRequest, jpegs: Sequence[bytes]) -> None:
        self._request = request
        self._jpegs = jpegs
        self._unsettled = set(range(request.sessions))
        self.settled = asyncio.Event()
        self.result = LoadResult()

    async def stream(self, number: int) -> None:
        """Runs one session. Every session starts at another frame of the drive, like independent cameras."""
        first = number * 7
        if self._request.transport == "http":
            await asyncio.gather(*(self._post(number, first + i) for i in range(self._request.in_flight)))
            return
        async with connect(
            self._request.url,
            compression=None,
            max_size=None,
            open_timeout=_OPEN_TIMEOUT_S,
            close_timeout=_CLOSE_TIMEOUT_S,
        ) as socket:
            if self._request.transport == "lanestream":
                mode = "all" if self._request.rate is None else "latest"
                await socket.send(json.dumps({"type": "start", "mode": mode, "detector": self._request.detector}))
                await socket.recv()
            if self._request.rate is None:
                await self._request_reply(socket, number, first)
            else:
                await self._push(socket, number, first, self._request.rate)

    async def _request_reply(self, socket: ClientConnection, number: int, first: int) -> None:
        """Sends the next frame after each reply."""
        sent: deque[float] = deque()
        for seq in count():
            if seq >= self._request.in_flight:
                while self._message_type(await socket.recv()) not in ("lanes", "error"):
                    pass
                self._add_reply(number, sent.popleft())
            sent.append(time.monotonic())
            await self._send(socket, seq, seq / FPS, first)

    async def _push(self, socket: ClientConnection, number: int, first: int, rate: float) -> None:
        """Sends frames at a fixed rate without waiting for replies. Frames that are due during a send are skipped."""
        sent: dict[int, float] = {}
        reading = asyncio.create_task(self._read(socket, number, sent))
        # Cameras send at different times.
        due = time.monotonic() + number / (rate * self._request.sessions)
        try:
            for seq in count():
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                if reading.done():
                    await reading
                now = sent[seq] = time.monotonic()
                await self._send(socket, seq, now, first)
                due = max(due + 1.0 / rate, time.monotonic())
        finally:
            reading.cancel()

    async def _read(self, socket: ClientConnection, number: int, sent: dict[int, float]) -> None:
        async for reply in socket:
            if self._message_type(reply) == "lanes":
                found = _SEQ.search(str(reply))
                assert found is not None  # noqa: S101 - every `lanes` message has one
                self._add_reply(number, sent.pop(int(found[1])))

    async def _send(self, socket: ClientConnection, seq: int, timestamp: float, first: int) -> None:
        if self._request.transport == "lanestream":
            await socket.send(f'{{"type":"frame","seq":{seq},"timestamp":{timestamp}}}')
        await socket.send(self._jpegs[forward_and_backward(first + seq, len(self._jpegs))])

    def _message_type(self, reply: str | bytes) -> str:
        """Returns the type of a message, and counts errors."""
        found = _TYPE.search(str(reply), 0, 64)
        message_type = found[1] if found else ""
        self.result.failed += message_type == "error"
        return message_type

    def _add_reply(self, number: int, sent: float) -> None:
        self.result.replies.append(Reply(number, sent, time.monotonic()))
        self._unsettled.discard(number)
        if not self._unsettled:
            self.settled.set()

    async def _post(self, number: int, first: int) -> None:
        """Posts frames one after the other over a persistent connection. The requests are built in advance."""
        url = urlsplit(self._request.url)
        requests = [_request(url.netloc, url.path, jpeg) for jpeg in self._jpegs]
        reader, writer = await asyncio.open_connection(url.hostname, url.port)
        try:
            for seq in count(first):
                sent = time.monotonic()
                writer.write(requests[forward_and_backward(seq, len(requests))])
                head = await reader.readuntil(b"\r\n\r\n")
                length = _CONTENT_LENGTH.search(head)
                assert length is not None  # noqa: S101 - LitServe always sends it
                await reader.readexactly(int(length[1]))
                self.result.failed += b" 200 " not in head[:20]
                self._add_reply(number, sent)
        finally:
            writer.close()


def _request(host: str, path: str, jpeg: bytes) -> bytes:
    """Returns a POST request with the image in the form field `image`, as a browser sends it."""
    boundary = b"----lanestream-bench"
    body = b"\r\n".join(
        (
            b"--" + boundary,
            b'Content-Disposition: form-data; name="image"; filename="frame.jpg"',
            b"Content-Type: image/jpeg",
            b"",
            jpeg,
            b"--" + boundary + b"--",
            b"",
        )
    )
    content_type = f"multipart/form-data; boundary={boundary.decode()}"
    head = (
        f"POST {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    return head.encode() + body
