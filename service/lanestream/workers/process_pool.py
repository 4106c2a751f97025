"""Worker processes: Python runs one thread of a process at a time, and much of the work on a frame is Python."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Final

from lanestream.errors import LanestreamError, WorkerLostError
from lanestream.host import memory_limit, processors
from lanestream.inference.providers import PROVIDERS
from lanestream.session import SessionState
from lanestream.tracking.tracker import LaneTracker
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.ipc import FrameDone, FrameJob, WorkerSetup, encode_message, read_message
from lanestream.workers.pool import SessionHandle, WorkerPool

if TYPE_CHECKING:
    from lanestream.inference.batcher import BatchReport
    from lanestream.messages import ProcessedFrame
    from lanestream.workers.frame_worker import EncodedFrame

_log = logging.getLogger(__name__)

_PROGRAM: Final = "lanestream.workers.worker_main"
# Each process has its own networks, so more processes are started only on request.
_MOST_PROCESSES: Final = 8
# The memory that a worker and the service itself may need for frames of any accepted size.
_WORKER_BYTES: Final = 400e6
_SERVICE_BYTES: Final = 300e6
# The pause before another worker starts in place of one that ended, doubled after each failure.
_RESTART_S: Final = 0.5
_LONGEST_RESTART_S: Final = 30.0
_END_S: Final = 10.0
# A frame takes a fraction of a second, or many seconds on a busy machine; a worker that takes longer than this hangs.
_FRAME_S: Final = 30.0
# The time limit is waited for in parts: after the service was suspended, only one part has passed, not all.
_PARTS: Final = 10


class RemoteSession:
    """A session whose frames are processed in other processes."""

    def __init__(self, horizon: float | None, detector: str | None) -> None:
        self.horizon = horizon
        self.detector = detector
        self.state = SessionState()

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Continues where `state` was taken, see `Session.restore`. Raises ValueError for an invalid state."""
        self.state = replace(state, tracker=LaneTracker.restored(state.tracker, ids_lost).state)


class Worker:
    """A worker process, as the service sees it."""

    def __init__(
        self, process: asyncio.subprocess.Process, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._process, self._reader, self._writer = process, reader, writer
        self._jobs: dict[int, asyncio.Future[FrameDone]] = {}
        self._numbers = count()
        self._listening: asyncio.Task[None] | None = None
        self.capabilities = Capabilities(())

    @classmethod
    async def start(cls, setup: WorkerSetup) -> Worker:
        """Returns a worker with a warm engine.

        Raises the errors of `setup.load`, and WorkerLostError if the process ends before it is ready.
        """
        mine, theirs = socket.socketpair()
        with theirs:
            # -P: modules are never imported from the folder that the service was started in.
            arguments = (sys.executable, "-P", "-m", _PROGRAM, str(theirs.fileno()))
            process = await asyncio.create_subprocess_exec(
                *arguments, stdin=asyncio.subprocess.DEVNULL, pass_fds=[theirs.fileno()]
            )
        worker = cls(process, *await asyncio.open_unix_connection(sock=mine))
        try:
            worker._writer.write(encode_message(setup))
            worker.capabilities = await worker._receive_capabilities()
        except BaseException:
            await worker.kill()
            raise
        return worker

    @property
    def is_alive(self) -> bool:
        """Whether it can take frames."""
        return self._listening is not None and not self._listening.done()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def pending(self) -> int:
        """The number of its unfinished frames."""
        return len(self._jobs)

    def begin(self, threads: int) -> None:
        """Starts processing frames, in this number of threads."""
        self._writer.write(encode_message(threads))
        self._listening = asyncio.create_task(self._listen())

    async def process(self, session: RemoteSession, frame: EncodedFrame, limit_s: float) -> FrameDone:
        """Returns the outcome of a frame.

        Raises WorkerLostError if the worker ends first, TimeoutError if the frame takes `limit_s` seconds. Time during
        which the service was suspended, for example with its container, hardly counts: so was the worker.
        """
        number = next(self._numbers)
        done: asyncio.Future[FrameDone] = asyncio.get_running_loop().create_future()
        self._jobs[number] = done
        job = FrameJob(number, frame, session.state, session.horizon, session.detector)
        self._writer.write(encode_message(job))
        try:
            for _ in range(_PARTS):
                await asyncio.wait([done], timeout=limit_s / _PARTS)
                if done.done():
                    return done.result()
            raise TimeoutError
        finally:
            del self._jobs[number]

    async def wait_ended(self) -> int:
        """Waits until the process ends, which loses its frames, and returns the exit status."""
        assert self._listening is not None  # noqa: S101 - begun by the pool
        await self._listening
        self._writer.close()
        return await self._process.wait()

    async def close(self) -> None:
        """Ends the process after its current work."""
        self._writer.close()
        with suppress(TimeoutError):
            async with asyncio.timeout(_END_S):
                await self._process.wait()
        await self.kill()

    async def kill(self) -> None:
        """Kills the process."""
        self._writer.close()
        with suppress(ProcessLookupError):
            self._process.kill()
        await self._process.wait()

    async def _receive_capabilities(self) -> Capabilities:
        try:
            capabilities = await read_message(self._reader)
        except (EOFError, ConnectionError):
            status = await self._process.wait()
            raise WorkerLostError(f"a worker process ended with status {status} while it started") from None
        if isinstance(capabilities, Exception):
            raise capabilities
        assert isinstance(capabilities, Capabilities)  # noqa: S101 - the first message of a worker
        return capabilities

    async def _listen(self) -> None:
        try:
            while True:
                done: FrameDone = await read_message(self._reader)
                job = self._jobs.get(done.number)
                if job is not None and not job.done():
                    job.set_result(done)
        except (EOFError, ConnectionError):
            pass
        except Exception:
            _log.exception("a worker process sent an unreadable message")
            await self.kill()
        for job in self._jobs.values():
            if not job.done():
                job.set_exception(_lost())


class ProcessPool(WorkerPool):
    """Sends each frame, with the state of its session, to the worker process that has the fewest frames.

    Workers that end are replaced, and one that takes `frame_s` seconds for a frame is killed. `observe`, if given, gets
    the report of every batch that their networks run.
    """

    def __init__(
        self,
        setup: WorkerSetup,
        workers: list[Worker],
        threads: int,
        observe: Callable[[BatchReport], None] | None = None,
        frame_s: float = _FRAME_S,
    ) -> None:
        super().__init__(workers[0].capabilities, len(workers), threads, processors())
        self._setup = setup
        self._workers = workers
        self._threads_each = threads
        self._observe = observe
        self._frame_s = frame_s
        for worker in workers:
            worker.begin(threads)
        self._supervisors = [asyncio.create_task(self._supervise(worker)) for worker in workers]

    @classmethod
    async def start(
        cls,
        setup: WorkerSetup,
        processes: int | None = None,
        threads_of: Callable[[int], int] | None = None,
        observe: Callable[[BatchReport], None] | None = None,
        frame_s: float = _FRAME_S,
    ) -> ProcessPool:
        """Returns a pool with warm workers. `threads_of(processes)` is the number of threads of each; default 1.

        By default networks on the CPU get one process per processor, at most 8 and as many as fit into a container's
        memory. Networks on a GPU get one process, in which the requests of all cameras meet. Raises the errors of
        `setup.load`.
        """
        workers = [await Worker.start(setup)]
        try:
            processes = processes or default_processes(workers[0].capabilities)
            async with asyncio.TaskGroup() as starting:
                for _ in range(processes - 1):
                    starting.create_task(_add(workers, setup))
        except BaseException as error:
            for worker in workers:
                await worker.kill()
            raise error.exceptions[0] if isinstance(error, ExceptionGroup) else error from None
        return cls(setup, workers, threads_of(processes) if threads_of is not None else 1, observe, frame_s)

    @property
    def works(self) -> bool:
        """Whether a worker is alive."""
        return bool(self._alive)

    @property
    def pids(self) -> tuple[int, ...]:
        """The process ids of the living workers."""
        return tuple(worker.pid for worker in self._alive)

    @property
    def _alive(self) -> list[Worker]:
        return [worker for worker in self._workers if worker.is_alive]

    def open_session(self, horizon: float | None = None, detector: str | None = None) -> SessionHandle:
        """Returns a new camera's session, see `WorkerPool.open_session`."""
        self.capabilities.select(detector)
        return RemoteSession(horizon, detector)

    async def run(self, session: SessionHandle, frame: EncodedFrame) -> ProcessedFrame:
        """Returns the lanes of `frame`, see `WorkerPool.run`."""
        assert isinstance(session, RemoteSession)  # noqa: S101 - opened here
        if not self._alive:
            raise _lost()
        worker = min(self._alive, key=lambda each: each.pending)
        try:
            done = await worker.process(session, frame, self._frame_s)
        except TimeoutError:
            _log.error("a worker process took more than %g s for a frame and is killed", self._frame_s)
            await worker.kill()
            raise _lost() from None
        if self._observe is not None:
            for report in done.batches:
                self._observe(report)
        if isinstance(done.outcome, Exception):
            raise done.outcome
        processed, session.state = done.outcome
        return processed

    async def close(self) -> None:
        """Ends the workers after their current work."""
        for supervisor in self._supervisors:
            supervisor.cancel()
        await asyncio.wait(self._supervisors)
        await asyncio.gather(*(worker.close() for worker in self._workers))
        await super().close()

    async def _supervise(self, worker: Worker) -> None:
        """Replaces a worker each time it ends."""
        while True:
            status = await worker.wait_ended()
            self._workers.remove(worker)
            _log.error("a worker process ended with status %d and is replaced", status)
            worker = await self._restart()
            worker.begin(self._threads_each)
            self._workers.append(worker)

    async def _restart(self) -> Worker:
        pause = _RESTART_S
        while True:
            await asyncio.sleep(pause)
            try:
                return await Worker.start(self._setup)
            except (LanestreamError, OSError) as error:
                _log.error("a worker process can't be started: %s", error)
                pause = min(2.0 * pause, _LONGEST_RESTART_S)


async def _add(workers: list[Worker], setup: WorkerSetup) -> None:
    workers.append(await Worker.start(setup))


def default_processes(capabilities: Capabilities) -> int:
    """Returns the default number of worker processes."""
    on_gpu = {spec.name for spec in PROVIDERS if spec.on_gpu}
    if any(info.model.provider in on_gpu for info in capabilities.detectors):
        return 1
    memory = memory_limit()
    room = _MOST_PROCESSES if memory is None else max(1, int((memory - _SERVICE_BYTES) / _WORKER_BYTES))
    return min(processors(), room, _MOST_PROCESSES)


def _lost() -> WorkerLostError:
    return WorkerLostError("the process that had the frame has ended", "send the next frame; the service continues")
