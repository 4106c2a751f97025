"""The load generator, a process of its own: sends frames that were encoded before, and notes when answers come."""

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

from bench.frames import FPS, Clips, to_and_fro
from bench.orders import Answer, Order, Tally

# Replies are not parsed: that would cost the generator more than all the rest.
_TYPE: Final = re.compile(r'"type":\s*"(\w+)"')
_SEQ: Final = re.compile(r'"seq":\s*(\d+)')
_LENGTH: Final = re.compile(rb"content-length: (\d+)", re.IGNORECASE)
_HELLO_S: Final = 60.0
_FAREWELL_S: Final = 0.2


def generate(pipe: Connection, clips: Clips) -> None:
    """The process: takes orders from `pipe` until it is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe.send({})
    asyncio.run(_obey(pipe, clips))


async def _obey(pipe: Connection, clips: Clips) -> None:
    while True:
        order: Order = await asyncio.to_thread(pipe.recv)
        load = Load(order, clips[order.size])
        stop = asyncio.create_task(asyncio.to_thread(pipe.recv))
        streams = [asyncio.create_task(load.stream(number)) for number in range(order.sessions)]
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
            pipe.send(f"a stream to {order.url} ended early: {broken[0]!r}")
        await stop
        pipe.send(load.tally)


class Load:
    """The sessions of one order and what came back to them."""

    def __init__(self, order: Order, jpegs: Sequence[bytes]) -> None:
        self._order = order
        self._jpegs = jpegs
        self._unsettled = set(range(order.sessions))
        self.settled = asyncio.Event()
        self.tally = Tally()

    async def stream(self, number: int) -> None:
        """One session; sessions begin at different places of the drive, as cameras do."""
        first = number * 7
        if self._order.kind == "http":
            await asyncio.gather(*(self._post(number, first + i) for i in range(self._order.in_flight)))
            return
        async with connect(
            self._order.url, compression=None, max_size=None, open_timeout=_HELLO_S, close_timeout=_FAREWELL_S
        ) as socket:
            if self._order.kind == "lanestream":
                mode = "all" if self._order.rate is None else "latest"
                await socket.send(json.dumps({"type": "start", "mode": mode, "detector": self._order.detector}))
                await socket.recv()
            if self._order.rate is None:
                await self._in_turn(socket, number, first)
            else:
                await self._pushed(socket, number, first, self._order.rate)

    async def _in_turn(self, socket: ClientConnection, number: int, first: int) -> None:
        """Each answer is followed by the next frame."""
        sent: deque[float] = deque()
        for seq in count():
            if seq >= self._order.in_flight:
                while self._kind(await socket.recv()) not in ("lanes", "error"):
                    pass
                self._answered(number, sent.popleft())
            sent.append(time.monotonic())
            await self._send(socket, seq, seq / FPS, first)

    async def _pushed(self, socket: ClientConnection, number: int, first: int, rate: float) -> None:
        """A camera that does not wait: a frame is captured as it is sent, and none while the last one is being sent."""
        sent: dict[int, float] = {}
        reading = asyncio.create_task(self._read(socket, number, sent))
        # Cameras are not in step.
        due = time.monotonic() + number / (rate * self._order.sessions)
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
            if self._kind(reply) == "lanes":
                found = _SEQ.search(str(reply))
                assert found is not None  # noqa: S101 - every answer has its number
                self._answered(number, sent.pop(int(found[1])))

    async def _send(self, socket: ClientConnection, seq: int, timestamp: float, first: int) -> None:
        if self._order.kind == "lanestream":
            await socket.send(f'{{"type":"frame","seq":{seq},"timestamp":{timestamp}}}')
        await socket.send(self._jpegs[to_and_fro(first + seq, len(self._jpegs))])

    def _kind(self, reply: str | bytes) -> str:
        """The type of a message; errors are counted."""
        found = _TYPE.search(str(reply), 0, 64)
        kind = found[1] if found else ""
        self.tally.failed += kind == "error"
        return kind

    def _answered(self, number: int, sent: float) -> None:
        self.tally.answers.append(Answer(number, sent, time.monotonic()))
        self._unsettled.discard(number)
        if not self._unsettled:
            self.settled.set()

    async def _post(self, number: int, first: int) -> None:
        """A connection that is kept alive: requests that were written before the clock starts, one after the other."""
        place = urlsplit(self._order.url)
        requests = [_request(place.netloc, place.path, jpeg) for jpeg in self._jpegs]
        reader, writer = await asyncio.open_connection(place.hostname, place.port)
        try:
            for seq in count(first):
                sent = time.monotonic()
                writer.write(requests[to_and_fro(seq, len(requests))])
                head = await reader.readuntil(b"\r\n\r\n")
                length = _LENGTH.search(head)
                assert length is not None  # noqa: S101 - LitServe tells it of every answer
                await reader.readexactly(int(length[1]))
                self.tally.failed += b" 200 " not in head[:20]
                self._answered(number, sent)
        finally:
            writer.close()


def _request(host: str, path: str, jpeg: bytes) -> bytes:
    """A POST with the picture as the form's field `image`, as a browser would send it."""
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
    kind = f"multipart/form-data; boundary={boundary.decode()}"
    head = f"POST {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body
