"""The contestants as processes: started, watched, stopped, and held still while others are measured."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import httpx
import psutil
from demo import LANESTREAM, free_port, stop

from bench.orders import Kind
from bench.plan import LITSERVE, NAIVE, SERVICE
from lanestream.detection.proposals import CandidateSearch
from lanestream.runtime import Provider

READY_S: Final = 120.0
# More than any plan has, so that the service's own limits are not what is measured; streams break off after each cell,
# and nobody comes back to resume them.
_SETTINGS: Final = {
    "LANESTREAM_MAX_SESSIONS": "10000",
    "LANESTREAM_FRAMES_PER_S": "100000",
    "LANESTREAM_BYTES_PER_S": "1e10",
    "LANESTREAM_RESUME_S": "1",
}


class Watched:
    """A process and its children: what they use, and whether they run."""

    def __init__(self, pid: int) -> None:
        self._root = psutil.Process(pid)

    def processor_seconds(self) -> float:
        """Processor time used so far, all threads and children together."""
        return sum(times.user + times.system for times in (process.cpu_times() for process in self._all()))

    def memory_mb(self) -> float:
        """Resident memory in MB; what processes share counts once where the system can tell."""
        sizes = [process.memory_full_info() for process in self._all()]
        return sum(getattr(size, "pss", size.rss) for size in sizes) / 1e6

    def suspend(self) -> None:
        """Takes the processors from them: a server that polls while it waits would slow the others down."""
        for process in self._all():
            process.suspend()

    def resume(self) -> None:
        """Gives them back."""
        for process in reversed(self._all()):
            process.resume()

    def end(self, ask: Callable[[], None] | None = None) -> None:
        """Kills them; those that are left of them where `ask` asks them to go by themselves."""
        processes = self._all()
        if ask is not None:
            ask()
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        psutil.wait_procs(processes)

    def _all(self) -> list[psutil.Process]:
        return [self._root, *self._root.children(recursive=True)] if self._root.is_running() else []


@dataclass(frozen=True)
class Program:
    """How a server is started, told when it is ready, and spoken to."""

    name: str
    kind: Kind
    arguments: Sequence[str | Path]
    ready: str
    place: str


def programs(provider: Provider) -> list[Program]:
    """The servers; the naive one judges as many candidates of a frame as ours does at most, of one in a stream."""
    python = (sys.executable, "-m")
    return [
        Program(SERVICE, "lanestream", (LANESTREAM, "serve", "--provider", provider), "/readyz", "ws:/v1/stream"),
        Program(
            NAIVE,
            "bare",
            (*python, "bench.naive", "--candidates", str(CandidateSearch.followed)),
            "/readyz",
            "ws:/stream",
        ),
        Program(LITSERVE, "http", (*python, "bench.lit", "--provider", provider), "/health", "http:/predict"),
    ]


class Server:
    """A server on a free port, on its way up; its log goes to a file in `folder`."""

    def __init__(self, program: Program, folder: Path) -> None:
        self.name = program.name
        self.kind = program.kind
        self._program = program
        self._log = folder / f"{program.name}.log"
        self.start()

    @property
    def url(self) -> str:
        """Where frames are sent."""
        scheme, _, path = self._program.place.partition(":")
        return f"{scheme}://127.0.0.1:{self._port}{path}"

    def restart(self) -> None:
        """Forgets what clients that are gone had asked for."""
        self.watched.end()
        self.start()
        self.wait_until_ready()

    def close(self) -> None:
        """Ends the server."""
        self.watched.resume()
        self.watched.end(ask=lambda: stop(self._process))

    def start(self) -> None:
        """Begins to start it."""
        self._port = free_port()
        with self._log.open("a") as log:
            self._process = subprocess.Popen(
                [*self._program.arguments, "--port", str(self._port)],
                env={**os.environ, **_SETTINGS, "PYTHONPATH": os.pathsep.join(sys.path)},
                stdout=log,
                stderr=log,
            )
        self.watched = Watched(self._process.pid)

    def wait_until_ready(self) -> None:
        """Returns when the networks are warm. Raises RuntimeError where the server does not come up."""
        end = time.monotonic() + READY_S
        while time.monotonic() < end and self._process.poll() is None:
            try:
                if httpx.get(f"http://127.0.0.1:{self._port}{self._program.ready}").is_success:
                    return
            except httpx.TransportError:
                pass
            time.sleep(0.1)
        raise RuntimeError(f"{self.name} did not come up, see {self._log}")
