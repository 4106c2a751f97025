"""The way of a frame through the threads, so that the event loop never decodes, proposes, infers or tracks.

A small pool does what OpenCV and numpy do; what a frame asks the networks goes to the batcher, where the questions of
all sessions meet.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ParamSpec, TypeVar

from lanestream.errors import ExpiredError
from lanestream.imaging import ImageLimits, decode
from lanestream.inference.batcher import Batcher, BatchReport
from lanestream.messages import ProcessedFrame
from lanestream.sessions.walk import FrameWalk

if TYPE_CHECKING:
    from lanestream.detection import Question
    from lanestream.lanes import Image
    from lanestream.sessions.session import Session

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class EncodedFrame:
    """An image file, when it was captured (the client's seconds) and when it came (monotonic seconds).

    After `deadline` (monotonic seconds) nobody wants its lanes any more; None: always.
    """

    data: bytes
    timestamp: float
    arrived: float
    deadline: float | None = None


@dataclass(frozen=True)
class _Begun:
    """A decoded frame at its first question."""

    image: Image
    walk: FrameWalk
    question: Question | None
    decode_s: float


class FrameRunner:
    """Takes encoded frames to their lanes; the frames of one session one at a time, those of different ones at once.

    `at_once` frames are in work at a time: enough to keep the `threads` and the networks busy. The others wait for
    their turn before anything is spent on them, so that however many there are, a frame that is begun is soon done.
    `observe` is told of every batch that the networks run.
    """

    def __init__(
        self,
        limits: ImageLimits,
        threads: int,
        at_once: int,
        observe: Callable[[BatchReport], None] | None = None,
    ) -> None:
        self._limits = limits
        self._turns = asyncio.Semaphore(at_once)
        self._workers = ThreadPoolExecutor(threads, thread_name_prefix="lanestream-frames")
        self._batcher = Batcher(observe)

    def turn(self) -> AbstractAsyncContextManager[None]:
        """A place among the frames in work, first come, first served; to be had before `run`."""
        return self._turns

    async def run(self, session: Session, frame: EncodedFrame) -> ProcessedFrame:
        """The lanes of `frame`.

        Raises ImageError where the file is refused, ExpiredError where its deadline passes before the networks ran; the
        session is then as it was before.
        """
        begun = await self.work(self._begin, session, frame)
        question, inferring = begun.question, 0.0
        while question is not None:
            answer = await asyncio.wrap_future(self._batcher.ask(question, frame.deadline))
            inferring += answer.ended - answer.started
            question = await self.work(begun.walk.go, answer.outputs)
        stages = {"decode": 1e3 * begun.decode_s, "infer": 1e3 * inferring, **begun.walk.timing_ms}
        total = 1e3 * (time.monotonic() - frame.arrived)
        timing = {**stages, "queue": max(0.0, total - sum(stages.values())), "total": total}
        return ProcessedFrame(begun.image, replace(begun.walk.result, timing_ms=timing))

    async def work(self, step: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `step` returns, run in the pool."""
        return await asyncio.get_running_loop().run_in_executor(self._workers, lambda: step(*args, **kwargs))

    def close(self) -> None:
        """Ends the threads after what they are at."""
        self._workers.shutdown(cancel_futures=True)
        self._batcher.close()

    def _begin(self, session: Session, frame: EncodedFrame) -> _Begun:
        started = time.monotonic()
        if frame.deadline is not None and frame.deadline < started:
            raise ExpiredError("the frame waited too long", "send fewer frames a second")
        image = decode(frame.data, self._limits)
        decoded = time.monotonic()
        walk = FrameWalk(session.follow(image, frame.timestamp))
        return _Begun(image, walk, walk.go(), decoded - started)
