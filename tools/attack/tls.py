"""Peers of a service with a certificate of its own that don't complete their handshakes, or complete too many."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Final

import trustme

from attack.clients import Use, repeat
from attack.connections import hold
from attack.definition import Attack
from attack.target import Target, unverified
from attack.wire import Connection, request

_SETTINGS: Final = {"handshake_s": 2}
_COUNT: Final = 2000
_SHORT_COUNT: Final = 1200
_FLOODS: Final = 50


@contextmanager
def _certificate(folder: Path) -> Iterator[Mapping[str, str]]:
    """Writes a certificate, and yields the setting of the service."""
    path = folder / "certificate.pem"
    trustme.CA(key_type=trustme.KeyType.RSA).issue_cert(
        "127.0.0.1", key_type=trustme.KeyType.RSA
    ).private_key_and_cert_chain_pem.write_to_path(str(path))
    yield {"LANESTREAM_TLS_CERTIFICATE": str(path)}


def _hello() -> bytes:
    """Returns the first message of a handshake."""
    outgoing = ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        unverified().wrap_bio(ssl.MemoryBIO(), outgoing, server_hostname="127.0.0.1").do_handshake()
    return outgoing.read()


async def _send(data: bytes, connection: Connection) -> None:
    await connection.send(data)
    await connection.discard()


async def _dribble(data: bytes, connection: Connection) -> None:
    """Sends a message byte by byte, one in half a second."""
    for byte in data:
        await connection.send(bytes([byte]))
        if await connection.closed_within(0.5):
            return


async def _hold(use: Use[Connection], target: Target, stop_at: float, count: int) -> None:
    await hold(partial(Connection.open, target), use, stop_at, count)


async def _flood(data: bytes, target: Target, stop_at: float, count: int) -> None:
    """Begins handshakes at full speed, and ends each connection when the service has answered."""

    async def begin(connection: Connection) -> None:
        await connection.send(data)
        await connection.receive()

    await repeat(partial(Connection.open, target), begin, stop_at, count, pause_s=0.0)


async def _handshakes(target: Target, stop_at: float, count: int) -> None:
    """Completes handshakes at full speed, and does nothing with them."""
    context = unverified()

    async def complete() -> None:
        while True:
            try:
                _, writer = await asyncio.open_connection(target.host, target.port, ssl=context)
                writer.transport.abort()
            except OSError:
                await asyncio.sleep(0.01)

    with suppress(TimeoutError):
        async with asyncio.timeout_at(stop_at), asyncio.TaskGroup() as group:
            for _ in range(count):
                group.create_task(complete())


def _idle(name: str, description: str, use: Use[Connection]) -> Attack:
    return Attack(
        f"tls/{name}",
        description,
        partial(_hold, use),
        count=_COUNT,
        short_count=_SHORT_COUNT,
        seconds=12.0,
        settings=_SETTINGS,
        surroundings=_certificate,
    )


ATTACKS: Final = (
    _idle("silent", "2,000 that send nothing", Connection.discard),
    _idle("hello", "2,000 handshakes that are never completed", partial(_send, _hello())),
    _idle("dribbled-hello", "2,000 handshakes at two bytes a second", partial(_dribble, _hello())),
    _idle("plain", "2,000 requests without TLS", partial(_send, request("GET", "/healthz"))),
    Attack(
        "tls/hellos",
        "handshakes that are begun at full speed over 50 connections",
        partial(_flood, _hello()),
        count=_FLOODS,
        short_count=_FLOODS,
        settings=_SETTINGS,
        surroundings=_certificate,
    ),
    Attack(
        "tls/handshakes",
        "handshakes that are completed at full speed over 50 connections",
        _handshakes,
        count=_FLOODS,
        short_count=_FLOODS,
        settings=_SETTINGS,
        surroundings=_certificate,
    ),
)
