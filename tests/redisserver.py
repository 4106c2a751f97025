"""A real Redis on a free port, which can be restarted. It needs `redis-server`."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import fakes
import pytest


class RedisServer:
    """A Redis that keeps nothing on disk. It closes connections that are idle for `idle_s` seconds, unless 0."""

    def __init__(self, folder: Path, idle_s: int = 0) -> None:
        executable = shutil.which("redis-server")
        if executable is None:
            pytest.fail("redis-server is not installed (on Debian: apt install redis-server)")
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port: int = free.getsockname()[1]
        self.url = f"redis://127.0.0.1:{self.port}/0"
        options = {"port": self.port, "bind": "127.0.0.1", "save": "", "appendonly": "no", "dir": folder}
        options["timeout"] = idle_s
        self._command = [executable, *(part for name, value in options.items() for part in (f"--{name}", str(value)))]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Starts it, without any sessions, and waits until it answers."""
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL)
        end = time.monotonic() + fakes.WAIT_S
        while time.monotonic() < end:
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0) as connection:
                connection.sendall(b"PING\r\n")
                if connection.recv(16).startswith(b"+PONG"):
                    return
            time.sleep(0.01)
        pytest.fail("redis-server did not start")

    def stop(self) -> None:
        """Ends it. Its sessions are lost."""
        if self._process is not None:
            # It would not end on SIGTERM if it could not save its data.
            self._process.kill()
            self._process.wait()


@contextmanager
def running_redis(folder: Path, idle_s: int = 0) -> Iterator[RedisServer]:
    """Starts a Redis and yields it."""
    server = RedisServer(folder, idle_s)
    try:
        server.start()
        yield server
    finally:
        server.stop()


@contextmanager
def redis_server(folder: Path) -> Iterator[str]:
    """Starts a Redis and yields its URL."""
    with running_redis(folder) as server:
        yield server.url
