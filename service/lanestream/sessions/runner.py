"""The way of a frame through the threads, so that the event loop never decodes, proposes, infers or tracks.

A small pool does what OpenCV and numpy do, a glance of the regressor among it; one thread of its own runs the network
between the halves of a detector, because one network on one device gains nothing from being run twice at a time.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, ParamSpec, TypeVar

from lanestream.imaging import ImageLimits, decode
from lanestream.messages import ProcessedFrame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from lanestream.detection import Prepared
    from lanestream.lanes import FrameResult, Image
    from lanestream.sessions.session import Session

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class Timed(Generic[T]):
    """What a step returned, and when it ran, in monotonic seconds."""

    value: T
    started: float
    ended: float

    @property
    def ms(self) -> float:
        """How long the step took."""
        return 1e3 * (self.ended - self.started)


class FrameRunner:
    """Takes encoded frames to their lanes; the frames of one session one at a time, those of different ones at once."""

    def __init__(self, limits: ImageLimits, threads: int) -> None:
        self._limits = limits
        self._workers = ThreadPoolExecutor(threads, thread_name_prefix="lanestream-frames")
        self._inference = ThreadPoolExecutor(1, thread_name_prefix="lanestream-inference")

    async def run(self, session: Session, data: bytes, timestamp: float, arrived: float) -> ProcessedFrame:
        """The lanes of the image file in `data`, captured at `timestamp`, come at `arrived` (time.monotonic()).

        Raises ImageError where the file is refused; the session is then as it was before.
        """
        decoded = await self._timed(self._workers, decode, data, self._limits)
        prepared = await self._timed(self._workers, session.prepare, decoded.value)
        outputs = await self._timed(self._inference, session.network.run, prepared.value.inputs)
        result = await self._timed(self._workers, session.conclude, prepared.value, outputs.value, timestamp)
        timing = _timing(decoded, prepared, outputs, result, arrived)
        return ProcessedFrame(decoded.value, replace(result.value, timing_ms=timing))

    async def work(self, step: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `step` returns, run in the pool."""
        return (await self._timed(self._workers, step, *args, **kwargs)).value

    def close(self) -> None:
        """Ends the threads after what they are at."""
        self._workers.shutdown(cancel_futures=True)
        self._inference.shutdown(cancel_futures=True)

    @staticmethod
    async def _timed(threads: ThreadPoolExecutor, step: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Timed[T]:
        def timed() -> Timed[T]:
            started = time.monotonic()
            value = step(*args, **kwargs)
            return Timed(value, started, time.monotonic())

        return await asyncio.get_running_loop().run_in_executor(threads, timed)


def _timing(
    decoded: Timed[Image],
    prepared: Timed[Prepared],
    outputs: Timed[NDArray[np.float32]],
    result: Timed[FrameResult],
    arrived: float,
) -> dict[str, float]:
    stages = {"decode": decoded.ms, "propose": prepared.ms, "infer": outputs.ms, "track": result.ms}
    total = 1e3 * (result.ended - arrived)
    return {**stages, "queue": max(0.0, total - sum(stages.values())), "total": total}
