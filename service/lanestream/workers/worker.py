"""A worker process, as the service sees it: its start, its frames, their time limit, and its end."""

from __future__ import annotations

import asyncio
import logging
import socket
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from itertools import count, islice
from typing import TYPE_CHECKING, Final

from lanestream.errors import WorkerLostError
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.ipc import FrameDone, FrameJob, WorkerSetup, encode_message, read_message

if TYPE_CHECKING:
    from collections.abc import Iterator

_log = logging.getLogger(__name__)

_PROGRAM: Final = "lanestream.workers.worker_main"
# A process has this long to end by itself.
_END_S: Final = 1.0
# A worker with a frame that takes longer gets new frames only if all workers have such frames.
_SLOW_S: Final = 1.0
# What a frame counts for that takes longer than expected.
_LEAST_S: Final = 0.005
# The time of frames is counted in steps: after the service was suspended, only one step has passed, not all.
_STEP_S: Final = 0.25


@dataclass(frozen=True)
class FrameLost:
    """The outcome of a frame whose worker ended: how long the worker had been processing it (seconds).

    None: the frame cannot be why it ended, so another worker may take it.
    """

    ran_s: float | None


@dataclass(eq=False)
class _PendingFrame:
    """An unfinished frame: how long it is expected to take, when it was begun, and its time in whole steps.

    All in seconds; `begun_at` is monotonic, and None while the frame waits.
    """

    expected_s: float
    outcome: asyncio.Future[FrameDone | FrameLost]
    begun_at: float | None = None
    counted_s: float = 0.0


class Worker:
    """A worker process, as the service sees it.

    It takes frames in the order of their submission and processes as many at a time as it has threads. So of its
    unfinished frames, it can have begun only that many, the oldest ones. While `is_alive` it takes frames; `hung` says
    that it was killed because of one.
    """

    def __init__(
        self, process: asyncio.subprocess.Process, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._process, self._reader, self._writer = process, reader, writer
        self._frames: dict[int, _PendingFrame] = {}
        self._numbers = count()
        self._threads = 0
        self._ready_at = time.monotonic()
        self._listening: asyncio.Task[None] | None = None
        self._watching: asyncio.Task[None] | None = None
        self.capabilities = Capabilities(())
        self.is_alive = False
        self.hung = False

    @classmethod
    async def start(cls, setup: WorkerSetup, limit_s: float) -> Worker:
        """Returns a worker with a warm engine.

        Raises the errors of `setup.load`, and WorkerLostError if the process ends before it is ready or is not ready
        after `limit_s` seconds.
        """
        try:
            async with asyncio.timeout(limit_s):
                worker = await cls._spawn()
                try:
                    worker._writer.write(encode_message(setup))
                    worker.capabilities = await worker._receive_capabilities()
                except BaseException:
                    await worker.kill()
                    raise
        except TimeoutError:
            raise WorkerLostError(
                f"a worker process was not ready after {limit_s:g} s and was killed",
                "its last log lines may say what it was waiting for, for example a device",
            ) from None
        return worker

    @classmethod
    async def _spawn(cls) -> Worker:
        mine, theirs = socket.socketpair()
        try:
            with theirs:
                # -P: modules are never imported from the folder that the service was started in.
                arguments = (sys.executable, "-P", "-m", _PROGRAM, str(theirs.fileno()))
                process = await asyncio.create_subprocess_exec(
                    *arguments, stdin=asyncio.subprocess.DEVNULL, pass_fds=[theirs.fileno()]
                )
            return cls(process, *await asyncio.open_unix_connection(sock=mine))
        except BaseException:
            mine.close()  # which ends the process, if it has started
            raise

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def backlog_s(self) -> float:
        """The processor time that its unfinished frames are expected to take yet (seconds)."""
        now = time.monotonic()
        return sum(
            max(frame.expected_s - (0.0 if frame.begun_at is None else now - frame.begun_at), _LEAST_S)
            for frame in self._frames.values()
        )

    @property
    def is_slow(self) -> bool:
        """Whether one of its frames takes far longer than usual."""
        return any(frame.counted_s > _SLOW_S for frame in self._begun_frames())

    @property
    def uptime_s(self) -> float:
        """The seconds since it was ready."""
        return time.monotonic() - self._ready_at

    def begin(self, threads: int, frame_s: float) -> None:
        """Starts processing frames, in this number of threads. It is killed if one takes `frame_s` seconds."""
        self._writer.write(encode_message(threads))
        self._threads = threads
        self._ready_at = time.monotonic()
        self.is_alive = True
        self._listening = asyncio.create_task(self._listen())
        self._watching = asyncio.create_task(self._watch(frame_s))

    def submit(self, job: FrameJob, expected_s: float) -> asyncio.Future[FrameDone | FrameLost]:
        """Sends a frame, which is expected to take `expected_s` seconds, and returns its future outcome."""
        message = encode_message(job)
        frame = _PendingFrame(expected_s, asyncio.get_running_loop().create_future())
        self._frames[next(self._numbers)] = frame
        self._mark_begun()
        self._writer.write(message)
        return frame.outcome

    async def wait_ended(self) -> int:
        """Waits until the process ends, which loses its frames, and returns the exit status."""
        assert self._listening is not None  # noqa: S101 - begun by the pool
        await asyncio.wait([self._listening])
        # A process may close its socket and continue to run.
        return await self.close()

    async def close(self) -> int:
        """Ends the process, which loses its frames, and returns the exit status."""
        self._lose_frames()
        self._writer.close()
        with suppress(TimeoutError):
            async with asyncio.timeout(_END_S):
                return await self._process.wait()
        return await self.kill()

    async def kill(self) -> int:
        """Kills the process, which loses its frames, and returns the exit status."""
        self._lose_frames()
        self._writer.close()
        with suppress(ProcessLookupError):
            self._process.kill()
        return await self._process.wait()

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
        """Receives the outcomes of frames until the socket is closed."""
        try:
            while True:
                done: FrameDone = await read_message(self._reader)
                frame = self._frames.pop(done.number, None)
                # A caller that was canceled has canceled its future; the frame was processed anyway.
                if frame is not None and not frame.outcome.done():
                    frame.outcome.set_result(done)
                self._mark_begun()
        except (EOFError, ConnectionError):
            pass
        except Exception:
            _log.exception("a worker process sent an unreadable message")
        finally:
            self._lose_frames()

    async def _watch(self, frame_s: float) -> None:
        """Kills the process if it takes `frame_s` seconds for a frame."""
        while not self.hung:
            await asyncio.sleep(_STEP_S)
            for frame in self._begun_frames():
                frame.counted_s += _STEP_S
                self.hung |= frame.counted_s > frame_s
        _log.error("a worker process took more than %g s for a frame and is killed", frame_s)
        with suppress(ProcessLookupError):
            self._process.kill()
        for frame in self._begun_frames():
            # Had this frame blocked the others, it would be about as old as the one that took too long.
            if frame.counted_s < frame_s - _SLOW_S:
                frame.begun_at = None
        # The other frames move on now, not when the process has ended.
        self._lose_frames()

    def _begun_frames(self) -> Iterator[_PendingFrame]:
        return islice(self._frames.values(), self._threads)

    def _mark_begun(self) -> None:
        now = time.monotonic()
        for frame in self._begun_frames():
            if frame.begun_at is None:
                frame.begun_at = now

    def _lose_frames(self) -> None:
        """Takes no more frames, and gives those that it has an outcome."""
        self.is_alive = False
        if self._watching is not None:
            self._watching.cancel()
        now = time.monotonic()
        frames, self._frames = self._frames, {}
        for frame in frames.values():
            if not frame.outcome.done():
                frame.outcome.set_result(FrameLost(None if frame.begun_at is None else now - frame.begun_at))
