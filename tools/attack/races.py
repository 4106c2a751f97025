"""Two sockets that resume one session at the same instant. One must keep it, the other one must be told `evicted`."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress
from typing import Any, Final

from attack.definition import Attack, Run, Surroundings, UnexpectedError, nothing
from attack.images import road_jpeg
from attack.redis_outages import redis_server
from attack.target import Target
from attack.wire import BINARY, Stream, frame

_PARALLEL: Final = 8
_DECIDED_WITHIN_S: Final = 5.0
_FRAME_S: Final = 0.1
_SETTINGS: Final = {"resume_s": 10}

# Messages with the number of the stream that got them, 0 or 1.
_Inbox = asyncio.Queue[tuple[int, dict[str, Any]]]


async def _one_replica(target: Target, stop_at: float, count: int) -> None:
    await _races(target, target, stop_at, count)


async def _two_replicas(target: Target, stop_at: float, count: int) -> None:
    with target.replica() as other:
        await _races(target, other, stop_at, count)


async def _races(first: Target, second: Target, stop_at: float, count: int) -> None:
    """Runs `count` races, several at a time. Raises UnexpectedError if they end wrongly, or not all of them in time."""
    numbers, done, wrong = iter(range(count)), 0, list[str]()

    async def run() -> None:
        nonlocal done
        for _ in numbers:
            if time.monotonic() < stop_at:
                problem = await _race(first, second)
                done += 1
                wrong.extend([problem] if problem else [])

    async with asyncio.TaskGroup() as group:
        for _ in range(_PARALLEL):
            group.create_task(run())
    if wrong:
        raise UnexpectedError(f"{len(wrong)} of {done} races ended wrongly: {max(set(wrong), key=wrong.count)}")
    if done < count:
        raise UnexpectedError(f"only {done} of {count} races ended in time")


async def _race(first: Target, second: Target) -> str | None:
    """Runs one race and returns what was wrong with its end, None if nothing."""
    async with await Stream.open(first) as stream:
        token = (await stream.start())["resume_token"]
    inbox: _Inbox = asyncio.Queue()
    # Another replica learns that it has lost the session when it saves it, after a frame.
    may_send = asyncio.Event()
    if second is not first:
        may_send.set()
    async with await Stream.open(first) as one, await Stream.open(second) as other:
        await asyncio.gather(*(stream.send_json("start", resume_token=token) for stream in (one, other)))
        image = frame(BINARY, first.payload)
        tasks = [asyncio.create_task(_read(stream, number, inbox)) for number, stream in enumerate((one, other))]
        tasks += [asyncio.create_task(_send(stream, image, may_send)) for stream in (one, other)]
        try:
            async with asyncio.timeout(_DECIDED_WITHIN_S):
                return await _end(inbox, may_send)
        except TimeoutError:
            return f"not decided within {_DECIDED_WITHIN_S:g} s"
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _read(stream: Stream, number: int, inbox: _Inbox) -> None:
    """Puts everything that a stream gets into the inbox."""
    try:
        while True:
            inbox.put_nowait((number, await stream.receive_json()))
    except ConnectionError as error:
        inbox.put_nowait((number, {"type": "closed", "code": str(error)}))


async def _send(stream: Stream, image: bytes, may_send: asyncio.Event) -> None:
    """Sends frames until the service closes the stream."""
    await may_send.wait()
    with suppress(OSError):
        while True:
            await stream.send(image)
            await asyncio.sleep(_FRAME_S)


async def _end(inbox: _Inbox, may_send: asyncio.Event) -> str | None:
    """Waits until one stream has lost the session, and until the other one has got the lanes of a later frame."""
    resumed = {0: False, 1: False}
    loser: int | None = None
    while True:
        number, message = await inbox.get()
        if number == loser:
            continue
        if message["type"] == "ready":
            resumed[number] = message["resumed"]
        elif message["type"] == "lanes" and loser is not None:
            return None if resumed[number] else "the stream that was not evicted has a new session"
        elif message["type"] != "lanes":
            if message.get("code") != "evicted" or loser is not None:
                return f"{'both streams' if loser is not None else 'a stream'} got {message.get('code')}"
            loser = number
            may_send.set()


async def _prepare(_: Target) -> bytes:
    return road_jpeg(320, 180)


def _attack(name: str, description: str, run: Run, seconds: float, surroundings: Surroundings = nothing) -> Attack:
    return Attack(
        f"races/{name}",
        description,
        run,
        count=1000,
        short_count=50,
        seconds=seconds,
        short_seconds=20.0,
        settings=_SETTINGS,
        surroundings=surroundings,
        prepare=_prepare,
    )


ATTACKS: Final = (
    _attack("memory", "1,000 races of two sockets for one session", _one_replica, 120.0),
    _attack("redis", "the same with Redis", _one_replica, 120.0, redis_server),
    _attack("two-replicas", "the same over two replicas with Redis", _two_replicas, 240.0, redis_server),
)
