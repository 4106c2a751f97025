"""Messages and bodies that are never completed, and as many large images as the limits allow."""

from __future__ import annotations

from functools import partial
from typing import Final

from attack.clients import repeat
from attack.costly import saturate
from attack.definition import Attack
from attack.images import padded, road_jpeg
from attack.target import Target
from attack.wire import BINARY, Connection, Stream, frame_head, head

_BYTES: Final = 8 << 20
_REOPEN_S: Final = 1.0


async def unfinished_messages(target: Target, stop_at: float, count: int) -> None:
    """Streams that send all of a message of 8 MB but its last byte."""
    use = partial(_send_and_wait, frame_head(BINARY, _BYTES))
    await repeat(partial(Stream.open, target), use, stop_at, count, _REOPEN_S)


async def unfinished_bodies(target: Target, stop_at: float, count: int) -> None:
    """Requests that send all of a body of 8 MB but its last byte."""
    beginning = head("POST", "/v1/detect", ("Content-Length", str(_BYTES)), key=target.attacker_key) + b"\r\n"
    use = partial(_send_and_wait, beginning)
    await repeat(partial(Connection.open, target), use, stop_at, count, _REOPEN_S)


async def _send_and_wait(beginning: bytes, connection: Connection) -> None:
    await connection.send(beginning)
    await connection.send(bytes(_BYTES - 1))
    await connection.discard()


async def _prepare(_: Target) -> bytes:
    return padded(road_jpeg(1280, 720), _BYTES)


ATTACKS: Final = (
    Attack(
        "memory/images",
        "64 streams that use all their credits for images of 8 MB",
        saturate,
        count=64,
        short_count=16,
        prepare=_prepare,
    ),
    Attack(
        "memory/messages",
        "1,000 messages of 8 MB without their last byte",
        unfinished_messages,
        count=1000,
        short_count=200,
    ),
    Attack(
        "memory/bodies", "200 bodies of 8 MB without their last byte", unfinished_bodies, count=200, short_count=100
    ),
)
