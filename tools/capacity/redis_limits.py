"""What one Redis can hold: the size of a saved session, and how many saves one Redis manages."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import redis
from bench.frames import FPS

from capacity.nodes import NodeSetup, running_nodes, running_redis
from lanestream.streaming.redis_store import RedisStore
from lanestream.streaming.store import StoredSession
from lanestream_client import LaneClient, SourceFrame

_TTL_S: Final = 120.0
_CONNECTIONS: Final = 50
# More than Redis manages in a second, so that a load lasts for about as many seconds as it should.
_PER_S: Final = 30_000


@dataclass(frozen=True)
class RedisLimits:
    """The figures of one Redis.

    `record_bytes` is the size of a saved session, `memory_bytes` what Redis needs for it. `saves_per_s` is how many
    saves it managed, and `us_per_save` the processor time of one. `wire_bytes` are those received and sent for one.
    """

    record_bytes: int
    memory_bytes: float
    saves_per_s: float
    us_per_save: float
    wire_bytes: float


def measure_redis(images: list[bytes], folder: Path, sessions: int, seconds: float) -> RedisLimits:
    """Lets a node save a session, and lets redis-benchmark save copies of it with the service's script."""
    with running_redis(folder) as url, running_nodes(1, NodeSetup(), url, folder) as nodes:
        record = _saved_record(nodes[0].url, url, images)
    with running_redis(folder) as url, redis.Redis.from_url(url) as client:
        empty = client.info("memory")["used_memory"]
        script = asyncio.run(_save(url, record, sessions))
        memory = (client.info("memory")["used_memory"] - empty) / sessions
        # A session belongs to the replica that saved it.
        client.flushdb()
        before = _counts(client)
        saves_per_s = _benchmark(url, script, record, sessions, round(seconds * _PER_S))
        after = _counts(client)
    saves = after[0] - before[0]
    return RedisLimits(
        len(record), memory, saves_per_s, 1e6 * (after[1] - before[1]) / saves, (after[2] - before[2]) / saves
    )


def _saved_record(node_url: str, redis_url: str, images: list[bytes]) -> bytes:
    """Returns the record of a session after its frames."""
    record = b""
    with LaneClient(node_url) as client, redis.Redis.from_url(redis_url) as store:
        for _ in client.stream((SourceFrame(seq, seq / FPS, image) for seq, image in enumerate(images)), mode="all"):
            record = bytes(store.hget(store.keys("lanestream:session:*")[0], "data") or record)
    return record


async def _save(url: str, record: bytes, sessions: int) -> str:
    """Saves as many sessions with the service's own store, and returns the name of the script for that."""
    store = RedisStore(url)
    for number in range(sessions):
        await store.save(str(number), StoredSession("camera", "camera", "owner", record), _TTL_S)
    await store.close()
    return str(store._save.sha)


def _benchmark(url: str, script: str, record: bytes, sessions: int, saves: int) -> float:
    """Returns how many saves per second Redis manages."""
    executable = shutil.which("redis-benchmark")
    if executable is None:
        raise FileNotFoundError("redis-benchmark is not installed (on Debian: apt install redis-tools)")
    options = ("-p", str(urlsplit(url).port), "-c", str(_CONNECTIONS), "-n", str(saves), "-r", str(sessions), "--csv")
    key = "lanestream:session:__rand_int__"
    command = ("evalsha", script, "1", key, "camera", "owner", record.decode(), str(round(1e3 * _TTL_S)))
    output = subprocess.run([executable, *options, *command], capture_output=True, text=True, check=True).stdout
    # The first of eight fields is the command, whose own quotes are not escaped; the second one is the rate.
    return float(output.splitlines()[-1].rsplit('","', 7)[1])


def _counts(client: redis.Redis) -> tuple[int, float, int]:
    """Returns scripts run, seconds of processor time, and bytes received and sent."""
    cpu, stats = client.info("cpu"), client.info("stats")
    calls = client.info("commandstats").get("cmdstat_evalsha", {"calls": 0})["calls"]
    total = stats["total_net_input_bytes"] + stats["total_net_output_bytes"]
    return calls, cpu["used_cpu_user"] + cpu["used_cpu_sys"], total
