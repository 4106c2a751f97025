"""Frames in worker processes: Python runs one thread of a process at a time, and much of finding lanes is Python."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from typing import TYPE_CHECKING, Final

from lanestream.errors import LanestreamError, WorkerLostError
from lanestream.host import memory_limit, processors
from lanestream.session import SessionState
from lanestream.tracking import LaneTracker
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.ipc import Done, Job, Setup, packed, received
from lanestream.workers.pool import Camera, Places, WorkerPool

if TYPE_CHECKING:
    from lanestream.inference.batcher import BatchReport
    from lanestream.messages import ProcessedFrame
    from lanestream.protocol import DetectorName
    from lanestream.workers.frame_worker import EncodedFrame

_log = logging.getLogger(__name__)

_PROGRAM: Final = "lanestream.workers.worker_main"
# More processes are for those who ask for them: each holds networks of its own.
_MOST_PROCESSES: Final = 8
# What a worker and the service itself may come to have with frames of any size that is accepted.
_WORKER_BYTES: Final = 400e6
_SERVICE_BYTES: Final = 300e6
# How long the service waits before it starts another worker for one that ended; twice as long after each failure.
_RESTART_S: Final = 0.5
_LONGEST_RESTART_S: Final = 30.0
_END_S: Final = 10.0
# A frame takes a worker a fraction of a second, many seconds on a busy machine: one that has had it for longer hangs.
_PATIENCE_S: Final = 30.0
# In how many parts that is waited for: a service that was suspended finds one of them over when it goes on, not all.
_LOOKS: Final = 10


class RemoteCamera:
    """The memory of a camera whose frames are worked on elsewhere."""

    def __init__(self, horizon: float | None, detector: DetectorName | None) -> None:
        self.horizon = horizon
        self.detector = detector
        self.state = SessionState(None, None, None, 0.0, LaneTracker().state)

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """See `Session.restore`."""
        tracker = LaneTracker.restored(state.tracker, ids_lost).state
        self.state = SessionState(state.size, state.horizon, state.glanced, state.evidence, tracker)


class Worker:
    """A worker process, as the service sees it."""

    def __init__(
        self, process: asyncio.subprocess.Process, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._process, self._reader, self._writer = process, reader, writer
        self._asked: dict[int, asyncio.Future[Done]] = {}
        self._numbers = count()
        self._listening: asyncio.Task[None] | None = None
        self.offers = Capabilities(())

    @classmethod
    async def started(cls, setup: Setup) -> Worker:
        """A worker with a warm engine. Raises what `setup.load` raises, WorkerLostError where the process ends."""
        mine, theirs = socket.socketpair()
        with theirs:
            # -P: what lies in the folder from which the service was started is none of its modules.
            arguments = (sys.executable, "-P", "-m", _PROGRAM, str(theirs.fileno()))
            process = await asyncio.create_subprocess_exec(
                *arguments, stdin=asyncio.subprocess.DEVNULL, pass_fds=[theirs.fileno()]
            )
        worker = cls(process, *await asyncio.open_unix_connection(sock=mine))
        try:
            worker._writer.write(packed(setup))
            worker.offers = await worker._welcome()
        except BaseException:
            await worker.kill()
            raise
        return worker

    @property
    def lives(self) -> bool:
        """Whether it can be asked."""
        return self._listening is not None and not self._listening.done()

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    @property
    def in_work(self) -> int:
        """How many frames it has."""
        return len(self._asked)

    def begin(self, threads: int) -> None:
        """Has it take frames, in so many threads."""
        self._writer.write(packed(threads))
        self._listening = asyncio.create_task(self._listen())

    async def ask(self, camera: RemoteCamera, frame: EncodedFrame, patience_s: float, *, crowded: bool) -> Done:
        """What it makes of a frame.

        Raises WorkerLostError where it ends before, TimeoutError where that takes `patience_s` seconds. Time in which
        the service itself was suspended, with its container say, hardly counts: the worker was suspended, too.
        """
        number = next(self._numbers)
        answer: asyncio.Future[Done] = asyncio.get_running_loop().create_future()
        self._asked[number] = answer
        job = Job(number, frame, camera.state, camera.horizon, camera.detector, crowded)
        self._writer.write(packed(job))
        try:
            for _ in range(_LOOKS):
                await asyncio.wait([answer], timeout=patience_s / _LOOKS)
                if answer.done():
                    return answer.result()
            raise TimeoutError
        finally:
            del self._asked[number]

    async def ended(self) -> int:
        """Waits for its end, after which all its frames are lost; the exit status."""
        assert self._listening is not None  # noqa: S101 - begun by who started it
        await self._listening
        self._writer.close()
        return await self._process.wait()

    async def close(self) -> None:
        """Has it end after what it is at."""
        self._writer.close()
        with suppress(TimeoutError):
            async with asyncio.timeout(_END_S):
                await self._process.wait()
        await self.kill()

    async def kill(self) -> None:
        """Ends it at once."""
        self._writer.close()
        with suppress(ProcessLookupError):
            self._process.kill()
        await self._process.wait()

    async def _welcome(self) -> Capabilities:
        try:
            offers = await received(self._reader)
        except (EOFError, ConnectionError):
            raise WorkerLostError(f"a worker process ended while it started: {await self._process.wait()}") from None
        if isinstance(offers, Exception):
            raise offers
        assert isinstance(offers, Capabilities)  # noqa: S101 - what a worker says first
        return offers

    async def _listen(self) -> None:
        try:
            while True:
                done: Done = await received(self._reader)
                answer = self._asked.get(done.number)
                if answer is not None and not answer.done():
                    answer.set_result(done)
        except (EOFError, ConnectionError):
            pass
        except Exception:
            _log.exception("what a worker process sent can't be read")
            await self.kill()
        for answer in self._asked.values():
            if not answer.done():
                answer.set_exception(_lost())


class ProcessPool(WorkerPool):
    """Hands each frame, with what is known of its camera, to the worker process that has the fewest.

    Workers that end are replaced, and one that has been at a frame for `patience_s` seconds is ended; `observe` is told
    of every batch that their networks run.
    """

    def __init__(
        self,
        setup: Setup,
        workers: list[Worker],
        threads: int,
        observe: Callable[[BatchReport], None] | None = None,
        patience_s: float = _PATIENCE_S,
    ) -> None:
        super().__init__(workers[0].offers, Places.of(len(workers), threads), processors())
        self._setup = setup
        self._workers = workers
        self._threads = threads
        self._observe = observe
        self._patience_s = patience_s
        for worker in workers:
            worker.begin(threads)
        self._keepers = [asyncio.create_task(self._keep(worker)) for worker in workers]

    @classmethod
    async def started(
        cls,
        setup: Setup,
        processes: int | None = None,
        threads_of: Callable[[int], int] | None = None,
        observe: Callable[[BatchReport], None] | None = None,
        patience_s: float = _PATIENCE_S,
    ) -> ProcessPool:
        """A runner with warm workers: `threads_of` tells the threads of each of so many `processes`, 1 without it.

        Where None are named, networks on the CPU get a process for each processor, up to 8 and to what a container's
        memory has room for; those on a device one for all, in which the questions of all cameras meet. Raises what
        `setup.load` raises.
        """
        workers = [await Worker.started(setup)]
        try:
            processes = processes or usual_processes(workers[0].offers)
            async with asyncio.TaskGroup() as starting:
                for _ in range(processes - 1):
                    starting.create_task(_add(workers, setup))
        except BaseException as error:
            for worker in workers:
                await worker.kill()
            raise error.exceptions[0] if isinstance(error, ExceptionGroup) else error from None
        return cls(setup, workers, threads_of(processes) if threads_of is not None else 1, observe, patience_s)

    @property
    def works(self) -> bool:
        """See `WorkerPool.works`."""
        return bool(self._living)

    @property
    def pids(self) -> tuple[int, ...]:
        """See `WorkerPool.pids`."""
        return tuple(worker.pid for worker in self._living)

    @property
    def _living(self) -> list[Worker]:
        return [worker for worker in self._workers if worker.lives]

    def open_camera(self, horizon: float | None = None, detector: DetectorName | None = None) -> Camera:
        """See `WorkerPool.open_camera`."""
        self.offers.chosen(detector)
        return RemoteCamera(horizon, detector)

    async def close(self) -> None:
        """See `WorkerPool.close`."""
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.wait(self._keepers)
        await asyncio.gather(*(worker.close() for worker in self._workers))
        await super().close()

    async def _run(self, camera: Camera, frame: EncodedFrame, *, crowded: bool) -> ProcessedFrame:
        assert isinstance(camera, RemoteCamera)  # noqa: S101 - opened here
        if not self._living:
            raise _lost()
        worker = min(self._living, key=lambda each: each.in_work)
        try:
            done = await worker.ask(camera, frame, self._patience_s, crowded=crowded)
        except TimeoutError:
            _log.error("a worker process has been at a frame for %g s; it is ended", self._patience_s)
            await worker.kill()
            raise _lost() from None
        if self._observe is not None:
            for report in done.batches:
                self._observe(report)
        if isinstance(done.outcome, Exception):
            raise done.outcome
        processed, camera.state = done.outcome
        return processed

    async def _keep(self, worker: Worker) -> None:
        """Has another worker in the place of one that has ended, again and again."""
        while True:
            status = await worker.ended()
            self._workers.remove(worker)
            _log.error("a worker process ended with status %d; another one is started", status)
            worker = await self._another()
            worker.begin(self._threads)
            self._workers.append(worker)

    async def _another(self) -> Worker:
        pause = _RESTART_S
        while True:
            await asyncio.sleep(pause)
            try:
                return await Worker.started(self._setup)
            except (LanestreamError, OSError) as error:
                _log.error("a worker process can't be started: %s", error)
                pause = min(2.0 * pause, _LONGEST_RESTART_S)


async def _add(workers: list[Worker], setup: Setup) -> None:
    workers.append(await Worker.started(setup))


def usual_processes(offers: Capabilities) -> int:
    """How many processes work on frames where nobody says how many."""
    if not all(offer.network.provider in ("cpu", "openvino") for offer in offers.all):
        return 1
    memory = memory_limit()
    room = _MOST_PROCESSES if memory is None else max(1, int((memory - _SERVICE_BYTES) / _WORKER_BYTES))
    return min(processors(), room, _MOST_PROCESSES)


def _lost() -> WorkerLostError:
    return WorkerLostError("the process that had the frame has ended", "send the next frame; the service goes on")
