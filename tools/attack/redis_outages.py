"""A Redis that closes idle connections, restarts or does not answer. Sessions must still be resumed."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Final

from demo import free_port
from redis.asyncio import Redis
from redis.exceptions import ConnectionError as RedisConnectionError

from attack.definition import Attack, UnexpectedError
from attack.images import road_jpeg
from attack.target import Target
from attack.wire import BINARY, Stream, frame

_START_S: Final = 10.0
_IDLE_S: Final = 2
_BLACK_HOLE_S: Final = 3.0
# A session is saved several times per second.
_SAVED_S: Final = 0.5
_RETRY_S: Final = 0.2
_RESUMED_WITHIN_S: Final = 15.0


@contextmanager
def redis_server(folder: Path) -> Iterator[Mapping[str, str]]:
    """Starts a Redis that keeps its data in `folder`. Raises UnexpectedError if it is not installed."""
    executable = shutil.which("redis-server")
    if executable is None:
        raise UnexpectedError("redis-server is not installed (on Debian: apt install redis-server)")
    port = str(free_port())
    options = ("--port", port, "--bind", "127.0.0.1", "--dir", str(folder), "--save", "3600 1")
    command = [executable, *options, "--enable-debug-command", "local"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield {"LANESTREAM_REDIS_URL": f"redis://127.0.0.1:{port}/0"}
        finally:
            process.send_signal(signal.SIGCONT)
            process.kill()


async def _idle(redis: Redis) -> None:
    """Waits until Redis has closed idle connections."""
    await redis.config_set("timeout", str(_IDLE_S))
    await asyncio.sleep(_IDLE_S + 1.5)


async def _restart(redis: Redis) -> None:
    """Restarts Redis with its data."""
    with suppress(RedisConnectionError):
        await redis.execute_command("DEBUG", "RESTART")  # type: ignore[no-untyped-call]


async def _black_hole(redis: Redis) -> None:
    """Stops Redis for a while: the kernel still accepts connections and what is sent."""
    process = int((await redis.info("server"))["process_id"])
    os.kill(process, signal.SIGSTOP)
    asyncio.get_running_loop().call_later(_BLACK_HOLE_S, os.kill, process, signal.SIGCONT)
    await asyncio.sleep(_BLACK_HOLE_S / 2)


async def _resume_after(outage: Callable[[Redis], Awaitable[None]], target: Target, stop_at: float, count: int) -> None:
    """Opens `count` sessions, closes their sockets, and resumes all of them after, or during, the outage."""
    try:
        while time.monotonic() < stop_at:
            tokens = await asyncio.gather(*(_open(target) for _ in range(count)))
            # A connection of its own each time: Redis closes idle ones.
            async with Redis.from_url(target.setting("redis_url")) as redis:
                await outage(redis)
            async with asyncio.timeout(_RESUMED_WITHIN_S):
                resumed = await asyncio.gather(*(_resume(target, token) for token in tokens))
            if not all(resumed):
                raise UnexpectedError(f"{resumed.count(False)} of {count} sessions were not resumed")
    except TimeoutError:
        raise UnexpectedError(f"sessions were neither resumed nor lost within {_RESUMED_WITHIN_S:g} s") from None


async def _open(target: Target) -> str:
    """Returns the token of a session that has one frame, and whose socket is closed."""
    async with await Stream.open(target) as stream:
        ready = await stream.start()
        await stream.send(frame(BINARY, target.payload))
        await stream.receive_answer()
        await asyncio.sleep(_SAVED_S)
        return str(ready["resume_token"])


async def _resume(target: Target, token: str) -> bool:
    """Returns whether the session is resumed; tries again if the service refuses it for now."""
    while True:
        with suppress(OSError):
            async with await Stream.open(target) as stream:
                return bool((await stream.start(resume_token=token))["resumed"])
        await asyncio.sleep(_RETRY_S)


async def _prepare(_: Target) -> bytes:
    return road_jpeg(320, 180)


def _attack(name: str, description: str, outage: Callable[[Redis], Awaitable[None]]) -> Attack:
    return Attack(
        f"redis/{name}",
        description,
        partial(_resume_after, outage),
        count=8,
        short_count=8,
        surroundings=redis_server,
        prepare=_prepare,
    )


ATTACKS: Final = (
    _attack("idle", "Redis closes idle connections after 2 s", _idle),
    _attack("restart", "Redis restarts", _restart),
    _attack("black-hole", "Redis does not answer for 3 s", _black_hole),
)
