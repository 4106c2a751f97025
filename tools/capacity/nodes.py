"""Real nodes on this machine: services as processes of their own, which may be limited to a share of a processor."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil
from demo import LANESTREAM, free_port, wait_until_ready

from capacity.cpu_group import CpuGroup

_REDIS_S: Final = 10.0


@dataclass(frozen=True)
class NodeSetup:
    """What a node is: `workers` processes, and at most `cores` of processor time per second, unlimited if None.

    With `waiting_times`, a JSON file of seconds, its detector only waits for so long.
    """

    workers: int = 1
    cores: float | None = None
    waiting_times: Path | None = None


class Node:
    """A running service."""

    def __init__(self, process: subprocess.Popen[bytes], url: str) -> None:
        self.url = url
        self._process = process
        self._workers = psutil.Process(process.pid).children(recursive=True)

    @property
    def pid(self) -> int:
        """The process id of the service's own process."""
        return self._process.pid

    def cpu_s(self) -> tuple[float, float]:
        """Returns the processor time so far: of the service's own process, and of its workers."""
        return process_cpu_s(self._process.pid), sum(process_cpu_s(worker.pid) for worker in self._workers)

    def kill(self) -> None:
        """Kills the service and its workers at once, as the loss of a machine does."""
        self._process.kill()
        for worker in self._workers:
            with suppress(psutil.NoSuchProcess):
                worker.kill()
        self._process.wait()
        psutil.wait_procs(self._workers)


def process_cpu_s(pid: int) -> float:
    """Returns the processor time of a process and its threads, in seconds, to the nanosecond."""
    total = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with suppress(OSError):
            total += int(path.read_text().split()[0])
    return 1e-9 * total


@contextmanager
def running_nodes(count: int, setup: NodeSetup, redis_url: str | None, folder: Path) -> Iterator[list[Node]]:
    """Starts `count` nodes and yields them when all are ready. Their logs go to `folder`."""
    with ExitStack() as stack:
        started = [_start(number, setup, redis_url, folder, stack) for number in range(count)]
        for number, (process, url, _) in enumerate(started):
            wait_until_ready(process, url, folder / f"node-{number}.log")
        nodes = [Node(process, url) for process, url, _ in started]
        for node in nodes:
            stack.callback(node.kill)
        for _, _, group in started:
            if group is not None and setup.cores is not None:
                group.limit(setup.cores)
        yield nodes


def _start(
    number: int, setup: NodeSetup, redis_url: str | None, folder: Path, stack: ExitStack
) -> tuple[subprocess.Popen[bytes], str, CpuGroup | None]:
    port = free_port()
    command: list[str | Path] = [LANESTREAM, "serve", "--provider", "cpu", "--port", str(port)]
    if setup.waiting_times is not None:
        command = [sys.executable, "-m", "capacity.waiting_node", setup.waiting_times, str(port)]
    # A single worker would have several threads, which the simulation does not model.
    variables = {"LANESTREAM_PROCESSES": str(setup.workers), "LANESTREAM_THREADS": "1"}
    variables["LANESTREAM_MAX_SESSIONS"] = "10000"
    if redis_url is not None:
        variables["LANESTREAM_REDIS_URL"] = redis_url
    environment = {**os.environ, **variables, "PYTHONPATH": os.pathsep.join(sys.path)}
    with (folder / f"node-{number}.log").open("w") as log:
        process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
    stack.callback(process.kill)
    if setup.cores is None:
        return process, f"http://127.0.0.1:{port}", None
    group = CpuGroup(str(number))
    group.take_precedence()
    # Before its workers exist: they start in the group of the process that starts them.
    group.add(process.pid)
    stack.callback(group.remove)
    return process, f"http://127.0.0.1:{port}", group


@contextmanager
def running_redis(folder: Path) -> Iterator[str]:
    """Starts a Redis that keeps nothing on disk, and yields its URL. Raises FileNotFoundError if it is missing."""
    executable = shutil.which("redis-server")
    if executable is None:
        raise FileNotFoundError("redis-server is not installed (on Debian: apt install redis-server)")
    port = free_port()
    command = [executable, "--port", str(port), "--bind", "127.0.0.1", "--save", "", "--dir", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        _wait_until_listening(process, port)
        yield f"redis://127.0.0.1:{port}/0"
    finally:
        process.terminate()
        process.wait()


def _wait_until_listening(process: subprocess.Popen[bytes], port: int) -> None:
    import redis

    end = time.monotonic() + _REDIS_S
    while time.monotonic() < end and process.poll() is None:
        with suppress(redis.ConnectionError), redis.Redis(port=port) as client:
            client.ping()
            return
        time.sleep(0.02)
    raise RuntimeError("redis-server did not start")
