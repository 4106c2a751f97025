"""`lanestream cluster up` with the real networks, and with what users get wrong."""

from __future__ import annotations

import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import cycle, pairwise

import cv2
import fakes
import httpx
import numpy as np
import psutil
import pytest
from processes import service
from wsclient import receive, receive_close, send_message, stream

from lanestream_client import LaneClient, SourceFrame
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

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


@pytest.mark.skipif("CLUSTER_NODES" not in os.environ, reason="only measures: use `make cluster-check`")
def test_the_cost_of_ray_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    clip = sample_clip(np.random.default_rng(24), 1280, 720, frames=24, fps=25.0, drive=Drive("highway", fair=True))
    images = [cv2.imencode(".jpg", frame.image)[1].tobytes() for frame in render_clip(clip)]
    # One worker process, as a replica with one processor has.
    with service(processes=1, threads=2, inference_threads=1) as (_, url):
        measured = {"lanestream serve": measure(url, images)}
    with cluster_up("--port", "0") as (_, url, _):
        measured["one replica on Ray"] = measure(url, images)
    with capsys.disabled():
        size = statistics.median(map(len, images)) / 1000
        print(f"\nframes of 1280 x 720, {size:.0f} kB, one worker process:")
        for name, (rate, median_ms) in measured.items():
            print(f"{name}: {rate:.1f} frames/s with 4 streams, {median_ms:.1f} ms from frame to reply with one")


def measure(url: str, images: list[bytes], seconds: float = 10.0) -> tuple[float, float]:
    """Returns the frames per second of four streams, and the median milliseconds from frame to reply of one."""
    end = time.monotonic() + seconds
    with ThreadPoolExecutor(4) as threads:
        counts = [len(times) for times in threads.map(lambda _: answer_times(url, images, end, 2), range(4))]
    alone = answer_times(url, images, time.monotonic() + seconds, 1)
    return sum(counts) / seconds, 1e3 * statistics.median(after - before for before, after in pairwise(alone))


def answer_times(url: str, images: list[bytes], end: float, in_flight: int) -> list[float]:
    """Streams until `end`, as fast as answers come. Returns when they came."""

    def source() -> Iterator[SourceFrame]:
        for number, image in enumerate(cycle(images)):
            if time.monotonic() > end:
                return
            yield SourceFrame(number, 0.04 * number, data=image)

    with LaneClient(url, in_flight=in_flight) as client:
        stream = client.stream(source(), mode="all")
        times = [time.monotonic() for result in stream if result.lanes is not None]
        assert stream.summary is not None
        assert stream.summary.answered == stream.summary.frames == len(times)
    return times
