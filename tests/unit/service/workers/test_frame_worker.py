"""What a frame is charged, in one thread and without a service around it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import cast

import fakes
import loading
import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.detection.interface import Infer
from lanestream.errors import ExpiredError, ImageError
from lanestream.images.decoding import ImageLimits
from lanestream.road.results import EgoLane, FrameResult
from lanestream.road.view import Image
from lanestream.session import Session
from lanestream.tracking.departure import VehicleMotion
from lanestream.workers.frame_worker import EncodedFrame, FrameWorker


class ActingModel(fakes.FakeModel):
    """Calls a function in each run."""

    def __init__(self, act: Callable[[], None]) -> None:
        self._act = act

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._act()
        return super().run(inputs)


@pytest.mark.parametrize("act", [loading.work, loading.sleep])
def test_a_frame_is_charged_once_for_a_network_that_runs_in_its_thread_or_on_a_device(act: Callable[[], None]) -> None:
    engine, charges = fakes.engine(ActingModel(act)), list[float]()
    worker = FrameWorker(engine.models, ImageLimits())
    frame = EncodedFrame(fakes.image_file(), 0.0, time.monotonic())
    worker.process(engine.open_session(), frame, charges.append)
    worker.close()
    (charge,) = charges
    assert loading.SLOW_S <= charge < 1.8 * loading.SLOW_S


class RecordingSession:
    """Finds nothing, and records the motion of each frame."""

    def __init__(self) -> None:
        self.motions: list[VehicleMotion] = []

    def process(self, image: Image, timestamp: float, infer: Infer, motion: VehicleMotion, *_: object) -> FrameResult:
        self.motions.append(motion)
        return FrameResult((), EgoLane(), 0.0)


def test_the_session_gets_the_motion_of_a_frame() -> None:
    worker, session = FrameWorker(fakes.engine().models, ImageLimits()), RecordingSession()
    motions = [VehicleMotion(24.5, "left"), VehicleMotion()]
    for motion in motions:
        frame = EncodedFrame(fakes.image_file(), 0.0, time.monotonic(), motion=motion)
        worker.process(cast("Session", session), frame, lambda _: None)
    worker.close()
    assert session.motions == motions


@pytest.mark.parametrize(("data", "deadline", "kind"), [(b"text", None, ImageError), (b"", 0.0, ExpiredError)])
def test_a_frame_that_fails_is_charged_too(data: bytes, deadline: float | None, kind: type[Exception]) -> None:
    engine, charges = fakes.engine(), list[float]()
    worker = FrameWorker(engine.models, ImageLimits())
    with pytest.raises(kind):
        worker.process(engine.open_session(), EncodedFrame(data, 0.0, 0.0, deadline), charges.append)
    worker.close()
    assert len(charges) == 1
