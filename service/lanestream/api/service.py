"""What all requests of a process share: its settings, its engine once that is loaded, its threads and its sessions."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lanestream.api.metrics import Metrics
from lanestream.errors import NotReadyError
from lanestream.protocol import Limits
from lanestream.sessions.manager import SessionManager
from lanestream.sessions.runner import FrameRunner

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.lanes import Image
    from lanestream.protocol import LanesMessage
    from lanestream.settings import Settings

Draw = Callable[["Image", "LanesMessage"], "Image"]


@dataclass(frozen=True)
class Loaded:
    """A warm engine and the threads that it runs in."""

    engine: Engine
    runner: FrameRunner


class Service:
    """The state of the application. Begins without an engine, because loading one takes seconds.

    `draw` paints lanes on an image for those who ask for a picture; None where the process can't draw.
    """

    def __init__(self, settings: Settings, draw: Draw | None = None) -> None:
        self.settings = settings
        self.draw = draw
        self.metrics = Metrics()
        self.sessions = SessionManager(settings.max_sessions)
        self._loaded: Loaded | None = None

    @property
    def loaded(self) -> Loaded:
        """The engine and its threads. Raises NotReadyError before `install`."""
        if self._loaded is None:
            raise NotReadyError("the networks are still being loaded", "ask /readyz, try again in a moment")
        return self._loaded

    @property
    def limits(self) -> Limits:
        """What clients are told of the limits."""
        settings = self.settings
        return Limits(max_bytes=settings.max_bytes, max_pixels=settings.max_pixels, credits=settings.credits)

    def install(self, engine: Engine) -> None:
        """Makes the service ready with a warm engine."""
        runner = FrameRunner(self.settings.image_limits, self.settings.threads, self.metrics.batch)
        for pipeline in engine.pipelines:
            self.metrics.loaded(pipeline)
        self._loaded = Loaded(engine, runner)

    async def close(self) -> None:
        """Stops being ready and ends the threads after what they are at."""
        loaded, self._loaded = self._loaded, None
        if loaded is not None:
            await asyncio.to_thread(loaded.runner.close)
