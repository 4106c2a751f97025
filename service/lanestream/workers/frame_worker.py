"""Processes a frame from the image file to its lanes, in the calling thread."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lanestream.errors import ExpiredError
from lanestream.images.decoding import ImageLimits, decode_reduced
from lanestream.inference.batcher import Batcher, BatchReport
from lanestream.messages import ProcessedFrame
from lanestream.road.view import WORKING_WIDTH

if TYPE_CHECKING:
    from lanestream.detection.interface import ModelRole
    from lanestream.inference.batcher import RunnableModel
    from lanestream.session import Session


@dataclass(frozen=True)
class EncodedFrame:
    """An image file, when it was captured (the client's seconds) and when it arrived (monotonic seconds).

    After `deadline` (monotonic seconds) its lanes are no longer needed; None means no deadline.
    """

    data: bytes
    timestamp: float
    arrived: float
    deadline: float | None = None


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

    def process(self, session: Session, frame: EncodedFrame) -> ProcessedFrame:
        """Returns the lanes of `frame`. Frames of one session must be processed one at a time.

        Raises ImageError if the file is refused, ExpiredError if its deadline passes before the networks run; the
        session then stays as it was.
        """
        started = time.monotonic()
        if frame.deadline is not None and frame.deadline < started:
            raise ExpiredError()
        picture = decode_reduced(frame.data, self._limits, WORKING_WIDTH)
        decoded = time.monotonic()
        infer_s = 0.0

        def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
            nonlocal infer_s
            since = time.monotonic()
            result = self._batcher.run(self._models[role], inputs, frame.deadline)
            # Waiting for other batches counts as queueing.
            infer_s += result.ended - max(result.started, since)
            return result.outputs

        result = session.process(picture.image, frame.timestamp, infer)
        total = 1e3 * (time.monotonic() - frame.arrived)
        stages = {"decode": 1e3 * (decoded - started), "infer": 1e3 * infer_s, **result.timing_ms}
        timing = {**stages, "queue": max(0.0, total - sum(stages.values())), "total": total}
        return ProcessedFrame.of(picture, result, timing)

    def close(self) -> None:
        """Ends the batcher's thread after the waiting requests have run."""
        self._batcher.close()
