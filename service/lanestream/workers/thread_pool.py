"""Frames in threads of the service's own process."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

from lanestream.session import Session
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame, FrameWorker
from lanestream.workers.pool import Camera, Places, WorkerPool

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.images.decoding import ImageLimits
    from lanestream.inference.batcher import BatchReport
    from lanestream.messages import ProcessedFrame
    from lanestream.protocol import DetectorName


class ThreadPool(WorkerPool):
    """A frame has a thread of a small pool for its whole way; the questions of all sessions meet in one batcher.

    That is how a frame is worked on by one thread while a network answers another, on one device for all.
    """

    def __init__(
        self,
        engine: Engine,
        limits: ImageLimits,
        threads: int,
        observe: Callable[[BatchReport], None] | None = None,
    ) -> None:
        super().__init__(Capabilities.of(engine.pipelines), Places.of(1, threads), threads)
        self._engine = engine
        self._worker = FrameWorker(limits, observe)

    def open_camera(self, horizon: float | None = None, detector: DetectorName | None = None) -> Camera:
        """See `WorkerPool.open_camera`."""
        return self._engine.open_session(horizon, detector)

    async def close(self) -> None:
        """See `WorkerPool.close`."""
        await super().close()
        await asyncio.to_thread(self._worker.close)

    async def _run(self, camera: Camera, frame: EncodedFrame, *, crowded: bool) -> ProcessedFrame:
        assert isinstance(camera, Session)  # noqa: S101 - opened here
        return await self.work(self._worker.lanes, camera, frame, crowded=crowded)
