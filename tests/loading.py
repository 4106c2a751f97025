"""Functions by which worker processes load an engine; most of them fail, or load one that fails."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

import fakes
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.engine import Engine
from lanestream.errors import ImageError, ModelError
from lanestream.road.view import Image

SLOW_S = 0.2


class KillingModel(fakes.FakeModel):
    """Kills its process in the first run."""

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        kill()
        return super().run(inputs)


class ObeyingDetector(fakes.FakeDetector):
    """Does what the shade of a frame says, see `frame_that`; processes any other frame."""

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        act = dict(enumerate(ACTS)).get(round(float(image.mean())) // 10)
        if act is not None and image.std() < 1.0:
            act()
        return super().detect(image, context, infer)


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def kill_later() -> None:
    time.sleep(SLOW_S)
    kill()


def sleep() -> None:
    time.sleep(SLOW_S)


def hang() -> None:
    time.sleep(600.0)


def stop_after_closing_the_socket() -> None:
    """Looks to the service as if the process had ended."""
    with socket.socket(fileno=os.dup(int(sys.argv[1]))) as channel:
        channel.shutdown(socket.SHUT_WR)
    os.kill(os.getpid(), signal.SIGSTOP)


def work() -> None:
    """Uses processor time for as long as `sleep` takes."""
    ends = time.thread_time() + SLOW_S
    while time.thread_time() < ends:
        pass


def work_and_fail() -> None:
    work()
    raise ImageError("it is not good enough")


def exit_the_thread() -> None:
    raise SystemExit(7)


def recurse() -> None:
    recurse()


def raise_what_cannot_be_sent() -> None:
    error = ImageError("it has an unusual attribute")
    error.hint = lambda: "functions without a name can't be pickled"  # type: ignore[assignment]
    raise error


ACTS = (
    kill,
    kill_later,
    sleep,
    hang,
    stop_after_closing_the_socket,
    work,
    work_and_fail,
    exit_the_thread,
    recurse,
    raise_what_cannot_be_sent,
)


def frame_that(act: Callable[[], None]) -> bytes:
    """Returns an image file at which an `ObeyingDetector` does this."""
    return fakes.image_file(shade=10 * ACTS.index(act) + 5)


class Undecodable:
    """Can be sent, but not received."""

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        return raise_memory_error, ()


def raise_memory_error() -> None:
    raise MemoryError("no memory is left")


def obeying() -> Engine:
    return fakes.engine(detector=ObeyingDetector())


def killing() -> Engine:
    return fakes.engine(KillingModel())


def missing() -> Engine:
    raise ModelError("no model file at x", "give one")


def broken() -> Engine:
    raise OSError("the disk is broken")


def out_of_memory() -> Engine:
    raise MemoryError("no memory is left")


def hanging() -> Engine:
    hang()
    return fakes.engine()


def silent() -> Engine:
    os._exit(3)


def failing_once(load: Callable[[], Engine], folder: Path) -> Engine:
    """Loads an engine that obeys, except the second time, which is left to `load`. `folder` is empty at first."""
    starts = len(list(folder.iterdir()))
    (folder / str(starts)).touch()
    return load() if starts == 1 else obeying()
