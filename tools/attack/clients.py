"""How attackers use their connections: again and again, and at full speed."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final, TypeVar

from attack.wire import Connection

REOPEN_S: Final = 0.2
# The kernel's queue of new connections should not be the limit.
_OPEN_PER_S: Final = 1000
# Enough of an answer for its status.
_ANSWER_BYTES: Final = 64
_CHUNK_BYTES: Final = 1 << 16

AnyConnection = TypeVar("AnyConnection", bound=Connection)
Open = Callable[[], Awaitable[AnyConnection]]
# Uses a connection until the service closes it; may raise OSError then.
Use = Callable[[AnyConnection], Awaitable[object]]


async def repeat(
    open_connection: Open[AnyConnection], use: Use[AnyConnection], stop_at: float, count: int, pause_s: float = REOPEN_S
) -> None:
    """Uses `count` connections until `stop_at`. Opens another one `pause_s` seconds after one was closed or refused."""

    async def run(number: int) -> None:
        await asyncio.sleep(number / _OPEN_PER_S)
        while True:
            with suppress(OSError):
                async with await open_connection() as connection:
                    await use(connection)
            await asyncio.sleep(pause_s)

    with suppress(TimeoutError):
        async with asyncio.timeout_at(stop_at), asyncio.TaskGroup() as group:
            for number in range(count):
                group.create_task(run(number))


async def pour(beginning: bytes, more: bytes, connection: Connection) -> bytes:
    """Sends `beginning` and then `more` for ever, and reads all answers, until the service closes the connection.

    Returns how the first answer begins. It is empty if the service did not answer, or if a reset overtook the answer.
    """

    async def send() -> None:
        with suppress(OSError):
            await connection.send(beginning)
            while True:
                await connection.send(more)

    sending, answer = asyncio.create_task(send()), b""
    try:
        while data := await connection.receive():
            answer = answer or data[:_ANSWER_BYTES]
        return answer
    finally:
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)


def many(data: bytes) -> bytes:
    """Returns `data` as often as it fits into one large write."""
    return data * max(1, _CHUNK_BYTES // len(data))
