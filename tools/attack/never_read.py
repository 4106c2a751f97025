"""Clients that send and never read what the service answers."""

from __future__ import annotations

import asyncio
import math
from functools import partial
from itertools import cycle
from typing import Final

from attack.clients import many, repeat
from attack.definition import Attack
from attack.images import road_jpeg
from attack.target import Target
from attack.wire import BINARY, PING, TEXT, Connection, Stream, frame, request

# Messages per second of a stream; few enough not to exceed the limits of a camera.
_MESSAGES_PER_S: Final = 100
_SESSIONS: Final = 8
# Leaves others a moment to take a session that has become free.
_REOPEN_S: Final = 0.5


async def unread_sessions(target: Target, stop_at: float, count: int) -> None:
    """Streams whose answers and errors are not read. So few bytes are sent that only the answers fill buffers."""

    async def use(connection: Connection) -> None:
        for message in cycle((frame(BINARY, b"not an image"), frame(TEXT, b"?"))):
            await connection.send(message)
            await asyncio.sleep(1.0 / _MESSAGES_PER_S)

    await repeat(partial(Stream.open, target, reads_slowly=True), use, stop_at, count, _REOPEN_S)


async def _unread_pings(target: Target, stop_at: float, count: int) -> None:
    pings = many(frame(PING, bytes(125)))
    await repeat(partial(Stream.open, target, reads_slowly=True), partial(_send_forever, pings), stop_at, count)


async def unread_pictures(target: Target, stop_at: float, count: int) -> None:
    """Requests for pictures that are not read."""
    ask = request("POST", "/v1/detect", ("Accept", "image/png"), key=target.attacker_key, body=target.payload)

    async def use(connection: Connection) -> None:
        await connection.send(ask)
        await asyncio.sleep(math.inf)

    await repeat(partial(Connection.open, target, reads_slowly=True), use, stop_at, count)


async def _unread_documents(target: Target, stop_at: float, count: int) -> None:
    asks = many(request("GET", "/openapi.json"))
    await repeat(partial(Connection.open, target, reads_slowly=True), partial(_send_forever, asks), stop_at, count)


async def _prepare(_: Target) -> bytes:
    return road_jpeg(1280, 720)


async def _send_forever(data: bytes, connection: Connection) -> None:
    while True:
        await connection.send(data)


ATTACKS: Final = (
    Attack(
        "never_read/sessions",
        "as many unread streams as the service has sessions",
        unread_sessions,
        count=_SESSIONS,
        short_count=_SESSIONS,
        seconds=15.0,
        settings={
            "max_sessions": _SESSIONS,
            "max_sessions_per_caller": _SESSIONS,
            "handshake_s": 2,
            "idle_s": 4,
            "send_s": 2,
        },
        lockout_s=10.0,
    ),
    Attack("never_read/pings", "pings over one stream", _unread_pings),
    Attack("never_read/pings-8", "pings over 8 streams", _unread_pings, count=8, short_count=8),
    Attack(
        "never_read/pictures",
        "200 requests for pictures",
        unread_pictures,
        count=200,
        short_count=50,
        prepare=_prepare,
    ),
    Attack("never_read/documents", "pipelined requests for a document", _unread_documents, count=8, short_count=8),
)
