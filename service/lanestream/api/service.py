"""What all requests of a process share: settings, the worker pool once it is ready, sessions and metrics."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, Protocol

from lanestream.api.auth import Authenticator
from lanestream.api.byte_budget import ByteBudget
from lanestream.api.connections import ConnectionLimits, ConnectionTable, connection_of
from lanestream.api.metrics import Metrics
from lanestream.api.request_body import BodyLimits, BodyReader
from lanestream.api.tracing import open_tracer
from lanestream.asyncapi import document
from lanestream.errors import DrainingError, NotReadyError, SettingsError
from lanestream.logs import dropped_records
from lanestream.protocol import Limits, json_schemas, read_camera_file
from lanestream.session import SessionOptions
from lanestream.streaming.session_registry import SessionRegistry
from lanestream.streaming.stores import open_store

if TYPE_CHECKING:
    from starlette.requests import HTTPConnection

    from lanestream.protocol import LanesMessage, StartMessage
    from lanestream.road.view import Image
    from lanestream.settings import Settings
    from lanestream.streaming.session_registry import Caller
    from lanestream.workers.pool import WorkerPool

_log = logging.getLogger(__name__)

DrawLanes = Callable[["Image", "LanesMessage"], "Image"]

_DRAIN_POLL_S: Final = 0.02
# An idle connection is kept for this long between two requests.
_KEEP_ALIVE_S: Final = 5.0
# Room for messages besides frames: `start`, `end` and pongs.
_CONTROL_MESSAGES_PER_S: Final = 20.0
# uvicorn's variable: the proxies whose X-Forwarded-For headers are trusted.
_PROXIES_VARIABLE: Final = "FORWARDED_ALLOW_IPS"


class OpenStream(Protocol):
    """An open stream, as the service sees it."""

    def wake(self) -> None:
        """Makes the stream check whether it must end: the service may be draining, or the caller's key be gone."""

    def hand_over(self) -> bool:
        """Ends the stream as a drain does, so that its client resumes it on another replica.

        Returns False, and changes nothing, if its client could not resume it.
        """


class Service:
    """The state of the application. It starts without a worker pool, because loading the networks takes seconds.

    `draw` paints the lanes of a message on an image, for requests that ask for a picture; None if drawing is not
    available.
    """

    def __init__(self, settings: Settings, draw: DrawLanes | None = None) -> None:
        self.settings = settings
        self.draw = draw
        self.authenticator = Authenticator.from_settings(settings)
        self._camera = None if settings.camera is None else read_camera_file(settings.camera)
        self.metrics = Metrics()
        self.tracer = open_tracer()
        self.budget = ByteBudget(settings.buffered_bytes)
        self.proxies = os.environ.get(_PROXIES_VARIABLE, "")
        self.connections = ConnectionTable(
            _connection_limits(settings), self.budget, proxy_check(self.proxies), self.metrics.connection_cut
        )
        self.bodies = BodyReader(
            BodyLimits(settings.max_bytes, settings.body_s, settings.max_sessions, settings.sessions_per_caller),
            self.budget,
        )
        # Made once, since anyone may ask for them at any rate, and making them takes milliseconds.
        self.schemas = json.dumps(json_schemas())
        self.asyncapi = json.dumps(document())
        self.streams: set[OpenStream] = set()
        self.draining = False
        self._requests = 0
        redis_url = settings.redis_url
        self._store = open_store(None if redis_url is None else redis_url.get_secret_value())
        self.sessions = SessionRegistry(
            settings.session_limits, self._store, on_store_failure=self.metrics.store_failed
        )
        self._pool: WorkerPool | None = None

    @property
    def pool(self) -> WorkerPool:
        """The worker pool. Raises NotReadyError before `install`."""
        if self._pool is None:
            raise NotReadyError("the networks are still being loaded", "poll /readyz, and try again in a moment")
        return self._pool

    @property
    def store_name(self) -> str:
        """The kind of the session store."""
        return self._store.name

    @property
    def limits(self) -> Limits:
        """The limits reported to clients. Each field has the name of its setting."""
        return Limits.model_validate(self.settings, from_attributes=True)

    def check_ready(self) -> None:
        """Raises NotReadyError if no frame can be processed, and DrainingError if the service is about to stop."""
        if self.draining:
            raise DrainingError("the service is about to stop", "use another replica, or try again in a moment")
        if not self.pool.works:
            raise NotReadyError("the worker processes are restarting", "poll /readyz, and try again in a moment")

    def check_alive(self) -> None:
        """Raises NotReadyError if worker processes that end are no longer replaced."""
        if self._pool is not None and self._pool.upkeep_failed:
            raise NotReadyError("worker processes are no longer replaced", "restart the service; its log has the cause")

    def reload_keys(self) -> None:
        """Reads the file of API keys again. Streams of callers whose keys are gone end; a bad file changes nothing."""
        try:
            changed = self.authenticator.with_keys_of(self.settings)
        except SettingsError as error:
            _log.error("the API keys stay as they were: %s", error, extra={"event": "keys_refused"})
            return
        if changed == self.authenticator:
            return
        self.authenticator = changed
        count = len(changed.keys)
        _log.info("the API keys have changed: there are %d", count, extra={"event": "keys_changed", "keys": count})
        for stream in self.streams:
            stream.wake()

    def session_options(self, message: StartMessage) -> SessionOptions:
        """Returns the options of the session that `message` opens. Raises ProtocolError if they are contradictory."""
        camera = message.camera or self._camera
        if message.camera is None and camera is not None and message.horizon is not None:
            # The client's own horizon counts more than the pitch of the service's default camera.
            camera = camera.model_copy(update={"pitch": None})
        return SessionOptions.of(
            message.horizon,
            message.detector,
            camera,
            message.departure,
            self.settings.departure_settings,
            message.kinds or self.settings.kinds,
        )

    def install(self, pool: WorkerPool) -> None:
        """Makes the service ready with a warm worker pool."""
        for detector in pool.capabilities.detectors:
            self.metrics.loaded(detector)
        self.metrics.workers(lambda: pool.pids)
        self._pool = pool

    def sample_metrics(self) -> None:
        """Sets the metrics that are measured when they are read. To be called in the event loop."""
        self.metrics.sample(
            tasks=len(asyncio.all_tasks()),
            connections=len(self.connections),
            buffered=self.budget.used,
            store_reachable=self.sessions.store_reachable,
            log_drops=dropped_records(),
        )

    @contextmanager
    def answering(self, request: HTTPConnection, caller: Caller) -> Iterator[None]:
        """Makes `drain` wait for the request that is answered in the block, and keeps its connection open."""
        connection = connection_of(request.scope)
        self._requests += 1
        if connection is not None:
            connection.identify(caller.quota)
            connection.protect()
        try:
            yield
        finally:
            self._requests -= 1
            if connection is not None:
                connection.unprotect()

    def hand_over(self, count: int) -> int:
        """Makes up to `count` streams continue on other replicas, and returns how many."""
        handed_over = 0
        for stream in tuple(self.streams):
            if handed_over >= count:
                break
            handed_over += stream.hand_over()
        return handed_over

    async def drain(self) -> None:
        """Accepts nothing new, notifies the streams and waits until every frame that was accepted is answered.

        Gives up after `drain_s` seconds of the settings.
        """
        self.draining = True
        for stream in self.streams:
            stream.wake()
        deadline = time.monotonic() + self.settings.drain_s
        while (self.streams or self._requests) and time.monotonic() < deadline:
            await asyncio.sleep(_DRAIN_POLL_S)

    async def close(self) -> None:
        """Stops being ready, and ends threads and processes once they have finished their current work."""
        pool, self._pool = self._pool, None
        await self.sessions.stop()
        await self._store.close()
        if pool is not None:
            await pool.close()
        if self.tracer is not None:
            await self.tracer.close()


def proxy_check(proxies: str) -> Callable[[str], bool]:
    """Returns a function that says whether an address is in `proxies`: addresses and networks, or `*` for all.

    Names, which uvicorn accepts for Unix sockets, match no address.
    """
    entries = [entry.strip() for entry in proxies.split(",") if entry.strip()]
    networks = []
    for entry in entries:
        with suppress(ValueError):
            networks.append(ipaddress.ip_network(entry, strict=False))

    def is_proxy(address: str) -> bool:
        if "*" in entries:
            return True
        try:
            ip = ipaddress.ip_address(address)
        except ValueError:
            return False
        return any(ip in network for network in networks)

    return is_proxy


def _connection_limits(settings: Settings) -> ConnectionLimits:
    return ConnectionLimits(
        connections=settings.connections,
        # The others are left to sessions.
        without_session=max(settings.connections - settings.max_sessions, settings.connections // 2),
        per_address=settings.connections_per_address,
        head_s=settings.handshake_s,
        body_s=settings.body_s,
        send_s=settings.send_s,
        keep_alive_s=_KEEP_ALIVE_S,
        # Each frame may be two messages, and each message counts as four.
        messages_per_s=4.0 * (2.0 * settings.frames_per_s + _CONTROL_MESSAGES_PER_S),
    )
