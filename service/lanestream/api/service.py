"""What all requests of a process share: settings, the worker pool once it is ready, sessions and metrics."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, Protocol

from lanestream.api.auth import Authenticator
from lanestream.api.metrics import Metrics
from lanestream.api.request_body import BodyReader
from lanestream.errors import DrainingError, NotReadyError
from lanestream.protocol import Limits
from lanestream.streaming.session_registry import SessionRegistry
from lanestream.streaming.stores import open_store

if TYPE_CHECKING:
    from lanestream.protocol import LanesMessage
    from lanestream.road.view import Image
    from lanestream.settings import Settings
    from lanestream.workers.pool import WorkerPool

DrawLanes = Callable[["Image", "LanesMessage"], "Image"]

_DRAIN_POLL_S: Final = 0.02


class OpenStream(Protocol):
    """An open stream, as the service sees it."""

    def wake(self) -> None:
        """Makes the stream check whether the service is draining."""


class Service:
    """The state of the application. It starts without a worker pool, because loading the networks takes seconds.

    `draw` paints the lanes of a message on an image, for requests that ask for a picture; None if drawing is not
    available.
    """

    def __init__(self, settings: Settings, draw: DrawLanes | None = None) -> None:
        self.settings = settings
        self.draw = draw
        self.authenticator = Authenticator.from_settings(settings)
        self.metrics = Metrics()
        self.bodies = BodyReader(settings.max_bytes, settings.max_sessions, settings.body_s)
        self.streams: set[OpenStream] = set()
        self.draining = False
        redis_url = settings.redis_url
        self._store = open_store(None if redis_url is None else redis_url.get_secret_value())
        self.sessions = SessionRegistry(settings.session_limits, self._store)
        self._pool: WorkerPool | None = None

    @property
    def pool(self) -> WorkerPool:
        """The worker pool. Raises NotReadyError before `install`."""
        if self._pool is None:
            raise NotReadyError("the networks are still being loaded", "poll /readyz, and try again in a moment")
        return self._pool

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

    def install(self, pool: WorkerPool) -> None:
        """Makes the service ready with a warm worker pool."""
        for detector in pool.capabilities.detectors:
            self.metrics.loaded(detector)
        self.metrics.workers(lambda: pool.pids)
        self._pool = pool

    async def drain(self) -> None:
        """Accepts nothing new, notifies the streams and waits until every frame that was accepted is answered.

        Gives up after `drain_s` seconds of the settings.
        """
        self.draining = True
        for stream in self.streams:
            stream.wake()
        deadline = time.monotonic() + self.settings.drain_s
        while self.streams and time.monotonic() < deadline:
            await asyncio.sleep(_DRAIN_POLL_S)

    async def close(self) -> None:
        """Stops being ready, and ends threads and processes once they have finished their current work."""
        pool, self._pool = self._pool, None
        await self._store.close()
        if pool is not None:
            await pool.close()
