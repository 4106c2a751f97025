"""Worker processes: Python runs one thread of a process at a time, and much of the work on a frame is Python."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from lanestream.errors import LanestreamError, NotReadyError, WorkerLostError
from lanestream.host import memory_limit, processors, yield_processor
from lanestream.inference.providers import PROVIDERS
from lanestream.session import DEFAULT_SESSION, SessionOptions, SessionState
from lanestream.tracking.tracker import LaneTracker
from lanestream.workers.ipc import FrameDone, FrameJob, WorkerSetup
from lanestream.workers.pool import SessionHandle, WorkerEvent, WorkerPool
from lanestream.workers.worker import Worker

if TYPE_CHECKING:
    from lanestream.inference.batcher import BatchReport
    from lanestream.messages import ProcessedFrame
    from lanestream.workers.admission import Slot
    from lanestream.workers.capabilities import Capabilities
    from lanestream.workers.frame_worker import EncodedFrame

_log = logging.getLogger(__name__)

# Each process has its own networks, so more processes are started only on request.
MOST_PROCESSES: Final = 8
# The memory that a worker and the service itself may need for frames of any accepted size.
_WORKER_BYTES: Final = 400e6
_SERVICE_BYTES: Final = 300e6
# A frame takes a fraction of a second. A worker that takes longer than this hangs.
_FRAME_S: Final = 4.0
# Loading takes seconds, but TensorRT may build engines for minutes. A worker that replaces another one gets this long
# in any case, and besides a multiple of what the first one took.
_START_S: Final = 600.0
_LEAST_START_S: Final = 20.0
_START_FACTOR: Final = 10.0


@dataclass(frozen=True)
class RestartPolicy:
    """The pauses before a worker is replaced (seconds): `first_s`, doubled up to `longest_s` while starts don't help.

    A start has helped if the worker lives for `good_uptime_s` seconds.
    """

    first_s: float = 0.5
    longest_s: float = 30.0
    good_uptime_s: float = 60.0

    def next_pause(self, last_s: float, uptime_s: float) -> float:
        """Returns the pause after a worker that lived for `uptime_s`; `last_s` is the pause before it, 0 if none."""
        if uptime_s >= self.good_uptime_s:
            return self.first_s
        return min(max(2.0 * last_s, self.first_s), self.longest_s)


_RESTARTS: Final = RestartPolicy()


class RemoteSession:
    """A session whose frames are processed in other processes."""

    def __init__(self, options: SessionOptions) -> None:
        self.options = options
        self.state = SessionState()

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Continues where `state` was taken, see `Session.restore`. Raises ValueError for an invalid state."""
        self.state = replace(state, tracker=LaneTracker.restored(state.tracker, ids_lost).state)


class ProcessPool(WorkerPool):
    """Sends each frame, with the state of its session, to the worker process that is expected to be free first.

    Workers that end are replaced as `restarts` says. One that takes `frame_s` seconds for a frame is killed; so is a
    new one that is not ready after `start_s` seconds. `observe`, if given, gets the report of every batch that their
    networks run, and `observe_worker` every event of a worker.
    """

    def __init__(
        self,
        setup: WorkerSetup,
        workers: list[Worker],
        threads: int,
        observe: Callable[[BatchReport], None] | None = None,
        frame_s: float = _FRAME_S,
        start_s: float = _START_S,
        restarts: RestartPolicy = _RESTARTS,
        observe_worker: Callable[[WorkerEvent], None] | None = None,
    ) -> None:
        # Its own threads only draw pictures, which may take longer for the sake of the event loop and the workers.
        super().__init__(workers[0].capabilities, len(workers), threads, processors(), yield_processor)
        self._setup = setup
        self._workers = workers
        self._threads_each = threads
        self._observe = observe
        self._frame_s = frame_s
        self._start_s = start_s
        self._restarts = restarts
        self._observe_worker = observe_worker
        self._closing = False
        for worker in workers:
            worker.begin(threads, frame_s)
        self._supervisors = [asyncio.create_task(self._supervise(worker)) for worker in workers]
        for supervisor in self._supervisors:
            supervisor.add_done_callback(self._supervisor_ended)

    @classmethod
    async def start(
        cls,
        setup: WorkerSetup,
        processes: int | None = None,
        threads_of: Callable[[int], int] | None = None,
        observe: Callable[[BatchReport], None] | None = None,
        frame_s: float = _FRAME_S,
        start_s: float = _START_S,
        restarts: RestartPolicy = _RESTARTS,
        observe_worker: Callable[[WorkerEvent], None] | None = None,
    ) -> ProcessPool:
        """Returns a pool with warm workers. `threads_of(processes)` is the number of threads of each; default 1.

        By default networks on the CPU get one process per processor, at most 8 and as many as fit into a container's
        memory. Networks on a GPU get one process, in which the requests of all cameras meet. Raises the errors of
        `setup.load`, and WorkerLostError if a worker ends before it is ready or is not ready after `start_s` seconds.
        """
        began = time.monotonic()
        workers = [await Worker.start(setup, start_s)]
        usual_s = time.monotonic() - began
        try:
            processes = processes or default_processes(workers[0].capabilities)
            async with asyncio.TaskGroup() as starting:
                for _ in range(processes - 1):
                    starting.create_task(_add(workers, setup, start_s))
        except BaseException as error:
            for worker in workers:
                await worker.kill()
            raise error.exceptions[0] if isinstance(error, ExceptionGroup) else error from None
        threads = threads_of(processes) if threads_of is not None else 1
        restart_s = min(start_s, _LEAST_START_S + _START_FACTOR * usual_s)
        return cls(setup, workers, threads, observe, frame_s, restart_s, restarts, observe_worker)

    @property
    def works(self) -> bool:
        """Whether a worker is alive."""
        return bool(self._alive)

    @property
    def upkeep_failed(self) -> bool:
        """Whether workers that end are no longer replaced, because of an error in this program."""
        return not self._closing and any(supervisor.done() for supervisor in self._supervisors)

    @property
    def pids(self) -> tuple[int, ...]:
        """The process ids of the living workers."""
        return tuple(worker.pid for worker in self._alive)

    @property
    def _alive(self) -> list[Worker]:
        return [worker for worker in self._workers if worker.is_alive]

    def open_session(self, options: SessionOptions = DEFAULT_SESSION) -> SessionHandle:
        """Returns a new camera's session, see `WorkerPool.open_session`."""
        self.capabilities.select(options.detector)
        return RemoteSession(options)

    async def run(self, session: SessionHandle, frame: EncodedFrame, slot: Slot) -> ProcessedFrame:
        """Returns the lanes of `frame`, see `WorkerPool.run`.

        Raises WorkerLostError only if the frame may be why its worker ended: no other worker gets it. A frame that
        waited in that worker goes to another one; raises NotReadyError if there are none.
        """
        assert isinstance(session, RemoteSession)  # noqa: S101 - opened here
        done = await self._process(FrameJob(frame, session.state, session.options), slot)
        if self._observe is not None:
            for report in done.batches:
                self._observe(report)
        if isinstance(done.outcome, Exception):
            raise done.outcome
        processed, session.state = done.outcome
        return processed

    async def _process(self, job: FrameJob, slot: Slot) -> FrameDone:
        while alive := self._alive:
            worker = min(alive, key=lambda each: (each.is_slow, each.backlog_s))
            outcome = await worker.submit(job, slot.expected_s)
            if isinstance(outcome, FrameDone):
                slot.charge(outcome.cpu_s)
                return outcome
            if outcome.ran_s is not None:
                # The time limit also bounds what a frame is charged that was suspended together with the service.
                slot.charge(min(outcome.ran_s, self._frame_s))
                raise WorkerLostError(
                    "the process that had the frame has ended", "send the next frame; the service continues"
                )
        raise NotReadyError("the worker processes are restarting", "send the frame again in a moment")

    async def close(self) -> None:
        """Ends the workers. The frames that they have are lost."""
        self._closing = True
        for supervisor in self._supervisors:
            supervisor.cancel()
        await asyncio.wait(self._supervisors)
        await asyncio.gather(*(worker.close() for worker in self._workers))
        await super().close()

    async def _supervise(self, first: Worker) -> None:
        """Replaces a worker each time it ends, and tries again if another one can't be started."""
        worker: Worker | None = first
        pause_s = 0.0
        while True:
            uptime_s = 0.0 if worker is None else await self._wait_ended(worker)
            pause_s = self._restarts.next_pause(pause_s, uptime_s)
            _log.warning("another worker process starts in %g s", pause_s)
            await asyncio.sleep(pause_s)
            worker = await self._start_another()

    async def _wait_ended(self, worker: Worker) -> float:
        """Waits until a worker ends, and returns the seconds for which it lived."""
        status = await worker.wait_ended()
        uptime_s = worker.uptime_s
        self._workers.remove(worker)
        _log.error(
            "a worker process ended with status %d after %.1f s",
            *(status, uptime_s),
            extra={"event": "worker_ended", "status": status, "duration_s": uptime_s},
        )
        self._report("hung" if worker.hung else "ended")
        return uptime_s

    async def _start_another(self) -> Worker | None:
        """Returns a worker that has begun; None if it can't be started, for any reason, which is logged."""
        try:
            worker = await Worker.start(self._setup, self._start_s)
        except Exception as error:
            # The errors that an operator can understand without a traceback.
            is_known = isinstance(error, (LanestreamError, OSError))
            _log.error("a worker process can't be started: %s", error, exc_info=None if is_known else error)
            self._report("start_failed")
            return None
        worker.begin(self._threads_each, self._frame_s)
        self._workers.append(worker)
        self._report("replaced")
        return worker

    def _supervisor_ended(self, supervisor: asyncio.Task[None]) -> None:
        if not self._closing:
            _log.critical(
                "worker processes that end are no longer replaced, because of an error in this program; restart it",
                exc_info=None if supervisor.cancelled() else supervisor.exception(),
            )

    def _report(self, event: WorkerEvent) -> None:
        if self._observe_worker is not None:
            self._observe_worker(event)


async def _add(workers: list[Worker], setup: WorkerSetup, start_s: float) -> None:
    workers.append(await Worker.start(setup, start_s))


def processes_in_memory() -> int:
    """Returns how many worker processes the container's memory has room for; `MOST_PROCESSES` without a limit."""
    memory = memory_limit()
    return MOST_PROCESSES if memory is None else max(1, int((memory - _SERVICE_BYTES) / _WORKER_BYTES))


def default_processes(capabilities: Capabilities) -> int:
    """Returns the default number of worker processes."""
    on_gpu = {spec.name for spec in PROVIDERS if spec.on_gpu}
    if any(info.model.provider in on_gpu for info in capabilities.detectors):
        return 1
    return min(processors(), processes_in_memory(), MOST_PROCESSES)
