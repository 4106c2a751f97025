"""A Redis that answers, but refuses to save sessions: streams go on, and the operator sees it everywhere."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import httpx
import pytest
from redis import Redis
from redisserver import running_redis
from tcpproxy import tcp_proxy
from wsclient import receive, stream

Serve = Callable[..., str]


def out_of_memory(redis: Redis, _: Path) -> None:
    redis.config_set("maxmemory-policy", "noeviction")
    redis.config_set("maxmemory", "1")


def read_only_replica(redis: Redis, _: Path) -> None:
    redis.replicaof("127.0.0.1", "1")


def failed_background_save(redis: Redis, folder: Path) -> None:
    (folder / "data").mkdir()
    redis.config_set("save", "3600 1")
    redis.config_set("dir", str(folder / "data"))
    shutil.rmtree(folder / "data")
    redis.bgsave()
    wait_until(lambda: redis.info("persistence")["rdb_last_bgsave_status"] == "err")  # type: ignore[index]


def changed_password(redis: Redis, _: Path) -> None:
    redis.config_set("requirepass", "changed")
    redis.execute_command("AUTH", "changed")
    redis.client_kill_filter(_type="normal", skipme=True)


def revoked_permission(redis: Redis, _: Path) -> None:
    redis.execute_command("ACL", "SETUSER", "default", "resetkeys", "~others:*")


def too_many_clients(redis: Redis, _: Path) -> None:
    redis.config_set("maxclients", "1")
    redis.client_kill_filter(_type="normal", skipme=True)


def no_answer(redis: Redis, _: Path) -> None:
    redis.client_pause(60_000, all=False)


REFUSALS = {
    out_of_memory: "OOM",
    read_only_replica: "READONLY",
    failed_background_save: "MISCONF",
    changed_password: "Authentication required",
    revoked_permission: "NOPERM|No permissions|can't access",
    too_many_clients: "max number of clients",
    no_answer: "Timeout|no answer",
}


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + fakes.WAIT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def readiness(url: str) -> tuple[str, bool]:
    answer = httpx.get(f"{url}/readyz")
    assert answer.status_code == 200
    return answer.json()["store"], answer.json()["store_reachable"]


def metric(url: str, name: str) -> float:
    lines = httpx.get(f"{url}/metrics").text.splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(f"{name} ")))


def events(caplog: pytest.LogCaptureFixture) -> list[Any]:
    found = [getattr(record, "event", None) for record in caplog.records]
    return [event for event in found if event in {"store_lost", "store_restored"}]


@pytest.mark.parametrize("streams", [0, 2])
@pytest.mark.parametrize("refuse", REFUSALS, ids=lambda refuse: refuse.__name__)
def test_a_refusal_is_visible_everywhere_and_streams_go_on(
    serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture, refuse: Callable[[Redis, Path], None], streams: int
) -> None:
    with running_redis(tmp_path) as server, Redis.from_url(server.url) as redis:
        url = serve(fakes.engine(), redis_url=server.url)
        sockets = [stream(url, mode="all") for _ in range(streams)]
        opened = [socket.__enter__() for socket in sockets]
        assert readiness(url) == ("redis", True)
        refuse(redis, tmp_path)

        def frames_are_answered_and_the_loss_is_seen() -> bool:
            for socket in opened:
                socket.send(fakes.image_file())
                assert receive(socket)["type"] == "lanes"
            return readiness(url) == ("redis", False)

        wait_until(frames_are_answered_and_the_loss_is_seen)
        assert metric(url, "lane_store_reachable") == 0
        assert metric(url, "lane_store_failures_total") > 0
        assert frames_are_answered_and_the_loss_is_seen()
        for socket in sockets:
            socket.__exit__(None, None, None)
    assert events(caplog) == ["store_lost"]
