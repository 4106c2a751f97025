"""Processes a frame from the image file to its lanes, in the calling thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ExpiredError
from lanestream.images.decoding import ImageLimits, decode_reduced
from lanestream.inference.batcher import Batcher, BatchReport
from lanestream.messages import ProcessedFrame
from lanestream.road.view import WORKING_WIDTH
from lanestream.tracking.departure import VehicleMotion

if TYPE_CHECKING:
    from lanestream.detection.interface import ModelRole
    from lanestream.inference.batcher import RunnableModel
    from lanestream.session import Session

# A thread that used less of a network's time only waited while the network ran in another thread, or on a device. It
# may use somewhat less than all of it if it runs the network itself, because other programs interrupt it.
_WAITED_SHARE: Final = 0.25


@dataclass(frozen=True)
class EncodedFrame:
    """An image file, when it was captured (the client's seconds) and when it arrived (monotonic seconds).

    After `deadline` (monotonic seconds) its lanes are no longer needed; None means no deadline. `motion` is what the
    vehicle reported with it.
    """

    data: bytes
    timestamp: float
    arrived: float
    deadline: float | None = None
    motion: VehicleMotion = VehicleMotion()


class FrameWorker:
    """Processes frames, each in the calling thread; all inference requests go to one batcher.

    `models` are the models by their roles. `observe`, if given, gets the report of every batch.
    """

    def __init__(
        self,
        models: Mapping[ModelRole, RunnableModel],
        limits: ImageLimits,
        observe: Callable[[BatchReport], None] | None = None,
    ) -> None:
        self._models = models
        self._limits = limits
        self._batcher = Batcher(observe)

    def process(self, session: Session, frame: EncodedFrame, charge: Callable[[float], None]) -> ProcessedFrame:
        """Returns the lanes of `frame`. Frames of one session must be processed one at a time.

        Calls `charge` with the processor time that it took (seconds), whether it succeeds or not. Raises ImageError if
        the file is refused, ExpiredError if its deadline passes before the networks run; the session then stays as it
        was.
        """
        inference = _MeasuredInference(self._batcher, self._models, frame.deadline)
        started = time.thread_time()
        try:
            return self._process(session, frame, inference)
        finally:
            charge(time.thread_time() - started + inference.elsewhere_s)

    def close(self) -> None:
        """Ends the batcher's thread after the waiting requests have run."""
        self._batcher.close()

    def _process(self, session: Session, frame: EncodedFrame, inference: _MeasuredInference) -> ProcessedFrame:
        started = time.monotonic()
        if frame.deadline is not None and frame.deadline < started:
            raise ExpiredError()
        picture = decode_reduced(frame.data, self._limits, WORKING_WIDTH)
        decoded = time.monotonic()
        result = session.process(picture.image, frame.timestamp, inference, frame.motion, picture.size)
        total = 1e3 * (time.monotonic() - frame.arrived)
        stages = {"decode": 1e3 * (decoded - started), "infer": 1e3 * inference.ran_s, **result.timing_ms}
        timing = {**stages, "queue": max(0.0, total - sum(stages.values())), "total": total}
        return ProcessedFrame.of(picture, result, timing)


class _MeasuredInference:
    """Runs the inference requests of one frame. Sums up the seconds that the networks ran for it.

    `elsewhere_s` is the part of them that the calling thread only waited for.
    """

    def __init__(self, batcher: Batcher, models: Mapping[ModelRole, RunnableModel], deadline: float | None) -> None:
        self._batcher, self._models, self._deadline = batcher, models, deadline
        self.ran_s = self.elsewhere_s = 0.0

    def __call__(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        called, cpu = time.monotonic(), time.thread_time()
        result = self._batcher.run(self._models[role], inputs, self._deadline)
        # Waiting for other batches counts as queueing.
        ran_s = result.ended - max(result.started, called)
        self.ran_s += ran_s
        if time.thread_time() - cpu < _WAITED_SHARE * ran_s:
            self.elsewhere_s += ran_s
        return result.outputs
