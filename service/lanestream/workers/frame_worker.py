"""The way of one frame from image file to lanes, in a thread that is its own for so long."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lanestream.detection import NO_OUTPUTS, in_one
from lanestream.detection.features import WORKING_WIDTH
from lanestream.errors import ExpiredError
from lanestream.images.decoding import ImageLimits, decode_reduced
from lanestream.inference.batcher import Answer, Batcher, BatchReport
from lanestream.messages import ProcessedFrame
from lanestream.workers.walk import FrameWalk

if TYPE_CHECKING:
    from lanestream.session import Session


@dataclass(frozen=True)
class EncodedFrame:
    """An image file, when it was captured (the client's seconds) and when it came (monotonic seconds).

    After `deadline` (monotonic seconds) nobody wants its lanes any more; None: always.
    """

    data: bytes
    timestamp: float
    arrived: float
    deadline: float | None = None


class FrameWorker:
    """Takes frames to their lanes, each in the thread that asks; what they ask the networks goes to one batcher.

    The frames of one session come one at a time. `observe` is told of every batch that the networks run.
    """

    def __init__(self, limits: ImageLimits, observe: Callable[[BatchReport], None] | None = None) -> None:
        self._limits = limits
        self._batcher = Batcher(observe)

    def lanes(self, session: Session, frame: EncodedFrame, *, crowded: bool) -> ProcessedFrame:
        """The lanes of `frame`; `crowded` where so many are in work that each does best to leave the others alone.

        Raises ImageError where the file is refused, ExpiredError where its deadline passes before the networks ran; the
        session is then as it was before.
        """
        started = time.monotonic()
        if frame.deadline is not None and frame.deadline < started:
            raise ExpiredError()
        picture = decode_reduced(frame.data, self._limits, WORKING_WIDTH)
        decoded = time.monotonic()
        steps = session.follow(picture.image, frame.timestamp)
        # Frames of others keep the processors busy while a network is at this one; a frame among few is done sooner
        # where its own work goes on meanwhile, at the price of more and smaller batches.
        walk = FrameWalk(in_one(steps) if crowded else steps)
        inferring = self._answer_all(walk, frame.deadline)
        ended = time.monotonic()
        stages = {"decode": 1e3 * (decoded - started), "infer": 1e3 * inferring, **walk.timing_ms}
        total = 1e3 * (ended - frame.arrived)
        timing = {**stages, "queue": max(0.0, total - sum(stages.values())), "total": total}
        return ProcessedFrame.of(picture, walk.result, timing)

    def close(self) -> None:
        """Ends the batcher's thread after what it is at."""
        self._batcher.close()

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
