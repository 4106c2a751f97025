"""Runs the application in this process: the listening socket, the loading of the networks, the life of the server."""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import cv2
import uvicorn

from lanestream.api.app import create_app
from lanestream.api.auth import warn_if_open
from lanestream.api.header_timeout import punctual
from lanestream.errors import SettingsError
from lanestream.logs import log_config
from lanestream.workers.ipc import Setup
from lanestream.workers.process_pool import ProcessPool
from lanestream.workers.thread_pool import ThreadPool

if TYPE_CHECKING:
    from fastapi import FastAPI

    from lanestream.api.service import Draw, Service
    from lanestream.engine import Engine
    from lanestream.settings import Settings
    from lanestream.workers.pool import WorkerPool

_log = logging.getLogger(__name__)
_BACKLOG: Final = 2048


def serve(settings: Settings, load: Callable[[], Engine], draw: Draw | None = None) -> None:
    """Serves until a signal ends it.

    `load` returns a warm engine. It is called while the service lives, in a thread or in worker processes, which have
    to be able to import it. Raises SettingsError where it can't listen, and what `load` raises.
    """
    # The pool of frame threads is the parallelism; OpenCV's own on top of it would have them fight for processors.
    cv2.setNumThreads(settings.opencv_threads)
    app = create_app(None, settings, draw)
    listener = listen(settings.host, settings.port)
    server = Server(app, settings)
    with suppress(KeyboardInterrupt), asyncio.Runner(loop_factory=server.config.get_loop_factory()) as runner:
        runner.run(_serve(server, listener, app, load))


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Raises SettingsError where the address can't be had."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0][0]
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise SettingsError(f"port {port} on {host} is in use", "choose another with --port") from None
        reason = (error.strerror or str(error)).partition(" (")[0].lower()
        raise SettingsError(f"can't listen on {host}, port {port}: {reason}", "see --host and --port") from None


def server_config(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """How uvicorn serves `app`: frames are JPEGs, so deflate would cost 20 times the work and save nothing."""
    return uvicorn.Config(
        app,
        http=punctual(settings.handshake_s),
        ws="websockets-sansio",
        # What is somewhat too large gets an error of its own; what is far too large costs the socket, not the session.
        ws_max_size=2 * settings.max_bytes,
        ws_per_message_deflate=False,
        log_config=log_config(settings),
    )


class Server(uvicorn.Server):
    """A uvicorn server that answers what it has taken before it stops."""

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        super().__init__(server_config(app, settings))
        self._service: Service = app.state.service

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drains the streams, then stops as uvicorn does: the other way round answers would meet closed sockets."""
        await self._service.drain()
        await super().shutdown(sockets)


async def _serve(server: uvicorn.Server, listener: socket.socket, app: FastAPI, load: Callable[[], Engine]) -> None:
    serving = asyncio.create_task(server.serve(sockets=[listener]))
    host, port = listener.getsockname()[:2]
    warn_if_open(app.state.service.authenticator, host, loopback=ipaddress.ip_address(host).is_loopback)
    _log.info("listening on http://%s:%d, loading the networks", f"[{host}]" if ":" in host else host, port)
    try:
        runner = await _runner(app.state.service, load)
        app.state.service.install(runner)
        for offer in runner.offers.all:
            network = offer.network
            _log.info("detector %s: %s on %s (%s)", offer.detector, network.name, network.provider, network.reason)
        _log.info("ready")
    except BaseException:
        server.should_exit = True
        await serving
        raise
    await serving


async def _runner(service: Service, load: Callable[[], Engine]) -> WorkerPool:
    """What works on frames, warm: worker processes, or threads of this one where the settings say so."""
    settings, observe = service.settings, service.metrics.batch
    if settings.processes == 0:
        return ThreadPool(await asyncio.to_thread(load), settings.image_limits, settings.threads_of(1), observe)
    setup = Setup(load, settings.image_limits, settings.opencv_threads, log_config(settings))
    return await ProcessPool.started(setup, settings.processes, settings.threads_of, observe)
