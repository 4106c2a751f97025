"""The program of a worker process: frames in, lanes out, over the socket that the service started it with.

It holds only the networks: the state of the session comes with each frame and goes back with its lanes. So any worker
can take any frame, and one that ends loses only the frames that it was processing.
"""

from __future__ import annotations

import logging.config
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING, Final

import cv2

from lanestream.errors import LanestreamError, one_line
from lanestream.host import return_freed_memory
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import FrameWorker
from lanestream.workers.ipc import (
    FrameDone,
    FrameJob,
    WorkerSetup,
    decode_message,
    encode_message,
    receive_bytes,
    receive_message,
)

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.images.decoding import ImageLimits
    from lanestream.inference.batcher import BatchReport
    from lanestream.workers.ipc import FrameOutcome


# How often free memory goes back to the system at most, so that a few large images do not occupy it for good.
_RETURN_MEMORY_S: Final = 5.0


class WorkerProcess:
    """The worker's end of the socket."""

    def __init__(self, channel: socket.socket, engine: Engine, limits: ImageLimits) -> None:
        self._channel = channel
        self._engine = engine
        self._batches: deque[BatchReport] = deque()
        self._worker = FrameWorker(engine.models, limits, self._batches.append)
        self._sending = threading.Lock()

    def serve(self) -> None:
        """Sends its capabilities, receives the number of threads, and processes frames until the socket is closed.

        Frames that are being processed then are left to their threads.
        """
        self._channel.sendall(encode_message(Capabilities.of(self._engine)))
        with suppress(EOFError, ConnectionError):
            threads = ThreadPoolExecutor(receive_message(self._channel))
            returned_at = time.monotonic()
            for number in count():
                # Goes on when a frame comes, or after a pause.
                select.select([self._channel], [], [], _RETURN_MEMORY_S)
                if time.monotonic() - returned_at >= _RETURN_MEMORY_S:
                    return_freed_memory()
                    returned_at = time.monotonic()
                threads.submit(self._process, number, receive_bytes(self._channel))

    def _process(self, number: int, message: bytearray) -> None:
        costs: list[float] = []
        outcome: FrameOutcome
        try:
            job: FrameJob = decode_message(message)
            session = self._engine.open_session(job.options)
            session.restore(job.state)
            outcome = self._worker.process(session, job.frame, costs.append), session.state
        except BaseException as error:  # whatever a thread of the executor would end with, silently
            outcome = portable(error)
        self._send(FrameDone(number, outcome, sum(costs)))

    def _send(self, done: FrameDone) -> None:
        with self._sending, suppress(ConnectionError):
            done = replace(done, batches=tuple(self._batches.popleft() for _ in range(len(self._batches))))
            try:
                message = encode_message(done)
            except Exception as error:  # the outcome can't be pickled
                message = encode_message(replace(done, outcome=portable(error)))
            self._channel.sendall(message)


def portable(error: BaseException) -> Exception:
    """Returns an error that can be pickled: a LanestreamError unchanged, any other as text with its traceback."""
    if isinstance(error, LanestreamError):
        return error
    readable = RuntimeError(f"{type(error).__name__}: {one_line(error)}")
    readable.add_note("".join(traceback.format_exception(error)))
    return readable


def main(descriptor: int) -> None:
    """Processes frames for the service at the other end of the socket `descriptor`."""
    # The service handles signals for the whole process group: it drains, and closes the socket when it is done.
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with socket.socket(fileno=descriptor) as channel, suppress(EOFError, ConnectionError):
        setup: WorkerSetup = receive_message(channel)
        logging.config.dictConfig(setup.log)
        cv2.setNumThreads(setup.opencv_threads)
        try:
            engine = setup.load()
        except Exception as error:
            channel.sendall(encode_message(portable(error)))
            return
        WorkerProcess(channel, engine, setup.limits).serve()
        # Nobody waits for the frames in progress, and a thread that hangs must not keep the process.
        os._exit(0)


if __name__ == "__main__":
    main(int(sys.argv[1]))
