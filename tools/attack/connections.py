"""Connections by the thousand that do nothing, or as little as they can."""

from __future__ import annotations

import time
from functools import partial
from typing import Final

from attack.clients import Open, Use, repeat
from attack.definition import Attack, UnexpectedError
from attack.heads import LARGE_COOKIE, MANY_HEADERS
from attack.target import Target
from attack.wire import Connection, Stream, head, request, upgrade

# With the settings below, no connection may last longer.
_OLDEST_S: Final = 8.0
_SETTINGS: Final = {"handshake_s": 2, "body_s": 2, "idle_s": 4}
_REOPEN_S: Final = 5.0
_OTHER_ADDRESS: Final = "127.0.0.2"
_COUNT: Final = 2000
_SHORT_COUNT: Final = 1200


async def hold(open_connection: Open[Connection], use: Use[Connection], stop_at: float, count: int) -> None:
    """Holds `count` connections until `stop_at`. Raises UnexpectedError if some were held for too long."""
    old = 0

    async def use_once(connection: Connection) -> None:
        nonlocal old
        since = time.monotonic()
        try:
            await use(connection)
        finally:
            old += time.monotonic() - since > _OLDEST_S

    await repeat(open_connection, use_once, stop_at, count, _REOPEN_S)
    if old:
        raise UnexpectedError(f"{old} connections were held for more than {_OLDEST_S:g} s")


async def _connections(use: Use[Connection], source: str | None, target: Target, stop_at: float, count: int) -> None:
    """Holds connections from the address `source`."""
    await hold(partial(Connection.open, target, source=source), use, stop_at, count)


async def silent_streams(target: Target, stop_at: float, count: int) -> None:
    """Holds streams that never send a message."""
    await hold(partial(Stream.open, target), Connection.discard, stop_at, count)


async def _send(data: bytes, connection: Connection) -> None:
    """Sends `data` and nothing else."""
    await connection.send(data)
    await connection.discard()


async def _dribble(ask: bytes, more: bytes, pause_s: float, connection: Connection) -> None:
    """Sends a request, and after its answer `more` again and again."""
    await connection.send(ask)
    await connection.response()
    while not await connection.closed_within(pause_s):
        await connection.send(more)


def _attack(name: str, description: str, use: Use[Connection], source: str | None = None) -> Attack:
    return Attack(
        f"connections/{name}",
        description,
        partial(_connections, use, source),
        count=_COUNT,
        short_count=_SHORT_COUNT,
        seconds=12.0,
        settings=_SETTINGS,
    )


_HALF_HEAD: Final = head("GET", "/healthz") + b"X-Attack: "
_BODY: Final = partial(_dribble, head("GET", "/healthz", ("Content-Length", "1000")) + b"\r\n", b"x", 2.0)
_EMPTY_LINES: Final = partial(_dribble, request("GET", "/healthz"), b"\r\n", 1.0)

ATTACKS: Final = (
    _attack("silent", "2,000 that send nothing", Connection.discard),
    _attack("silent-elsewhere", "the same from another address", Connection.discard, _OTHER_ADDRESS),
    _attack("half-heads", "2,000 that send half a head", partial(_send, _HALF_HEAD)),
    _attack("half-upgrades", "2,000 handshakes that are never completed", partial(_send, upgrade())),
    _attack("upgrades-cookie", "2,000 handshakes with 9 KB cookies", partial(_send, upgrade(*LARGE_COOKIE) + b"\r\n")),
    _attack("upgrades-headers", "2,000 handshakes with 200 headers", partial(_send, upgrade(*MANY_HEADERS) + b"\r\n")),
    _attack("bodies", "2,000 bodies at a byte in two seconds, after the answer", _BODY),
    _attack("bodies-elsewhere", "the same from another address", _BODY, _OTHER_ADDRESS),
    _attack("empty-lines", "2,000 that send an empty line every second after an answer", _EMPTY_LINES),
    Attack(
        "connections/streams",
        "2,000 streams of one key that never send a message",
        silent_streams,
        count=_COUNT,
        short_count=_SHORT_COUNT,
        seconds=12.0,
        settings=_SETTINGS,
    ),
)
