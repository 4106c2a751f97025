"""Requests whose heads, trailers or chunk extensions never end."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from typing import Final

from attack.clients import many, pour
from attack.definition import Attack, UnexpectedError
from attack.target import Target
from attack.wire import Connection, head, status, upgrade

# A head that arrives at full speed is too large within a fraction of a second.
_CLOSED_WITHIN_S: Final = 5.0
_REFUSALS: Final = frozenset({400, 408, 413, 414, 431})
_CHUNKED: Final = ("Transfer-Encoding", "chunked")
_LINES: Final = many(b"X-Attack: 0123456789\r\n")
_LETTERS: Final = many(b"a")
_GET: Final = head("GET", "/healthz")
_GET_CHUNKED: Final = head("GET", "/healthz", _CHUNKED) + b"\r\n"
LARGE_COOKIE: Final = (("Cookie", "c=" + 9000 * "x"),)
MANY_HEADERS: Final = tuple((f"X-Attack-{number}", "x") for number in range(200))


async def _endless(beginning: bytes, more: bytes, target: Target, stop_at: float, _: int) -> None:
    """Sends `beginning` and then `more` for ever, over one connection at a time. The service must refuse each."""
    while time.monotonic() < stop_at:
        answer = await _pour(beginning, more, target, stop_at)
        if answer and status(answer) not in _REFUSALS:
            raise UnexpectedError(f"the service answered an endless head with {answer[:30]!r}")


async def _endless_after_head(beginning: bytes, more: bytes, target: Target, stop_at: float, _: int) -> None:
    """The same, but the service may answer before it closes the connection."""
    while time.monotonic() < stop_at:
        await _pour(beginning, more, target, stop_at)


async def _endless_detect(beginning: bytes, more: bytes, target: Target, stop_at: float, count: int) -> None:
    """The same with a body for /v1/detect."""
    detect = head("POST", "/v1/detect", _CHUNKED, key=target.attacker_key) + b"\r\n"
    await _endless_after_head(detect + beginning, more, target, stop_at, count)


async def _pour(beginning: bytes, more: bytes, target: Target, stop_at: float) -> bytes:
    """Returns how the answer begins, empty if there is none. Raises UnexpectedError if the connection stays open."""
    until = time.monotonic() + _CLOSED_WITHIN_S
    try:
        async with asyncio.timeout_at(min(until, stop_at)), await Connection.open(target) as connection:
            return await pour(beginning, more, connection)
    except TimeoutError:
        if until <= stop_at:
            raise UnexpectedError(f"the service read what never ends for {_CLOSED_WITHIN_S:g} s") from None
        return b""


async def _large_upgrades(headers: tuple[tuple[str, str], ...], target: Target, stop_at: float, _: int) -> None:
    """Sends handshakes that have a large head. Each must be answered, or closed, within seconds."""
    while time.monotonic() < stop_at:
        try:
            async with asyncio.timeout(_CLOSED_WITHIN_S), await Connection.open(target) as connection:
                await connection.send(upgrade(*headers) + b"\r\n")
                await connection.receive()
        except TimeoutError:
            raise UnexpectedError(
                f"a handshake with a large head was neither answered nor closed for {_CLOSED_WITHIN_S:g} s"
            ) from None


ATTACKS: Final = (
    Attack("heads/lines", "endless header lines", partial(_endless, _GET, _LINES)),
    Attack("heads/value", "an endless header value", partial(_endless, _GET + b"X: ", _LETTERS)),
    Attack("heads/name", "an endless header name", partial(_endless, _GET, _LETTERS)),
    Attack("heads/url", "an endless URL", partial(_endless, b"GET /", _LETTERS)),
    Attack("heads/trailers", "endless trailers", partial(_endless_after_head, _GET_CHUNKED + b"0\r\n", _LINES)),
    Attack(
        "heads/trailers-detect",
        "endless trailers, `/v1/detect`",
        partial(_endless_detect, b"5\r\nimage\r\n0\r\n", _LINES),
    ),
    Attack(
        "heads/extension", "an endless chunk extension", partial(_endless_after_head, _GET_CHUNKED + b"1;", _LETTERS)
    ),
    Attack(
        "heads/extension-detect", "an endless chunk extension, `/v1/detect`", partial(_endless_detect, b"5;", _LETTERS)
    ),
    Attack("heads/upgrade-cookie", "handshakes with a cookie of 9 KB", partial(_large_upgrades, LARGE_COOKIE)),
    Attack("heads/upgrade-headers", "handshakes with 200 headers", partial(_large_upgrades, MANY_HEADERS)),
)
