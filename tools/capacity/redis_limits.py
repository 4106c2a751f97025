"""What one Redis can hold: the size of a saved session, and how many saves one Redis manages."""

from __future__ import annotations

import asyncio
import itertools
import multiprocessing
import time
from dataclasses import dataclass
from multiprocessing.pool import AsyncResult
from pathlib import Path
from typing import Final

import redis
from bench.frames import FPS

from capacity.nodes import NodeSetup, running_nodes, running_redis
from lanestream.streaming.redis_store import RedisStore
from lanestream.streaming.store import StoredSession
from lanestream_client import LaneClient, SourceFrame

_TTL_S: Final = 120.0
_PROCESSES: Final = 2
# Saves of one process that wait for Redis at a time.
_CONCURRENT: Final = 16


@dataclass(frozen=True)
class RedisLimits:
    """The figures of one Redis.

    `record_bytes` is the size of a saved session, `memory_bytes` what Redis needs for it. `saves_per_s` is how many it
    managed from `sessions` sessions, and `us_per_save` the processor time of one. `wire_bytes` are those received and
    sent for one.
    """

    record_bytes: int
    memory_bytes: float
    sessions: int
    saves_per_s: float
    us_per_save: float
    wire_bytes: float


def measure_redis(images: list[bytes], folder: Path, sessions: int, seconds: float) -> RedisLimits:
    """Lets a node save a session, and then saves copies of it as often as possible with the service's own store."""
    with running_redis(folder) as url, running_nodes(1, NodeSetup(), url, folder) as nodes:
        record = _saved_record(nodes[0].url, url, images)
    with running_redis(folder) as url, redis.Redis.from_url(url) as client:
        empty = client.info("memory")["used_memory"]
        asyncio.run(_save_once(url, record, sessions))
        memory = (client.info("memory")["used_memory"] - empty) / sessions
        # A session belongs to the replica that saved it: the next ones save their own.
        client.flushdb()
        before = _counts(client)
        with multiprocessing.get_context("spawn").Pool(_PROCESSES) as pool:
            each = sessions // _PROCESSES
            running: list[AsyncResult[int]] = [
                pool.apply_async(save_for, (url, record, part * each, each, seconds)) for part in range(_PROCESSES)
            ]
            counts = [result.get() for result in running]
        after = _counts(client)
    saves = after[0] - before[0]
    return RedisLimits(
        len(record),
        memory,
        sessions,
        sum(counts) / seconds,
        1e6 * (after[1] - before[1]) / saves,
        (after[2] - before[2]) / saves,
    )


def _counts(client: redis.Redis) -> tuple[int, float, int]:
    """Returns scripts run, seconds of processor time, and bytes received and sent."""
    cpu, stats = client.info("cpu"), client.info("stats")
    calls = client.info("commandstats").get("cmdstat_evalsha", {"calls": 0})["calls"]
    total = stats["total_net_input_bytes"] + stats["total_net_output_bytes"]
    return calls, cpu["used_cpu_user"] + cpu["used_cpu_sys"], total


def _saved_record(node_url: str, redis_url: str, images: list[bytes]) -> bytes:
    """Returns the record of a session after its frames."""
    with LaneClient(node_url) as client, redis.Redis.from_url(redis_url) as store:
        for _ in client.stream((SourceFrame(seq, seq / FPS, image) for seq, image in enumerate(images)), mode="all"):
            keys = store.keys("lanestream:session:*")
            record = bytes(store.hget(keys[0], "data") or b"")
        return record


async def _save_once(url: str, record: bytes, sessions: int) -> None:
    store = RedisStore(url)
    for number in range(sessions):
        await store.save(str(number), StoredSession("camera", "camera", "owner", record), _TTL_S)
    await store.close()


def save_for(url: str, record: bytes, first: int, sessions: int, seconds: float) -> int:
    """Saves sessions from number `first` on, in turn, for some seconds. Returns how many saves succeeded."""
    return asyncio.run(_save_for(url, record, first, sessions, seconds))


async def _save_for(url: str, record: bytes, first: int, sessions: int, seconds: float) -> int:
    store, saves = RedisStore(url), 0
    end = time.monotonic() + seconds

    async def save(part: int) -> None:
        nonlocal saves
        for number in itertools.cycle(range(first + part, first + sessions, _CONCURRENT)):
            if time.monotonic() >= end:
                return
            # With an owner of its own in each process, as on replicas; the sessions are different ones.
            saves += await store.save(str(number), StoredSession("camera", "camera", "owner", record), _TTL_S)

    await asyncio.gather(*(save(part) for part in range(_CONCURRENT)))
    await store.close()
    return saves
