"""Runs the application in this process: opens the socket, starts the server and loads the networks."""

from __future__ import annotations

import asyncio
import errno
import gc
import ipaddress
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, Final

import cv2
import uvicorn

from lanestream.api.app import create_app
from lanestream.api.auth import warn_if_open
from lanestream.api.file_watch import FileWatch
from lanestream.api.http_connection import HttpConnection
from lanestream.api.tls import Certificate, TlsProtocol
from lanestream.api.websocket_connection import WebSocketConnection
from lanestream.errors import SettingsError
from lanestream.host import keep_freed_memory, raise_open_files, return_freed_memory
from lanestream.logs import flush_logs, log_config
from lanestream.packages import package_conflicts
from lanestream.workers.ipc import WorkerSetup
from lanestream.workers.process_pool import ProcessPool
from lanestream.workers.thread_pool import ThreadPool

if TYPE_CHECKING:
    from fastapi import FastAPI

    from lanestream.api.service import DrawLanes, Service
    from lanestream.engine import Engine
    from lanestream.settings import Settings
    from lanestream.workers.pool import WorkerPool

_log = logging.getLogger(__name__)
_BACKLOG: Final = 2048
_LARGEST_KEPT_BYTES: Final = 1 << 20
_RETURN_MEMORY_S: Final = 10.0
_FILES_POLL_S: Final = 1.0
# Files that the process needs besides its connections: models, pipes to workers, Redis, logs.
_OTHER_FILES: Final = 128
# After a drain, how long uvicorn waits for peers to close their connections.
_CLOSE_S: Final = 0.5
# What shells add to the number of the signal by which a process ended.
_SIGNALED: Final = 128


def serve(
    settings: Settings,
    load: Callable[[], Engine],
    draw: DrawLanes | None = None,
    on_ready: Callable[[str], None] | None = None,
) -> None:
    """Serves until a signal stops the process.

    `load` returns a warm engine. It is called once the server is running, in a thread or in worker processes, which
    must be able to import it. `on_ready` is called once frames can be processed, in a thread, with a URL that reaches
    the service from this machine. Raises SettingsError if the address can't be listened on, and any error of `load`.
    """
    tune_process(settings)
    app = create_app(None, settings, draw)
    listener = listen(settings.host, settings.port)
    server = LanestreamServer(app, settings)
    app.state.service.connections.fit(raise_open_files() - _OTHER_FILES)
    with server.stopping_on_signals(), asyncio.Runner(loop_factory=server.config.get_loop_factory()) as runner:
        runner.run(_serve(server, listener, app, load, on_ready))


def tune_process(settings: Settings) -> None:
    """Sets how this process uses processors and memory; to be called before it gets its first image."""
    # Frames already run in parallel; OpenCV's own threads would compete with them for the processors.
    cv2.setNumThreads(settings.opencv_threads)
    # Images and messages of a few megabytes come and go, and must not add up.
    keep_freed_memory(_LARGEST_KEPT_BYTES)


def listen(host: str, port: int) -> socket.socket:
    """Returns a listening socket. Raises SettingsError if the address can't be listened on."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0][0]
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise SettingsError(f"port {port} on {host} is in use", "choose another with --port") from None
        reason = (error.strerror or str(error)).partition(" (")[0].lower()
        raise SettingsError(f"can't listen on {host}, port {port}: {reason}", "check --host and --port") from None


def server_config(app: FastAPI, settings: Settings, certificate: Certificate | None = None) -> uvicorn.Config:
    """Returns the uvicorn configuration for `app`."""
    service: Service = app.state.service
    protocol = HttpConnection if certificate is None else partial(TlsProtocol, certificate)
    return uvicorn.Config(
        app,
        http=partial(protocol, service.connections),  # type: ignore[arg-type]
        ws=WebSocketConnection,
        # An image above `max_bytes` costs only that frame. A far larger message closes the socket, not the session.
        ws_max_size=2 * settings.max_bytes,
        # Frames are compressed images: deflate would multiply the work and save nothing.
        ws_per_message_deflate=False,
        # Without proxies, no header may change the address of a caller.
        proxy_headers=bool(service.proxies),
        forwarded_allow_ips=service.proxies or None,
        timeout_graceful_shutdown=2.0 * _CLOSE_S,  # type: ignore[arg-type]
        log_config=log_config(settings),
    )


class LanestreamServer(uvicorn.Server):
    """A uvicorn server that answers the frames it has accepted before it stops."""

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        self._service: Service = app.state.service
        self.watches = watched_keys(self._service)
        self.certificate: Certificate | None = None
        if settings.tls_certificate is not None:
            self.certificate = certificate = Certificate(settings.tls_certificate, settings.tls_key)
            self.watches.append(FileWatch(certificate.files, certificate.reload))
            self._service.metrics.certificate(lambda: certificate.expires_at)
        super().__init__(server_config(app, settings, self.certificate))
        self._reload_requested = False

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leaves the signals to `stopping_on_signals`, which holds for the start and the end of the process, too."""
        yield

    @contextmanager
    def stopping_on_signals(self) -> Iterator[None]:
        """Stops the server on SIGINT, SIGTERM or SIGHUP; ends the process at once on a second SIGINT or SIGTERM.

        With a file of API keys or a certificate, SIGHUP reads them again instead, as is usual for services.

        After the block the process ends by the first of them, so that its parent sees why it ended.
        """
        received: list[int] = []

        def stop(number: int, _: FrameType | None) -> None:
            if number == signal.SIGHUP and self.watches:
                self._reload_requested = True
                return
            if received and number != signal.SIGHUP:
                flush_logs()
                os._exit(_SIGNALED + number)
            received.append(number)
            self.should_exit = True

        handled: list[signal.Signals] = []
        if threading.current_thread() is threading.main_thread():
            handled += [signal.SIGINT, signal.SIGTERM]
            # A terminal that is closed sends it. A process that was started to ignore it, by nohup, goes on.
            handled += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else []
        before = {number: signal.signal(number, stop) for number in handled}
        try:
            yield
        finally:
            flush_logs()
            for number, handler in before.items():
                signal.signal(number, handler)
        if received and received[0] != signal.SIGINT:
            signal.raise_signal(received[0])

    def take_reload_request(self) -> bool:
        """Returns whether SIGHUP has asked for the files of keys and certificates since the last call."""
        requested, self._reload_requested = self._reload_requested, False
        return requested

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drains the streams, then shuts uvicorn down, which closes the sockets."""
        await self._service.drain()
        # Before uvicorn's own limit, which would cancel what still sends to them.
        asyncio.get_running_loop().call_later(_CLOSE_S, self._service.connections.abort_all)
        await super().shutdown(sockets)


async def _serve(
    server: LanestreamServer,
    listener: socket.socket,
    app: FastAPI,
    load: Callable[[], Engine],
    on_ready: Callable[[str], None] | None,
) -> None:
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    host, port = listener.getsockname()[:2]
    warn_if_open(app.state.service.authenticator, host, loopback=ipaddress.ip_address(host).is_loopback)
    for conflict in package_conflicts():
        _log.warning("%s", conflict)
    scheme = "http" if server.certificate is None else "https"
    url = _http_url(scheme, host, port)
    _log.info("listening on %s, loading the networks", url, extra={"event": "listening", "url": url})
    starting = asyncio.create_task(start_pool(app.state.service, load))
    await asyncio.wait([starting, serving], return_when=asyncio.FIRST_COMPLETED)
    if not starting.done():  # a signal came first
        starting.cancel()
        await asyncio.wait([starting])
        return
    try:
        pool = starting.result()
        app.state.service.install(pool)
        for info in pool.capabilities.detectors:
            network = info.model
            _log.info(
                "detector %s: %s on %s (%s)",
                *(info.detector, network.name, network.provider, network.reason),
                extra={
                    "event": "detector_loaded",
                    "detector": info.detector,
                    "model": network.name,
                    "provider": network.provider,
                },
            )
        _log.info("ready", extra={"event": "ready"})
        if on_ready is not None:
            address = ipaddress.ip_address(host)
            loopback = "127.0.0.1" if address.version == 4 else "::1"
            reachable = loopback if address.is_unspecified else host
            # A daemon: what it starts, such as a browser in a terminal, may go on for as long as it likes.
            threading.Thread(target=on_ready, args=(_http_url(scheme, reachable, port),), daemon=True).start()
    except BaseException:
        server.should_exit = True
        await serving
        raise
    upkeep = start_upkeep(server.watches, server.take_reload_request)
    await serving
    for task in upkeep:
        task.cancel()


def watched_keys(service: Service) -> list[FileWatch]:
    """Returns what reads the file of API keys again when it has changed; nothing without such a file."""
    path = service.settings.api_keys_file
    return [] if path is None else [FileWatch([path], service.reload_keys)]


def start_upkeep(watches: Sequence[FileWatch], take_reload_request: Callable[[], bool]) -> list[asyncio.Task[None]]:
    """Starts the background tasks of a process that serves. Cancel them at its end.

    `take_reload_request` returns whether the files must be read again although they did not change.
    """
    tasks = [asyncio.create_task(_return_memory())]
    if watches:
        tasks.append(asyncio.create_task(_watch_files(watches, take_reload_request)))
    return tasks


async def _watch_files(watches: Sequence[FileWatch], take_reload_request: Callable[[], bool]) -> None:
    while True:
        await asyncio.sleep(_FILES_POLL_S)
        requested = take_reload_request()
        for watch in watches:
            watch.check(await asyncio.to_thread(watch.versions), force=requested)


def _http_url(scheme: str, host: str, port: int) -> str:
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"


async def _return_memory() -> None:
    """Gives the memory of closed connections back to the system from time to time.

    Python finds what refers to itself, like a connection and its tasks, only when many new objects have been made,
    however large they are. What exists now is left out, so that looking takes a few milliseconds.
    """
    gc.freeze()
    while True:
        await asyncio.sleep(_RETURN_MEMORY_S)
        gc.collect()
        return_freed_memory()


async def start_pool(service: Service, load: Callable[[], Engine]) -> WorkerPool:
    """Returns a warm worker pool: worker processes, or threads of this process if the settings ask for that."""
    settings, metrics = service.settings, service.metrics
    if settings.processes == 0:
        engine = await asyncio.to_thread(load)
        return ThreadPool(engine, settings.image_limits, settings.threads_per_process(1), metrics.batch)
    return await ProcessPool.start(
        WorkerSetup(load, settings.image_limits, settings.opencv_threads, log_config(settings)),
        settings.processes,
        settings.threads_per_process,
        observe=metrics.batch,
        observe_worker=metrics.worker_event,
    )
