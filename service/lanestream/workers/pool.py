"""Where frames are worked on, so that the event loop never decodes, proposes, infers or tracks."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, ParamSpec, Protocol, TypeVar

from lanestream.workers.admission import Admission

if TYPE_CHECKING:
    from lanestream.messages import ProcessedFrame
    from lanestream.protocol import DetectorName
    from lanestream.session import SessionState
    from lanestream.workers.capabilities import Capabilities
    from lanestream.workers.frame_worker import EncodedFrame

P = ParamSpec("P")
T = TypeVar("T")


class Camera(Protocol):
    """What is remembered of one camera between its frames, wherever that is."""

    @property
    def state(self) -> SessionState:
        """All of it. Not to be asked for while a frame of the camera is being worked on."""
        ...

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Goes on where `state` was taken; as `Session.restore`."""
        ...


@dataclass(frozen=True)
class Places:
    """How many frames are in work at a time; of frames that are wanted `fresh` there may be fewer.

    From `crowd` frames on, each leaves the processors to the others while a network is at it.
    """

    all: int
    fresh: int
    crowd: int

    @classmethod
    def of(cls, processes: int, threads: int) -> Places:
        """The places of `processes` with so many `threads` each.

        One frame more than its threads is handed to each process beforehand, so that a thread that is done goes on
        without waiting for the event loop. Frames that are wanted fresh leave two of many threads alone: the last bit
        of throughput would cost them more time than it is worth.
        """
        return cls(processes * (threads + 1), processes * max(1, threads - 2), processes * threads // 2 + 1)


class WorkerPool(ABC):
    """Takes encoded frames to their lanes; the frames of one camera one at a time, those of different ones at once.

    Frames wait for their turn before anything is spent on them, so that however many there are, a frame that is begun
    is soon done. `threads` are for other steps of work than those of frames.
    """

    def __init__(self, offers: Capabilities, places: Places, threads: int) -> None:
        self.offers = offers
        self._turns = Admission(places.all, places.fresh)
        self._crowd = places.crowd
        self._frames = 0
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="lanestream-frames")

    @property
    def works(self) -> bool:
        """Whether frames can be worked on just now."""
        return True

    @property
    def pids(self) -> tuple[int, ...]:
        """The numbers of the worker processes; empty where threads of this one do the work."""
        return ()

    def turn(self, *, fresh: bool = False) -> AbstractAsyncContextManager[None]:
        """A place among the frames in work, first come, first served; to be had before `run`."""
        return self._turns.turn(fresh=fresh)

    @abstractmethod
    def open_camera(self, horizon: float | None = None, detector: DetectorName | None = None) -> Camera:
        """The memory of a new camera; `horizon` is its row as a share of the image height, estimated where None.

        Raises NoDetectorError where `detector` is not offered.
        """

    async def run(self, camera: Camera, frame: EncodedFrame) -> ProcessedFrame:
        """The lanes of `frame`; `camera` is one that `open_camera` gave.

        Raises ImageError where the file is refused, ExpiredError where its deadline passes before the networks ran,
        WorkerLostError where the process that had it has ended; the camera's memory is then as it was before.
        """
        self._frames += 1
        try:
            return await self._run(camera, frame, crowded=self._frames >= self._crowd)
        finally:
            self._frames -= 1

    async def work(self, step: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What `step` returns, run in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, lambda: step(*args, **kwargs))

    async def close(self) -> None:
        """Ends threads and processes after what they are at."""
        await asyncio.to_thread(self._pool.shutdown, cancel_futures=True)

    @abstractmethod
    async def _run(self, camera: Camera, frame: EncodedFrame, *, crowded: bool) -> ProcessedFrame:
        """As `run`; `crowded` as for `FrameWorker.lanes`."""
