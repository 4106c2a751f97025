"""What all requests of a process share: its settings, what works on frames once that is ready, and its sessions."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from lanestream.api.auth import Authenticator
from lanestream.api.metrics import Metrics
from lanestream.api.request_body import BodyReader
from lanestream.errors import DrainingError, NotReadyError
from lanestream.protocol import Limits
from lanestream.streaming.session_registry import SessionRegistry
from lanestream.streaming.store import MemoryStore, SessionStore

if TYPE_CHECKING:
    from lanestream.api.websocket import StreamHandler
    from lanestream.protocol import LanesMessage
    from lanestream.road.view import Image
    from lanestream.settings import Settings
    from lanestream.workers.pool import WorkerPool

Draw = Callable[["Image", "LanesMessage"], "Image"]

_DRAIN_STEP_S: Final = 0.02


class Service:
    """The state of the application. Begins without a runner, because loading networks takes seconds.

    `draw` paints lanes on an image for those who ask for a picture; None where the process can't draw.
    """

    def __init__(self, settings: Settings, draw: Draw | None = None) -> None:
        self.settings = settings
        self.draw = draw
        self.authenticator = Authenticator.of(settings)
        self.metrics = Metrics()
        self.bodies = BodyReader(settings.max_bytes, settings.max_sessions, settings.body_s)
        self.streams: set[StreamHandler] = set()
        self.draining = False
        self._store = _store(settings)
        self.sessions = SessionRegistry(settings.session_limits, self._store)
        self._runner: WorkerPool | None = None

    @property
    def runner(self) -> WorkerPool:
        """What works on frames. Raises NotReadyError before `install`."""
        if self._runner is None:
            raise NotReadyError("the networks are still being loaded", "ask /readyz, try again in a moment")
        return self._runner

    @property
    def limits(self) -> Limits:
        """What clients are told of the limits, each by the name of its setting."""
        return Limits.model_validate(self.settings, from_attributes=True)

    def check_open(self) -> None:
        """Raises NotReadyError where no frame can be worked on, DrainingError where nothing new is taken any more."""
        if self.draining:
            raise DrainingError("the service is about to stop", "ask another replica, or again in a moment")
        if not self.runner.works:
            raise NotReadyError("the worker processes are being started again", "ask /readyz, try again in a moment")

    def install(self, runner: WorkerPool) -> None:
        """Makes the service ready with a warm runner."""
        for offer in runner.offers.all:
            self.metrics.loaded(offer)
        self.metrics.workers(lambda: runner.pids)
        self._runner = runner

    async def drain(self) -> None:
        """Takes nothing new, tells the streams, and waits until all frames that came before are answered.

        What is not answered within the setting `drain_s` is given up.
        """
        self.draining = True
        for stream in self.streams:
            stream.wake()
        ends = time.monotonic() + self.settings.drain_s
        while self.streams and time.monotonic() < ends:
            await asyncio.sleep(_DRAIN_STEP_S)

    async def close(self) -> None:
        """Stops being ready and ends threads and processes after what they are at."""
        runner, self._runner = self._runner, None
        await self._store.close()
        if runner is not None:
            await runner.close()


def _store(settings: Settings) -> SessionStore:
    """Where the service keeps sessions. Raises SettingsError for a URL that is none."""
    if settings.redis_url is None:
        return MemoryStore()
    # Only who has replicas needs the package.
    from lanestream.streaming.redis_store import RedisStore

    return RedisStore(settings.redis_url.get_secret_value())
