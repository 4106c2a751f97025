"""The way of a frame through the threads, so that the event loop never decodes, proposes, infers or tracks.

A frame has a thread of a small pool for its whole way; what it asks the networks goes to the batcher, where the
questions of all sessions meet.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from lanestream.detection import NO_OUTPUTS, in_one
from lanestream.detection.edges import WORKING_WIDTH
from lanestream.errors import ExpiredError
from lanestream.imaging import ImageLimits, Picture, decode, decode_reduced
from lanestream.inference.batcher import Answer, Batcher, BatchReport
from lanestream.messages import ProcessedFrame
from lanestream.sessions.turns import Turns
from lanestream.sessions.walk import FrameWalk

if TYPE_CHECKING:
    from lanestream.sessions.session import Session

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class EncodedFrame:
    """An image file, when it was captured (the client's seconds) and when it came (monotonic seconds).

    After `deadline` (monotonic seconds) nobody wants its lanes any more; None: always. Who wants to draw on it asks for
    the `whole` picture; for finding lanes a reduced one does.
    """

    data: bytes
    timestamp: float
    arrived: float
    deadline: float | None = None
    whole: bool = False


class FrameRunner:
    """Takes encoded frames to their lanes; the frames of one session one at a time, those of different ones at once.

    `threads` frames are in work at a time, a thread each: enough to keep the processors and the networks busy. One more
    is handed over beforehand, so that a thread that is done goes on without waiting for the event loop. The others wait
    for their turn before anything is spent on them, so that however many there are, a frame that is begun is soon done.
    Frames that are wanted fresh leave two threads alone: the last bit of throughput would cost them more time than it
    is worth. `observe` is told of every batch that the networks run.
    """

    def __init__(self, limits: ImageLimits, threads: int, observe: Callable[[BatchReport], None] | None = None) -> None:
        self._limits = limits
        self._turns = Turns(threads + 1, fresh=max(1, threads - 2))
        self._frames = 0
        self._crowd = threads // 2 + 1
        self._workers = ThreadPoolExecutor(threads, thread_name_prefix="lanestream-frames")
        self._batcher = Batcher(observe)

    def turn(self, *, fresh: bool = False) -> AbstractAsyncContextManager[None]:
        """A place among the frames in work, first come, first served; to be had before `run`."""
        return self._turns.turn(fresh=fresh)

    async def run(self, session: Session, frame: EncodedFrame) -> ProcessedFrame:
        """The lanes of `frame`.

        Raises ImageError where the file is refused, ExpiredError where its deadline passes before the networks ran; the
        session is then as it was before.
        """
        self._frames += 1
        try:
            return await self.work(self._process, session, frame)
        finally:
            self._frames -= 1

    async def work(self, step: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `step` returns, run in a thread of the pool."""
        return await asyncio.get_running_loop().run_in_executor(self._workers, lambda: step(*args, **kwargs))

    def close(self) -> None:
        """Ends the threads after what they are at."""
        self._workers.shutdown(cancel_futures=True)
        self._batcher.close()

    def _process(self, session: Session, frame: EncodedFrame) -> ProcessedFrame:
        started = time.monotonic()
        if frame.deadline is not None and frame.deadline < started:
            raise ExpiredError()
        picture = self._decoded(frame)
        decoded = time.monotonic()
        steps = session.follow(picture.image, frame.timestamp)
        # Frames of others keep the processors busy while a network is at this one; a frame among few is done sooner
        # where its own work goes on meanwhile, at the price of more and smaller batches.
        walk = FrameWalk(in_one(steps) if self._frames >= self._crowd else steps)
        inferring = self._answer_all(walk, frame.deadline)
        ended = time.monotonic()
        stages = {"decode": 1e3 * (decoded - started), "infer": 1e3 * inferring, **walk.timing_ms}
        total = 1e3 * (ended - frame.arrived)
        timing = {**stages, "queue": max(0.0, total - sum(stages.values())), "total": total}
        return ProcessedFrame.of(picture, walk.result, timing)

    def _decoded(self, frame: EncodedFrame) -> Picture:
        if frame.whole:
            return Picture(decode(frame.data, self._limits))
        return decode_reduced(frame.data, self._limits, WORKING_WIDTH)

    def _answer_all(self, walk: FrameWalk, deadline: float | None) -> float:
        """Goes through all questions of a frame; the seconds for which the networks kept it waiting."""
        inferring = 0.0
        asked: list[Future[Answer]] = []
        question = walk.go()
        while question is not None:
            outputs = NO_OUTPUTS
            if question.waits:
                since = time.monotonic()
                # Who only collects what was asked before asks nothing.
                last = [self._batcher.answer(question, deadline)] if len(question.inputs) or not asked else []
                answers = [*(each.result() for each in asked), *last]
                for answer in answers:
                    # While the frame was at work itself, and while others had their turn, it was not the networks.
                    inferring += max(0.0, answer.ended - max(answer.started, since))
                    since = max(since, answer.ended)
                outputs, asked = np.concatenate([answer.outputs for answer in answers]), []
            else:
                asked.append(self._batcher.ask(question, deadline))
            question = walk.go(outputs)
        return inferring
