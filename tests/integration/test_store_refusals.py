"""A Redis that answers, but refuses to save sessions: streams go on, and the operator sees it everywhere."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

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
    redis.config_set("save", "3600 1")
    shutil.rmtree(folder)
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
    out_of_memory: "used memory > 'maxmemory'",
    read_only_replica: "read only replica",
    failed_background_save: "unable to persist|MISCONF",
    changed_password: "authenticated",
    revoked_permission: "permissions",
    too_many_clients: "max number of clients",
    no_answer: "no answer|Timeout",
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


def lines_about_saving(capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Returns the lines of the log since the last call that say whether sessions are saved."""
    return [line for line in capfd.readouterr().err.splitlines() if "sessions are" in line]


@pytest.mark.parametrize("streams", [0, 2])
@pytest.mark.parametrize("refuse", REFUSALS, ids=lambda refuse: refuse.__name__)
def test_a_refusal_is_visible_everywhere_and_streams_go_on(
    serve: Serve, tmp_path: Path, capfd: pytest.CaptureFixture[str], refuse: Callable[[Redis, Path], None], streams: int
) -> None:
    (tmp_path / "redis").mkdir()
    with running_redis(tmp_path / "redis") as server, Redis.from_url(server.url) as redis, ExitStack() as stack:
        url = serve(fakes.engine(), redis_url=server.url)
        sockets = [stack.enter_context(stream(url, mode="all")) for _ in range(streams)]
        assert readiness(url) == ("redis", True)
        refuse(redis, tmp_path / "redis")

        def loss_is_reported() -> bool:
            for socket in sockets:
                socket.send(fakes.image_file())
                assert receive(socket)["type"] == "lanes"
            return readiness(url) == ("redis", False)

        wait_until(loss_is_reported)
        assert metric(url, "lane_store_reachable") == 0
        assert metric(url, "lane_store_failures_total") > 0
        assert loss_is_reported()
    (line,) = lines_about_saving(capfd)
    assert re.search(f"WARNING .*: sessions are not saved .*({REFUSALS[refuse]})", line)


def test_the_end_of_a_refusal_is_reported(serve: Serve, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with running_redis(tmp_path) as server, Redis.from_url(server.url) as redis:
        url = serve(fakes.engine(), redis_url=server.url)
        out_of_memory(redis, tmp_path)
        wait_until(lambda: readiness(url) == ("redis", False))
        redis.config_set("maxmemory", "0")
        wait_until(lambda: readiness(url) == ("redis", True))
        assert metric(url, "lane_store_reachable") == 1
    lost, restored, *_ = lines_about_saving(capfd)
    assert "sessions are not saved" in lost
    assert "sessions are saved again" in restored


def test_a_wrong_password_is_reported_before_the_first_stream(
    serve: Serve, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with running_redis(tmp_path) as server:
        with Redis.from_url(server.url) as redis:
            redis.config_set("requirepass", "right-password")
        url = serve(fakes.engine(), redis_url=server.url.replace("//", "//:wrong-password@"))
        wait_until(lambda: readiness(url) == ("redis", False))
    (line,) = lines_about_saving(capfd)
    assert "invalid username-password pair" in line
    assert "wrong-password" not in line


def test_after_a_failover_sessions_are_saved_in_the_new_primary(serve: Serve, tmp_path: Path) -> None:
    (tmp_path / "new").mkdir()
    with running_redis(tmp_path) as old, running_redis(tmp_path / "new") as new, tcp_proxy(old.port) as proxy:
        url = serve(fakes.engine(), redis_url=f"redis://127.0.0.1:{proxy.port}/0")
        with stream(url, mode="all") as socket, Redis.from_url(old.url) as former, Redis.from_url(new.url) as primary:
            socket.send(fakes.image_file())
            assert receive(socket)["type"] == "lanes"
            # The name of the primary leads to the new one, and the old one keeps its connections.
            proxy.redirect(new.port)
            former.replicaof("127.0.0.1", str(new.port))
            wait_until(lambda: any(not key.startswith(b"lanestream:session:check") for key in primary.scan_iter()))
            assert readiness(url) == ("redis", True)
