"""Questions of many cameras, answered together: one run at a time, each run takes what waits.

The rule is work-conserving: when the device is free it takes what is there, up to the network's largest batch, and
never waits for more, so that a lone camera pays nothing for the company it doesn't have. A camera has one question at a
time, hence first come, first served is fair between cameras.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Question
from lanestream.errors import ExpiredError, LanestreamError

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Answer:
    """A network's outputs, row by row, when the run that made them began and ended (monotonic seconds)."""

    outputs: NDArray[np.float32]
    started: float
    ended: float


@dataclass(frozen=True, eq=False)
class Waiting:
    """A question on its way; after `deadline` (monotonic seconds) nobody wants its answer any more."""

    question: Question
    asked: float
    deadline: float | None
    answer: Future[Answer] = field(default_factory=Future)

    @property
    def rows(self) -> int:
        """How many inputs it has."""
        return len(self.question.inputs)


@dataclass(frozen=True)
class BatchReport:
    """One run: its rows and questions, how many questions still waited, how long the oldest one of it had (seconds)."""

    network: str
    rows: int
    questions: int
    still_waiting: int
    oldest_s: float


class BatchQueue:
    """What waits, in the order it came. Not thread-safe; reads no clock."""

    def __init__(self) -> None:
        self._waiting: deque[Waiting] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, waiting: Waiting) -> None:
        """Takes in a question."""
        self._waiting.append(waiting)

    def take(self, now: float) -> tuple[list[Waiting], list[Waiting]]:
        """The next batch, all of one network, and the questions that have expired before their turn.

        The oldest question chooses the network; what fits beside it in one run comes along, in order.
        """
        expired = [each for each in self._waiting if each.deadline is not None and each.deadline < now]
        kept = deque(each for each in self._waiting if each not in expired)
        if not kept:
            self._waiting = kept
            return [], expired
        network = kept[0].question.network
        batch, rows = [kept.popleft()], 0
        rows = batch[0].rows
        left: deque[Waiting] = deque()
        for each in kept:
            if each.question.network is network and rows + each.rows <= network.buckets[-1]:
                batch.append(each)
                rows += each.rows
            else:
                left.append(each)
        self._waiting = left
        return batch, expired


@dataclass(frozen=True)
class Turn:
    """What one run is to answer, what has expired before it, and how many questions still wait."""

    batch: list[Waiting]
    expired: list[Waiting]
    still_waiting: int


class Batcher:
    """Answers questions, in a thread of its own or in that of who waits. `observe` is told of every run, where it was.

    It does not matter to a network which thread runs it, as long as it is one at a time.
    """

    def __init__(self, observe: Callable[[BatchReport], None] | None = None) -> None:
        self._observe = observe
        self._queue = BatchQueue()
        self._changed = threading.Condition()
        self._running = False
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="lanestream-inference", daemon=True)
        self._thread.start()

    def ask(self, question: Question, deadline: float | None = None) -> Future[Answer]:
        """The answer to come; it fails with ExpiredError where `deadline` (monotonic seconds) passes before its run.

        Raises RuntimeError after `close`.
        """
        with self._changed:
            waiting = self._add(question, deadline)
            if not self._running:
                self._changed.notify()
        return waiting.answer

    def answer(self, question: Question, deadline: float | None = None) -> Answer:
        """The answer, for those who can do nothing without it: where nothing runs, they run what waits themselves.

        To wake another thread for it, and to be woken by that one, takes longer. Raises what `ask` says.
        """
        with self._changed:
            waiting = self._add(question, deadline)
            turn = None if self._running else self._take()
        if turn is not None:
            self._run(turn)
        return waiting.answer.result()

    def close(self) -> None:
        """Ends the thread after all that waits has been answered."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()

    def _add(self, question: Question, deadline: float | None) -> Waiting:
        if self._closed:
            raise RuntimeError("the batcher is closed")
        waiting = Waiting(question, time.monotonic(), deadline)
        self._queue.add(waiting)
        return waiting

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: not self._running and (self._closed or len(self._queue) > 0))
                if not len(self._queue):
                    return
                turn = self._take()
            self._run(turn)

    def _take(self) -> Turn:
        """The next run, which is the caller's to do."""
        self._running = True
        batch, expired = self._queue.take(time.monotonic())
        return Turn(batch, expired, len(self._queue))

    def _run(self, turn: Turn) -> None:
        try:
            for waiting in turn.expired:
                _fail(waiting, ExpiredError())
            # A caller that went away took its question with it; one whose run begins can't any more.
            wanted = [waiting for waiting in turn.batch if waiting.answer.set_running_or_notify_cancel()]
            if wanted:
                self._answer(wanted, turn.still_waiting)
        finally:
            with self._changed:
                self._running = False
                if self._closed or len(self._queue):
                    self._changed.notify()

    def _answer(self, batch: list[Waiting], still_waiting: int) -> None:
        started = time.monotonic()
        try:
            self._settle(batch, started)
        except Exception as error:
            if len(batch) == 1:
                batch[0].answer.set_exception(error)
            else:
                _log.warning("a batch of %d questions failed, each is asked again alone: %s", len(batch), error)
                for waiting in batch:
                    self._answer([waiting], still_waiting)
            return
        if self._observe is not None:
            rows = sum(waiting.rows for waiting in batch)
            oldest = started - min(waiting.asked for waiting in batch)
            network = batch[0].question.network.name
            self._observe(BatchReport(network, rows, len(batch), still_waiting, oldest))

    def _settle(self, batch: list[Waiting], started: float) -> None:
        network = batch[0].question.network
        inputs = [waiting.question.inputs for waiting in batch]
        outputs = network.run(inputs[0] if len(inputs) == 1 else np.concatenate(inputs))
        ended = time.monotonic()
        parts = np.split(outputs, np.cumsum([len(part) for part in inputs])[:-1])
        for waiting, part in zip(batch, parts, strict=True):
            waiting.answer.set_result(Answer(part, started, ended))


def _fail(waiting: Waiting, error: LanestreamError) -> None:
    if waiting.answer.set_running_or_notify_cancel():
        waiting.answer.set_exception(error)
