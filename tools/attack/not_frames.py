"""Messages and requests that are not frames, at full speed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from functools import partial
from itertools import cycle
from typing import Final

from attack.clients import many, pour, repeat
from attack.definition import Attack, UnexpectedError
from attack.target import Target
from attack.wire import BINARY, CONTINUATION, PING, PONG, TEXT, Connection, Stream, frame, head, request

_TEXT_BYTES: Final = 60_000
_LARGE_TEXT_BYTES: Final = 14_000_000
_FIELD_BYTES: Final = 12
_CLOSED_WITHIN_S: Final = 5.0
_PROTOCOL_ERROR: Final = 1002
_INVALID_DATA: Final = 1007


async def flood(beginning: bytes, more: bytes, target: Target, stop_at: float, count: int) -> None:
    """Sends `beginning` and then `more` for ever over each stream."""
    await repeat(partial(Stream.open, target), partial(pour, beginning, more), stop_at, count)


async def _large_texts(target: Target, stop_at: float, count: int) -> None:
    await flood(b"", frame(TEXT, _fields(_LARGE_TEXT_BYTES)), target, stop_at, count)


async def _invalid(frames: Sequence[bytes], code: int, target: Target, stop_at: float, _: int) -> None:
    """Sends one of `frames` over each stream. The service must close it with `code`."""
    for each in cycle(frames):
        if time.monotonic() >= stop_at:
            return
        try:
            async with asyncio.timeout(_CLOSED_WITHIN_S), await Stream.open(target) as stream:
                await stream.send(each)
                got = await stream.close_code()
        except TimeoutError:
            raise UnexpectedError(f"a stream with an invalid frame stayed open for {_CLOSED_WITHIN_S:g} s") from None
        if got != code:
            raise UnexpectedError(f"the frame {each[:8].hex()} was answered with the code {got} instead of {code}")


async def _pipeline(target: Target, stop_at: float, count: int) -> None:
    use = partial(pour, b"", many(request("GET", "/healthz")))
    await repeat(partial(Connection.open, target), use, stop_at, count)


async def not_found(target: Target, stop_at: float, count: int) -> None:
    """Requests a page that does not exist, over a fresh connection each time."""
    ask = head("GET", "/missing", ("Connection", "close")) + b"\r\n"

    async def use(connection: Connection) -> None:
        await connection.send(ask)
        await connection.discard()

    await repeat(partial(Connection.open, target), use, stop_at, count, pause_s=0.0)


def _fields(size: int) -> bytes:
    """Returns a JSON object of about `size` bytes with many unknown fields."""
    fields = (f'"{number:07x}":0' for number in range(size // _FIELD_BYTES))
    return f'{{"type":"start",{",".join(fields)}}}'.encode()


_SMALL_TEXTS: Final = partial(flood, b"", many(frame(TEXT, b'"abcde"')))
_NESTED: Final = b'{"type":"start","session":' + b"[" * (_TEXT_BYTES // 2) + b"]" * (_TEXT_BYTES // 2) + b"}"
_INVALID_TEXTS: Final = tuple(frame(TEXT, text) for text in (b"\xff", b'{"type": "\xc3"}', b"\xed\xa0\x80"))
_FRAGMENT: Final = frame(BINARY, b"x", final=False)
_RESERVED: Final = (
    *(frame(TEXT, b"{}", reserved=bits) for bits in (1, 2, 4)),
    *(frame(opcode, b"x") for opcode in (3, 7, 11, 15)),
    frame(PING, b"x", final=False),
    frame(PING, bytes(126)),
    frame(CONTINUATION, b"x"),
    _FRAGMENT + frame(BINARY, b"x"),
)


def _attack(name: str, description: str, more: bytes, beginning: bytes = b"") -> Attack:
    return Attack(f"not_frames/{name}", description, partial(flood, beginning, many(more)))


ATTACKS: Final = (
    Attack("not_frames/text-14mb", "JSON objects of 14 MB", _large_texts),
    _attack("texts-fields", "texts of 60 KB with thousands of unknown fields", frame(TEXT, _fields(_TEXT_BYTES))),
    _attack("texts-nested", "texts of 60 KB, deeply nested", frame(TEXT, _NESTED)),
    Attack("not_frames/texts-small", "texts of 7 bytes, one stream", _SMALL_TEXTS),
    Attack("not_frames/texts-small-8", "texts of 7 bytes, 8 streams", _SMALL_TEXTS, count=8, short_count=8),
    _attack("pings", "empty pings", frame(PING)),
    _attack("pongs", "empty pongs", frame(PONG)),
    _attack("fragments-empty", "empty fragments of one message", frame(CONTINUATION, final=False), _FRAGMENT),
    _attack("fragments-byte", "fragments of one byte", frame(CONTINUATION, b"x", final=False), _FRAGMENT),
    _attack("images-empty", "empty binary messages", frame(BINARY)),
    Attack("not_frames/utf8", "texts that are not UTF-8", partial(_invalid, _INVALID_TEXTS, _INVALID_DATA)),
    Attack("not_frames/reserved", "frames that RFC 6455 forbids", partial(_invalid, _RESERVED, _PROTOCOL_ERROR)),
    Attack("not_frames/healthz", "pipelined requests for `/healthz`", _pipeline),
    Attack("not_frames/not-found", "404s over fresh connections, 8 at a time", not_found, count=8, short_count=8),
)
