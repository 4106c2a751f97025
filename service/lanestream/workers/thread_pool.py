"""Processes frames in threads of the service's own process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

from lanestream.session import DEFAULT_SESSION, Session, SessionOptions
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame, FrameWorker
from lanestream.workers.pool import SessionHandle, WorkerPool

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.images.decoding import ImageLimits
    from lanestream.inference.batcher import BatchReport
    from lanestream.messages import ProcessedFrame
    from lanestream.workers.admission import Slot


class ThreadPool(WorkerPool):
    """Each frame has one thread of a small pool; the inference requests of all sessions go to one batcher.

    So one thread processes a frame while a network runs on the frames of others.
    """

    def __init__(
        self,
        engine: Engine,
        limits: ImageLimits,
        threads: int,
        observe: Callable[[BatchReport], None] | None = None,
    ) -> None:
        super().__init__(Capabilities.of(engine), 1, threads, threads)
        self._engine = engine
        self._worker = FrameWorker(engine.models, limits, observe)

    def open_session(self, options: SessionOptions = DEFAULT_SESSION) -> SessionHandle:
        """Returns a new camera's session, see `WorkerPool.open_session`."""
        return self._engine.open_session(options)

    async def run(self, session: SessionHandle, frame: EncodedFrame, slot: Slot) -> ProcessedFrame:
        """Returns the lanes of `frame`, see `WorkerPool.run`."""
        assert isinstance(session, Session)  # noqa: S101 - opened here
        return await self.in_thread(self._worker.process, session, frame, slot.charge)

    async def close(self) -> None:
        """Ends the threads after their current work."""
        await super().close()
        await asyncio.to_thread(self._worker.close)
