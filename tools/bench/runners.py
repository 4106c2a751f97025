"""The processes of the benchmark: servers, and helper processes that generate load or run the pipeline themselves."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Final

import httpx
import psutil
from demo import LANESTREAM, free_port, stop

from bench.workload import BASELINE, LITSERVE, SERVICE, LoadRequest, LoadResult, Transport
from lanestream.detection.proposals import MOST_WITH_TRACKS

READY_S: Final = 120.0
# More than any suite needs, so that the service's own limits are not measured. Streams break off after each workload
# and are never resumed.
_SETTINGS: Final = {
    "LANESTREAM_MAX_SESSIONS": "10000",
    "LANESTREAM_FRAMES_PER_S": "100000",
    "LANESTREAM_BYTES_PER_S": "1e10",
    "LANESTREAM_RESUME_S": "1",
}


class ProcessTree:
    """A process and its children: what they use, and whether they run."""

    def __init__(self, pid: int) -> None:
        self._root = psutil.Process(pid)

    def cpu_seconds(self) -> float:
        """Returns the CPU time used so far, of all threads and children together."""
        return sum(times.user + times.system for times in (process.cpu_times() for process in self._all()))

    def memory_mb(self) -> float:
        """Returns the memory in MB: the proportional set size, or the resident size if the system has no other."""
        sizes = [process.memory_full_info() for process in self._all()]
        return sum(getattr(size, "pss", size.rss) for size in sizes) / 1e6

    def suspend(self) -> None:
        """Stops all processes: a server that polls while it waits would slow down the others."""
        for process in self._all():
            process.suspend()

    def resume(self) -> None:
        """Continues all processes."""
        for process in reversed(self._all()):
            process.resume()

    def end(self, terminate: Callable[[], None] | None = None) -> None:
        """Kills all processes, or those that are left after `terminate`."""
        processes = self._all()
        if terminate is not None:
            terminate()
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs(processes)

    def _all(self) -> list[psutil.Process]:
        return [self._root, *self._root.children(recursive=True)] if self._root.is_running() else []


@dataclass(frozen=True)
class ServerProgram:
    """How to start a server, where it reports that it is ready, and where and how it takes frames.

    `environment` is added to that of this process.
    """

    name: str
    transport: Transport
    command: Sequence[str | Path]
    ready_path: str
    scheme: str
    path: str
    environment: Mapping[str, str] = field(default_factory=dict)


def server_programs(provider: str) -> list[ServerProgram]:
    """Returns the servers that can run here: LitServe only if it is installed.

    The baseline classifies as many candidates per frame as our service does at most in a stream.
    """
    python = (sys.executable, "-m")
    service = (LANESTREAM, "serve", "--provider", provider)
    baseline = (*python, "bench.baseline_service", "--candidates", str(MOST_WITH_TRACKS))
    litserve = (*python, "bench.litserve_service", "--provider", provider)
    programs = [
        ServerProgram(SERVICE, "lanestream", service, "/readyz", "ws", "/v1/stream"),
        ServerProgram(BASELINE, "websocket", baseline, "/readyz", "ws", "/stream"),
    ]
    if litserve_installed():
        programs.append(ServerProgram(LITSERVE, "http", litserve, "/health", "http", "/predict"))
    return programs


def litserve_installed() -> bool:
    """Returns whether LitServe is installed."""
    return find_spec("litserve") is not None


class Server:
    """A server on a free port. Its log goes to a file in `folder`."""

    def __init__(self, program: ServerProgram, folder: Path) -> None:
        self.name = program.name
        self.transport = program.transport
        self._program = program
        self._log = folder / f"{program.name}.log"
        self.start()

    @property
    def url(self) -> str:
        """The URL for frames."""
        return f"{self._program.scheme}://127.0.0.1:{self._port}{self._program.path}"

    def restart(self) -> None:
        """Restarts the server, so that it drops the work for clients that are gone."""
        self.processes.end()
        self.start()
        self.wait_until_ready()

    def close(self) -> None:
        """Ends the server."""
        self.processes.resume()
        self.processes.end(terminate=lambda: stop(self._process))

    def start(self) -> None:
        """Starts the server's process, without waiting until it is ready."""
        self._port = free_port()
        with self._log.open("a") as log:
            self._process = subprocess.Popen(
                [*self._program.command, "--port", str(self._port)],
                env={**os.environ, **_SETTINGS, **self._program.environment, "PYTHONPATH": os.pathsep.join(sys.path)},
                stdout=log,
                stderr=log,
            )
        self.processes = ProcessTree(self._process.pid)

    def wait_until_ready(self) -> None:
        """Returns when the networks are warm. Raises RuntimeError if the server does not get ready."""
        end = time.monotonic() + READY_S
        while time.monotonic() < end and self._process.poll() is None:
            try:
                if httpx.get(f"http://127.0.0.1:{self._port}{self._program.ready_path}").is_success:
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.1)
        raise RuntimeError(f"the server `{self.name}` did not get ready, see {self._log}")


class HelperProcess:
    """A process that runs loads: a load generator, or the process with the in-process runners.

    Over a pipe it sends a first message when it is ready, then takes a LoadRequest, sends None when every session has
    had a reply, takes None to stop, and sends a LoadResult. A string from it is an error.
    """

    def __init__(self, process: SpawnProcess, pipe: Connection) -> None:
        self._process = process
        self._pipe = pipe

    @property
    def pid(self) -> int:
        """The process id."""
        assert self._process.pid is not None  # noqa: S101 - it was started
        return self._process.pid

    def wait_until_ready(self) -> Any:
        """Returns the first message."""
        return self._receive()

    def start_load(self, request: LoadRequest) -> None:
        """Starts a load."""
        self._pipe.send(request)

    def wait_until_settled(self, seconds: float) -> bool:
        """Returns whether every session had a reply within some seconds. Raises RuntimeError if a session broke."""
        return self._pipe.poll(max(0.0, seconds)) and self._receive() is None

    def stop_load(self) -> LoadResult:
        """Stops the load and returns all its replies, including those from before it was settled."""
        self._pipe.send(None)
        while (result := self._receive()) is None:
            pass
        assert isinstance(result, LoadResult)  # noqa: S101 - the only other message
        return result

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.join()

    def _receive(self) -> Any:
        try:
            message = self._pipe.recv()
        except EOFError:
            raise RuntimeError("a helper process died") from None
        if isinstance(message, str):
            raise RuntimeError(message)
        return message
