"""The worker processes of a batch on this machine: each has its own engine and takes one unit at a time."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from threading import Event
from typing import Any, Final, Self

from lanestream.errors import WorkerLostError
from lanestream_client.batch.processing import BatchJob, EngineInfo, Progress
from lanestream_client.batch.state import UnitResult
from lanestream_client.batch.stopping import STOP_SIGNALS
from lanestream_client.batch.units import Unit
from lanestream_client.batch.worker import Stopped, run_worker

# How long the pool waits at a time, in seconds. After the batch was suspended, only one such step has passed.
_STEP_S: Final = 0.25
# A frame takes a fraction of a second, and opening a file on a slow network drive some seconds.
_LONGEST_SILENCE_S: Final = 300.0
# TensorRT may build engines for minutes.
_LONGEST_START_S: Final = 900.0
# A file at which a worker died this often is not tried again.
_MOST_DEATHS: Final = 2
_MOST_FAILED_STARTS: Final = 3

# Called with the number of bytes and frames of the unfinished units that are done.
ReportUnfinished = Callable[[float, int], object]


class WorkerPool:
    """Processes units in this number of processes. A worker that dies costs at most the file that it was working on.

    As a context manager it ends its workers; results that were not taken by then are lost. `stop` ends its waits.
    """

    def __init__(self, job: BatchJob, processes: int, stop: Event) -> None:
        self._job = job
        self._processes = processes
        self._stop = stop
        self._workers: list[_Worker] = []
        self._deaths: Counter[str] = Counter()
        self._failed_starts = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.kill()

    def start(self) -> EngineInfo | None:
        """Starts the workers and returns what runs in the first that is ready; None if it was stopped.

        Raises the errors of UnitProcessor, and WorkerLostError if a worker dies before.
        """
        self._workers = [_Worker(self._job) for _ in range(self._processes)]
        while not self._stop.is_set():
            for worker in self._wait():
                message = worker.receive()
                if not isinstance(message, EngineInfo):
                    raise WorkerLostError(
                        f"a worker process ended while it loaded the engine, {worker.wait_ended()}",
                        "check the memory, and that the networks run with `lanestream doctor`",
                    )
                return message
        return None

    def run(self, units: Sequence[Unit], report: ReportUnfinished) -> Iterator[UnitResult]:
        """Yields the outcomes of all units as they come, until it is stopped.

        Raises WriteError if results can't be written, and WorkerLostError if no worker can be started any more.
        """
        queue = deque(units)
        while not self._stop.is_set() and (queue or any(worker.unit for worker in self._workers)):
            self._assign(queue)
            for worker in self._wait():
                message = worker.receive()
                if isinstance(message, UnitResult):
                    self._assign(queue)  # before the caller takes its time to record the outcome
                    yield message
                elif message is None:
                    yield from self._replace(worker, queue)
                elif isinstance(message, EngineInfo):
                    self._failed_starts = 0
            busy = [worker for worker in self._workers if worker.unit is not None]
            report(sum(worker.done_bytes for worker in busy), sum(worker.progress.frames for worker in busy))

    def _assign(self, queue: deque[Unit]) -> None:
        """Gives units to the workers that have none, and starts the workers that are missing."""
        missing = min(self._processes, len(queue) + sum(worker.unit is not None for worker in self._workers))
        if self._failed_starts < _MOST_FAILED_STARTS:
            self._workers += [_Worker(self._job) for _ in range(missing - len(self._workers))]
        elif not self._workers:
            raise WorkerLostError("worker processes end while they load the engine", "use fewer --processes")
        for worker in self._workers:
            if queue and worker.is_idle:
                worker.send(queue.popleft())

    def _wait(self) -> Sequence[_Worker]:
        """Waits for messages, and returns the workers that have sent one or have ended. Kills those that hang."""
        began = time.monotonic()
        ready = wait([worker.pipe for worker in self._workers], _STEP_S)
        waited_s = min(time.monotonic() - began, _STEP_S)
        for worker in self._workers:
            worker.count_silence(waited_s)
        return [worker for worker in self._workers if worker.pipe in ready]

    def _replace(self, worker: _Worker, queue: deque[Unit]) -> Iterator[UnitResult]:
        """Removes a worker that has ended, and puts what it had back at the end of the queue, where memory is freer.

        Yields the failure of the file that it was working on if that was not the first time.
        """
        self._workers.remove(worker)
        cause = worker.wait_ended()
        self._failed_starts += not worker.is_ready
        if worker.unit is None:
            return
        file = worker.unit.files[worker.progress.index]
        self._deaths[file.path] += 1
        if self._deaths[file.path] < _MOST_DEATHS:
            queue.append(worker.unit)
            return
        rest = worker.unit.without(file.path)
        if rest is not None:
            queue.append(rest)
        error = f"the worker process ended {_MOST_DEATHS} times at this file, the last time {cause}"
        yield UnitResult(Unit(worker.unit.kind, (file,)), failed={file.path: error})


class _Worker:
    """A worker process, the unit that it has, and the file of it that it is working on."""

    def __init__(self, job: BatchJob) -> None:
        # Not forked: the networks' runtimes have threads, and each worker loads its own networks anyway.
        context = multiprocessing.get_context("spawn")
        self.pipe: Connection[Unit, Any]
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=run_worker, args=(job, theirs))
        with _signals_blocked():
            self._process.start()
        theirs.close()
        self._hung = False
        self._silent_s = 0.0
        self.is_ready = False
        self.unit: Unit | None = None
        self.progress = Progress()

    @property
    def is_idle(self) -> bool:
        """Whether it waits for a unit."""
        return self.is_ready and self.unit is None

    @property
    def done_bytes(self) -> float:
        """The bytes of its unit that are done."""
        if self.unit is None:
            return 0.0
        done = sum(file.size for file in self.unit.files[: self.progress.index])
        return done + self.progress.share * self.unit.files[self.progress.index].size

    def send(self, unit: Unit) -> None:
        """Gives it a unit."""
        self.unit, self.progress, self._silent_s = unit, Progress(), 0.0
        with suppress(OSError):  # it has ended, which is noticed when it is waited for
            self.pipe.send(unit)

    def receive(self) -> EngineInfo | UnitResult | Progress | None:
        """Returns its next message; None if it has ended. Raises the error with which it has stopped."""
        try:
            message: EngineInfo | UnitResult | Progress | Stopped = self.pipe.recv()
        except (EOFError, OSError):
            return None
        self._silent_s = 0.0
        if isinstance(message, Stopped):
            raise message.error
        if isinstance(message, Progress):
            self.progress = message
        else:
            self.is_ready, self.unit = True, None
        return message

    def count_silence(self, seconds: float) -> None:
        """Counts time without a message, and kills the process if it was too long."""
        self._silent_s += 0.0 if self.is_idle else seconds
        if self._silent_s > (_LONGEST_SILENCE_S if self.is_ready else _LONGEST_START_S):
            self._hung = True
            self._process.kill()

    def kill(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.join()
        self.pipe.close()

    def wait_ended(self) -> str:
        """Returns how the process has ended, which has closed its pipe."""
        self._process.join(_STEP_S)
        self.kill()
        status = self._process.exitcode or 0
        if self._hung:
            return f"killed after {_LONGEST_SILENCE_S:g} s without progress"
        if status >= 0:
            return f"with status {status}"
        hint = ", perhaps for lack of memory" if -status == signal.SIGKILL else ""
        return f"by {signal.Signals(-status).name}{hint}"


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Blocks the signals that end a batch, for good in the processes that are started in the block.

    The terminal sends them to all processes of the batch, which itself ends its workers.
    """
    # It would unblock signals when it is started together with the first process.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
