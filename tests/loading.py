"""Engines that worker processes load, or fail to."""

from __future__ import annotations

import os
import signal

import fakes
import numpy as np
from numpy.typing import NDArray

from lanestream.engine import Engine
from lanestream.errors import ModelError


class Deadly(fakes.FakeNetwork):
    """Ends its process at once."""

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        os.kill(os.getpid(), signal.SIGKILL)
        return super().run(inputs)


def deadly() -> Engine:
    return fakes.engine(Deadly())


def missing() -> Engine:
    raise ModelError("no model file at x", "give one")


def broken() -> Engine:
    raise OSError("no such luck")


def silent() -> Engine:
    os._exit(3)
