"""The service under attack: a process of its own on a free port of 127.0.0.1, with two API keys."""

from __future__ import annotations

import asyncio
import os
import resource
import ssl
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import psutil
from demo import LANESTREAM, free_port, wait_until_ready

from lanestream.keys import new_key

_POLL_S: Final = 0.02
_OPEN_FILES: Final = 1024


@dataclass(frozen=True)
class Target:
    """A running service: its address, its process, and the API keys of the attacker and of the normal cameras.

    `environment` are the variables that it was started with; `log` is the file with its log. `payload` is what an
    attack prepared to send.
    """

    host: str
    port: int
    pid: int
    attacker_key: str = field(repr=False)
    camera_key: str = field(repr=False)
    environment: Mapping[str, str] = field(repr=False)
    log: Path
    payload: bytes = field(default=b"", repr=False)

    @property
    def url(self) -> str:
        """The URL of the service."""
        return f"{_scheme(self.environment)}://{self.host}:{self.port}"

    @property
    def tls(self) -> ssl.SSLContext | None:
        """How to connect to the service over TLS; None if it has no certificate."""
        return None if _scheme(self.environment) == "http" else unverified()

    def setting(self, name: str) -> str:
        """Returns a setting that the service was started with. Raises KeyError if it has its default."""
        return self.environment[f"LANESTREAM_{name.upper()}"]

    def processes(self) -> list[psutil.Process]:
        """Returns the service's process and its descendants; an empty list when it has ended."""
        with suppress(psutil.NoSuchProcess):
            service = psutil.Process(self.pid)
            if service.status() != psutil.STATUS_ZOMBIE:
                return [service, *service.children(recursive=True)]
        return []

    def workers(self) -> list[psutil.Process]:
        """Returns the worker processes."""
        return self.processes()[1:]

    def memory_mb(self) -> float:
        """Returns the resident memory of all its processes in MB."""
        total = 0
        for process in self.processes():
            with suppress(psutil.Error):
                total += process.memory_info().rss
        return total / 2**20

    async def ended_within(self, seconds: float) -> bool:
        """Waits for the end of the process, at most so long, and returns whether it has ended."""
        end = time.monotonic() + seconds
        while self.processes():
            if time.monotonic() >= end:
                return False
            await asyncio.sleep(_POLL_S)
        return True

    @contextmanager
    def replica(self) -> Iterator[Target]:
        """Runs a second service with the same settings and keys."""
        with _running(self.environment, self.log.with_suffix(".replica.log"), False) as (pid, port):
            yield Target(self.host, port, pid, self.attacker_key, self.camera_key, self.environment, self.log)


@contextmanager
def running_target(
    log: Path,
    settings: Mapping[str, object],
    environment: Mapping[str, str],
    *,
    unread_log: bool = False,
) -> Iterator[Target]:
    """Runs a service with `settings` and yields it once it is ready. All its processes are killed at the end.

    With `unread_log`, its log goes to a pipe that nobody reads instead of the file `log`.
    """
    (attacker_token, attacker), (camera_token, camera) = new_key("attacker"), new_key("camera")
    values = {"provider": "cpu", **settings, "api_keys": f"{attacker},{camera}"}
    variables = {**environment, **{f"LANESTREAM_{name.upper()}": str(value) for name, value in values.items()}}
    with _running(variables, log, unread_log) as (pid, port):
        yield Target("127.0.0.1", port, pid, attacker_token, camera_token, variables, log)


@contextmanager
def _running(environment: Mapping[str, str], log: Path, unread_log: bool) -> Iterator[tuple[int, int]]:
    port = free_port()
    with log.open("w") as file:
        output = subprocess.PIPE if unread_log else file
        command = [str(LANESTREAM), "serve", "--port", str(port)]
        process = subprocess.Popen(command, stdout=output, stderr=output, env={**os.environ, **environment})
    # As in most shells and service managers; this process may have raised its own limit.
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (min(_OPEN_FILES, most), most))
    try:
        wait_until_ready(process, f"{_scheme(environment)}://127.0.0.1:{port}", log, unverified())
        yield process.pid, port
    finally:
        _kill(process)


def unverified() -> ssl.SSLContext:
    """Returns how to connect over TLS, whatever certificate the service has."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def _scheme(environment: Mapping[str, str]) -> str:
    return "https" if "LANESTREAM_TLS_CERTIFICATE" in environment else "http"


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kills the service and its workers, stopped ones too."""
    descendants: list[psutil.Process] = []
    with suppress(psutil.NoSuchProcess):
        descendants = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    for each in descendants:
        with suppress(psutil.NoSuchProcess):
            each.kill()
    psutil.wait_procs(descendants, timeout=5.0)
    process.wait()
    for stream in (process.stdout, process.stderr):
        if stream is not None:
            stream.close()
