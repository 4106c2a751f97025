"""`lanestream cluster up` with the real networks, and with what users get wrong."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import fakes
import httpx
import psutil
import pytest
from wsclient import receive, receive_close, send_message, stream

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    pytest.importorskip("ray.serve", reason="needs Ray: use `make cluster-check`")

START_S = 120.0


@contextmanager
def cluster_up(*options: str, **settings: object) -> Iterator[tuple[subprocess.Popen[str], str, list[str]]]:
    """Runs the command, and yields its process, its URL once it is ready, and the lines of its log, which grow."""
    environment = {f"LANESTREAM_{name.upper()}": str(value) for name, value in settings.items()}
    command = [sys.executable, "-m", "lanestream.cli", "cluster", "up", "--provider", "cpu", *options]
    ready, log, urls = threading.Event(), list[str](), list[str]()
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env={**os.environ, **environment}) as process:

        def read() -> None:
            assert process.stderr is not None
            for line in process.stderr:
                log.append(line)
                urls.extend(re.findall(r"ready at (\S+)", line))
                if urls:
                    ready.set()
            ready.set()

        reader = threading.Thread(target=read)
        reader.start()
        try:
            assert ready.wait(START_S), log
            assert urls, log
            yield process, urls[0], log
        finally:
            descendants = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
            process.kill()
            for each in descendants:
                each.kill()
            reader.join(fakes.WAIT_S)


def test_it_serves_until_ctrl_c_and_leaves_nothing_behind(road: bytes) -> None:
    with cluster_up("--port", "0", "--regressor", "none") as (process, url, log):
        started = psutil.Process(process.pid).children(recursive=True)
        assert any("worker_main" in " ".join(each.cmdline()) for each in started)
        assert httpx.get(f"{url}/readyz").json()["status"] == "ready"
        # One replica at random would answer.
        assert httpx.get(f"{url}/metrics").status_code == 404
        lanes = httpx.post(f"{url}/v1/detect", content=road, timeout=fakes.WAIT_S).json()["lanes"]
        assert len(lanes) >= 2
        with stream(url) as socket:
            send_message(socket, "start", mode="all")
            receive(socket)
            socket.send(road)
            assert receive(socket)["type"] == "lanes"
            process.send_signal(signal.SIGINT)
            socket.send(road)
            messages = [receive(socket) for _ in range(2)]
            assert {message["type"] for message in messages} == {"lanes", "draining"}
            assert receive_close(socket)[0] == 1012
        assert process.wait(START_S) == 0
        _, left = psutil.wait_procs(started, fakes.WAIT_S)
        assert not left, left
    assert not [line for line in log if "Traceback" in line or " ERROR " in line], log


@pytest.mark.parametrize(
    ("options", "settings", "message"),
    [
        (["--replicas", "2"], {}, "error: more than one replica needs Redis, so that each can resume "),
        (["--replicas", "two"], {}, "'two' is neither a number nor a range such as 1..4"),
        (["--replicas", "2..1"], {}, "error: max_replicas = 1 is less than min_replicas = 2 (raise max_replicas)"),
        (["--cpus", "999"], {}, "error: the replicas need 999 processors, and this machine has "),
        (["--address", "127.0.0.1:9"], {}, "error: can't use the Ray cluster at 127.0.0.1:9: "),
        ([], {"max_bytes": 1 << 25}, "error: max_bytes = 33554432: Ray's proxy accepts no messages above 16777216 "),
        ([], {"redis_url": "http://user:hunter2@x"}, "error: redis_url is not a valid Redis URL "),
    ],
)
def test_a_mistake_gets_one_line(options: list[str], settings: dict[str, object], message: str) -> None:
    environment = {f"LANESTREAM_{name.upper()}": str(value) for name, value in settings.items()}
    command = [sys.executable, "-m", "lanestream.cli", "cluster", "up", *options]
    result = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=START_S, env={**os.environ, **environment}
    )
    assert result.returncode in (1, 2)
    assert message in result.stderr
    assert "hunter2" not in result.stderr
    assert "Traceback" not in result.stderr


def test_a_port_in_use_is_reported_before_ray_starts() -> None:
    with socket.create_server(("127.0.0.1", 0)) as used:
        command = [sys.executable, "-m", "lanestream.cli", "cluster", "up", "--port", str(used.getsockname()[1])]
        result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=START_S)
    assert result.returncode == 1
    assert re.fullmatch(r"error: port \d+ on 127.0.0.1 is in use \(choose another with --port\)\n", result.stderr)


def test_replicas_that_cannot_start_say_why() -> None:
    command = [sys.executable, "-m", "lanestream.cli", "cluster", "up", "--port", "0", "--model", "missing.onnx"]
    # One attempt is enough here.
    environment = {**os.environ, "RAY_SERVE_MAX_PER_REPLICA_RETRY_COUNT": "1"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=START_S, env=environment)
    assert result.returncode == 1
    expected = "error: the replicas can't start: no model file at missing.onnx (give the path of "
    assert result.stderr.splitlines()[-1].startswith(expected)
    assert "Traceback" not in result.stderr
