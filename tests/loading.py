"""Functions by which worker processes load an engine; most of them fail."""

from __future__ import annotations

import os
import signal

import fakes
import numpy as np
from numpy.typing import NDArray

from lanestream.engine import Engine
from lanestream.errors import ModelError


class KillingModel(fakes.FakeModel):
    """Kills its process in the first run."""

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        os.kill(os.getpid(), signal.SIGKILL)
        return super().run(inputs)


def killing() -> Engine:
    return fakes.engine(KillingModel())


def missing() -> Engine:
    raise ModelError("no model file at x", "give one")


def broken() -> Engine:
    raise OSError("the disk is broken")


def silent() -> Engine:
    os._exit(3)
