"""The program of a worker process: frames in, lanes out, over the socket that the service started it with.

It holds networks and nothing else: what is known of a camera comes with each frame and goes back with its lanes. Hence
any process can take any frame, and one that ends takes nothing with it but the frames that it has in work.
"""

from __future__ import annotations

import logging.config
import signal
import socket
import sys
import threading
import traceback
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import TYPE_CHECKING

import cv2

from lanestream.errors import LanestreamError, one_line
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import FrameWorker
from lanestream.workers.ipc import Done, Job, Setup, packed, receive

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.images.decoding import ImageLimits
    from lanestream.inference.batcher import BatchReport
    from lanestream.workers.ipc import Outcome


class WorkerProcess:
    """The worker's end of the socket."""

    def __init__(self, channel: socket.socket, engine: Engine, limits: ImageLimits) -> None:
        self._channel = channel
        self._engine = engine
        self._batches: deque[BatchReport] = deque()
        self._worker = FrameWorker(limits, self._batches.append)
        self._sending = threading.Lock()

    def serve(self) -> None:
        """Capabilities what it has, is told how many threads it may use, and works until the service is gone."""
        self._send(Capabilities.of(self._engine.pipelines))
        with suppress(EOFError, ConnectionError), ThreadPoolExecutor(receive(self._channel)) as pool:
            while True:
                pool.submit(self._answer, receive(self._channel))

    def _answer(self, job: Job) -> None:
        outcome: Outcome
        try:
            session = self._engine.open_session(job.horizon, job.detector)
            session.restore(job.state)
            outcome = self._worker.lanes(session, job.frame, crowded=job.crowded), session.state
        except Exception as error:
            outcome = portable(error)
        batches = tuple(self._batches.popleft() for _ in range(len(self._batches)))
        with suppress(ConnectionError):
            self._send(Done(job.number, outcome, batches))

    def _send(self, value: object) -> None:
        parcel = packed(value)
        with self._sending:
            self._channel.sendall(parcel)


def portable(error: Exception) -> Exception:
    """The error as another process can read it: one of ours as it is, any other by its name, with its traceback."""
    if isinstance(error, LanestreamError):
        return error
    told = RuntimeError(f"{type(error).__name__}: {one_line(error)}")
    told.add_note("".join(traceback.format_exception(error)))
    return told


def main(descriptor: int) -> None:
    """Works for the service at the other end of the socket `descriptor`."""
    # A signal for the whole group is the service's to answer: it drains, and closes the socket when it is done.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with socket.socket(fileno=descriptor) as channel, suppress(EOFError, ConnectionError):
        setup: Setup = receive(channel)
        logging.config.dictConfig(setup.log)
        cv2.setNumThreads(setup.opencv_threads)
        try:
            engine = setup.load()
        except Exception as error:
            channel.sendall(packed(portable(error)))
            return
        WorkerProcess(channel, engine, setup.limits).serve()


if __name__ == "__main__":
    main(int(sys.argv[1]))
