"""Where one proxy saturates: frames per second, new connections per second, and memory and files per stream.

A proxy that may use all of a machine can't be saturated by programs on the same one. So it gets a small share of a
processor, and the figures are multiplied.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil
import trustme
from demo import free_port

from capacity.cpu_group import CpuGroup
from capacity.nodes import process_cpu_s

# The share of a processor that the proxy gets.
SHARE: Final = 0.1
_STREAMS: Final = 20
_CONNECTING: Final = 16
_IDLE_STREAMS: Final = 400
# Proxies reserve two files for each, and refuse to start if they may not have so many.
_MOST_STREAMS: Final = 4096
# A proxy that used less of its share was not what limited the load.
_LEAST_USED: Final = 0.9
_START_S: Final = 10.0
_SETTLING_S: Final = 1.0
_REQUEST: Final = (
    b"GET /v1/stream HTTP/1.1\r\nHost: lanes.example.com\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)
_ANSWER: Final = (
    b"HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n\r\n"
)


@dataclass(frozen=True)
class ProxyLimits:
    """The figures of one proxy on one processor.

    `frames_per_s` and `megabytes_per_s` are in both directions together, and `connections_per_s` are new streams.
    `files_per_stream` and `kilobytes_per_stream` are those of the proxy.
    """

    proxy: str
    tls: bool
    frames_per_s: float
    megabytes_per_s: float
    connections_per_s: float
    files_per_stream: float
    kilobytes_per_stream: float


def installed_proxies() -> list[str]:
    """Returns the names of the proxies that are installed."""
    return [name for name in PROXIES if shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin")]


def measure_proxy(name: str, *, tls: bool, sizes: tuple[int, int], seconds: float, folder: Path) -> ProxyLimits:
    """Measures one proxy with messages of `sizes` bytes, a frame and its answer."""
    context = _write_certificate(folder) if tls else None
    with _backend(sizes) as backend, _proxy(name, backend, tls, folder) as (port, processes, group):
        files, memory = _files(processes), _memory(processes)
        with _idle_streams(port, context):
            files, memory = _files(processes) - files, _memory(processes) - memory
        group.limit(SHARE)
        load = _Load(port, context, sizes, seconds, processes)
        frames, connections = asyncio.run(load.run())
    return ProxyLimits(
        name,
        tls,
        frames / SHARE,
        1e-6 * frames / SHARE * sum(sizes),
        connections / SHARE,
        files / _IDLE_STREAMS,
        memory / 1e3 / _IDLE_STREAMS,
    )


class _Load:
    """Streams that send a frame after each answer, and then clients that only connect."""

    def __init__(
        self,
        port: int,
        context: ssl.SSLContext | None,
        sizes: tuple[int, int],
        seconds: float,
        processes: list[psutil.Process],
    ) -> None:
        self._port, self._context, self._sizes, self._seconds = port, context, sizes, seconds
        self._processes = processes
        self._count = 0

    async def run(self) -> tuple[float, float]:
        """Returns the frames that were answered per second, and the streams that were opened.

        Raises RuntimeError if the proxy was not what limited them.
        """
        frames = await self._count_for(self._stream, _STREAMS)
        return frames, await self._count_for(self._connect_again, _CONNECTING)

    async def _count_for(self, run: Callable[[], Coroutine[Any, Any, None]], tasks: int) -> float:
        running = [asyncio.create_task(run()) for _ in range(tasks)]
        await asyncio.sleep(_SETTLING_S)
        before, used_s, began = self._count, self._used_s(), time.monotonic()
        await asyncio.sleep(self._seconds)
        seconds = time.monotonic() - began
        rate, used = (self._count - before) / seconds, (self._used_s() - used_s) / seconds
        for task in running:
            task.cancel()
        results = await asyncio.gather(*running, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result
        if used < _LEAST_USED * SHARE:
            raise RuntimeError(f"the proxy used only {used:.2f} of a processor: something else was the limit")
        return rate

    def _used_s(self) -> float:
        return sum(process_cpu_s(process.pid) for process in self._processes)

    async def _open(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        host = "localhost" if self._context else None
        reader, writer = await asyncio.open_connection(
            "127.0.0.1", self._port, ssl=self._context, server_hostname=host, limit=1 << 20
        )
        writer.write(_REQUEST)
        head = await reader.readuntil(b"\r\n\r\n")
        if b" 101 " not in head.split(b"\r\n")[0]:
            raise RuntimeError(f"the proxy answered {head.split(bytes([13]))[0].decode(errors='replace')}")
        return reader, writer

    async def _stream(self) -> None:
        reader, writer = await self._open()
        frame, answer = bytes(self._sizes[0]), self._sizes[1]
        while True:
            writer.write(frame)
            await reader.readexactly(answer)
            self._count += 1

    async def _connect_again(self) -> None:
        while True:
            _, writer = await self._open()
            self._count += 1
            writer.transport.abort()


@contextmanager
def _idle_streams(port: int, context: ssl.SSLContext | None) -> Iterator[None]:
    """Opens streams that do nothing."""
    sockets: list[socket.socket] = []
    try:
        for _ in range(_IDLE_STREAMS):
            opened = socket.create_connection(("127.0.0.1", port), _START_S)
            if context is not None:
                opened = context.wrap_socket(opened, server_hostname="localhost")
            sockets.append(opened)
            opened.sendall(_REQUEST)
            while not opened.recv(1024).endswith(b"\r\n\r\n"):
                pass
        yield
    finally:
        for opened in sockets:
            opened.close()


@contextmanager
def _backend(sizes: tuple[int, int]) -> Iterator[int]:
    """Runs a server that accepts every stream and answers each frame by bytes, in a process of its own."""
    port = free_port()
    arguments = [str(each) for each in (port, *sizes)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-m", "capacity.proxies", *arguments], env=environment)
    try:
        _wait_until_listening(port, process)
        yield port
    finally:
        process.kill()
        process.wait()


class _Backend(asyncio.Protocol):
    def __init__(self, frame: int, answer: int) -> None:
        self._frame, self._answer = frame, bytes(answer)
        self._opened, self._received = False, 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)  # noqa: S101 - of a TCP server
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        if not self._opened:
            # The whole head comes at once.
            self._opened = True
            self._transport.write(_ANSWER)
            return
        self._received += len(data)
        while self._received >= self._frame:
            self._received -= self._frame
            self._transport.write(self._answer)


async def _serve(port: int, frame: int, answer: int) -> None:
    loop = asyncio.get_running_loop()
    server = await loop.create_server(lambda: _Backend(frame, answer), "127.0.0.1", port, backlog=2048)
    await server.serve_forever()


@contextmanager
def _proxy(name: str, backend: int, tls: bool, folder: Path) -> Iterator[tuple[int, list[psutil.Process], CpuGroup]]:
    """Runs a proxy with one worker before the backend. Yields its port and processes, and its control group."""
    port = free_port()
    path = folder / f"{name}.conf"
    path.write_text(PROXIES[name](port, backend, tls, folder.resolve()), encoding="utf-8")
    executable = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") or name
    option = "-c" if name == "nginx" else "-f"
    group = CpuGroup(name)
    process = subprocess.Popen([executable, option, path.resolve()], stderr=(folder / f"{name}.log").open("w"))
    try:
        group.add(process.pid)
        _wait_until_listening(port, process)
        tree = [psutil.Process(process.pid), *_children(process.pid)]
        for each in tree:
            group.add(each.pid)
        yield port, tree, group
    finally:
        children = _children(process.pid)
        process.kill()
        for child in children:
            with suppress(psutil.NoSuchProcess):
                child.kill()
        process.wait()
        psutil.wait_procs(children)
        group.remove()


def _wait_until_listening(port: int, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + _START_S
    while time.monotonic() < end and process.poll() is None:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        time.sleep(0.05)
    raise RuntimeError("a proxy or its backend did not start, see its log")


def _children(pid: int) -> list[psutil.Process]:
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def _files(processes: list[psutil.Process]) -> int:
    return sum(process.num_fds() for process in processes)


def _memory(processes: list[psutil.Process]) -> int:
    return sum(process.memory_full_info().uss for process in processes)


def _write_certificate(folder: Path) -> ssl.SSLContext:
    """Writes `proxy.pem` into the folder, and returns a context that trusts it."""
    authority = trustme.CA()
    authority.issue_cert("localhost").private_key_and_cert_chain_pem.write_to_path(folder / "proxy.pem")
    context = ssl.create_default_context()
    authority.configure_trust(context)
    return context


def _nginx(port: int, backend: int, tls: bool, folder: Path) -> str:
    certificate = f"ssl_certificate {folder}/proxy.pem; ssl_certificate_key {folder}/proxy.pem;" if tls else ""
    return f"""
daemon off; worker_processes 1; pid {folder}/nginx.pid; error_log stderr error;
events {{ worker_connections {2 * _MOST_STREAMS}; }}
http {{
    access_log off;
    map $http_upgrade $connection_upgrade {{ default upgrade; '' ''; }}
    server {{
        listen 127.0.0.1:{port} {"ssl" if tls else ""} backlog=2048; {certificate}
        location / {{
            proxy_pass http://127.0.0.1:{backend};
            proxy_http_version 1.1;
            proxy_set_header Upgrade $http_upgrade;
            proxy_set_header Connection $connection_upgrade;
            proxy_set_header Host $http_host;
            proxy_read_timeout 75s;
        }}
    }}
}}
"""


def _haproxy(port: int, backend: int, tls: bool, folder: Path) -> str:
    certificate = f"ssl crt {folder}/proxy.pem" if tls else ""
    return f"""
global
    nbthread 1
    maxconn {_MOST_STREAMS}
defaults
    mode http
    timeout connect 5s
    timeout client 30s
    timeout server 30s
    timeout tunnel 75s
frontend lanes
    bind 127.0.0.1:{port} {certificate} backlog 2048
    default_backend nodes
backend nodes
    server node 127.0.0.1:{backend}
"""


# The proxies that can be measured, and their configurations.
PROXIES: Final[dict[str, Callable[[int, int, bool, Path], str]]] = {"nginx": _nginx, "haproxy": _haproxy}


if __name__ == "__main__":
    # Its parent ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asyncio.run(_serve(*(int(each) for each in sys.argv[1:4])))
