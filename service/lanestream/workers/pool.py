"""The interface of worker pools, which keep decoding, detection and tracking off the event loop."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING, Literal, ParamSpec, Protocol, TypeVar

from lanestream.session import DEFAULT_SESSION, SessionOptions
from lanestream.workers.admission import FairSemaphore, Slot

if TYPE_CHECKING:
    from lanestream.messages import ProcessedFrame
    from lanestream.session import SessionState
    from lanestream.workers.capabilities import Capabilities
    from lanestream.workers.frame_worker import EncodedFrame

WorkerEvent = Literal["ended", "hung", "start_failed", "replaced"]

P = ParamSpec("P")
T = TypeVar("T")


class SessionHandle(Protocol):
    """One camera's session, wherever its frames are processed."""

    @property
    def state(self) -> SessionState:
        """The complete state. Do not read it while a frame of the session is being processed."""

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Continues where `state` was taken, see `Session.restore`. Raises ValueError for an invalid state."""


class WorkerPool(ABC):
    """Processes encoded frames: those of one session one at a time, those of different sessions in parallel.

    Frames wait for admission before any work on them, so under any load a frame that has started is finished soon.
    There are `workers` processes with `threads_each`; `own_threads` threads of this process do other work, after each
    has called `prepare_thread`.
    """

    def __init__(
        self,
        capabilities: Capabilities,
        workers: int,
        threads_each: int,
        own_threads: int,
        prepare_thread: Callable[[], None] | None = None,
    ) -> None:
        self.capabilities = capabilities
        # Each process gets one frame more than it has threads, so that a thread that becomes free continues without
        # waiting for the event loop. Frames of mode `latest` leave two of many threads idle: for them, latency matters
        # more than the last bit of throughput.
        parallel = workers * threads_each
        self._admission = FairSemaphore(
            slots=parallel + workers,
            latest_slots=workers * max(1, threads_each - 2),
            per_caller=(parallel + 1) // 2,
        )
        self._threads = ThreadPoolExecutor(own_threads, "lanestream-frames", initializer=prepare_thread)

    @property
    def works(self) -> bool:
        """Whether frames can be processed now."""
        return True

    @property
    def upkeep_failed(self) -> bool:
        """Whether workers that end are no longer replaced."""
        return False

    @property
    def pids(self) -> tuple[int, ...]:
        """The process ids of the workers; empty if they are threads of this process."""
        return ()

    def admit(self, caller: str, *, latest: bool = False) -> AbstractAsyncContextManager[Slot]:
        """Returns a context that waits for a slot and holds it; callers get equal shares of the processors."""
        return self._admission.slot(caller, latest=latest)

    @abstractmethod
    def open_session(self, options: SessionOptions = DEFAULT_SESSION) -> SessionHandle:
        """Returns a new camera's session. Raises NoDetectorError if its detector is missing."""

    @abstractmethod
    async def run(self, session: SessionHandle, frame: EncodedFrame, slot: Slot) -> ProcessedFrame:
        """Returns the lanes of `frame`; `session` is from `open_session`. Charges `slot` with the processor time.

        Raises ImageError if the file is refused, ExpiredError if its deadline passes before the networks run,
        WorkerLostError if the frame may be why its worker process ended or hung, and NotReadyError if no worker is
        alive. In these cases the session stays as it was.
        """

    async def in_thread(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Runs `function` in a thread of this process and returns its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, lambda: function(*args, **kwargs))

    async def close(self) -> None:
        """Ends threads and processes after their current work."""
        await asyncio.to_thread(self._threads.shutdown, cancel_futures=True)
