"""A frame on its way from question to question, and how long each stage of that took."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Question, Steps

if TYPE_CHECKING:
    from lanestream.road.results import FrameResult


class FrameWalk:
    """Goes through the steps of one frame, with the time that its own work took, without that of the networks.

    What comes before the last answer is proposing, what comes after it is tracking.
    """

    def __init__(self, steps: Steps[FrameResult]) -> None:
        self._steps = steps
        self._result: FrameResult | None = None
        self._spent: list[float] = []

    @property
    def result(self) -> FrameResult:
        """What the steps came to. Only to be asked for after the last question."""
        assert self._result is not None  # noqa: S101 - a question was left unanswered
        return self._result

    @property
    def timing_ms(self) -> dict[str, float]:
        """Milliseconds of the stages `propose` and `track`."""
        return {"propose": 1e3 * sum(self._spent[:-1]), "track": 1e3 * self._spent[-1]}

    def go(self, answer: NDArray[np.float32] | None = None) -> Question | None:
        """Goes on with the answer to the last question, with none to begin; the next question, None after the last."""
        started = time.perf_counter()
        try:
            return next(self._steps) if answer is None else self._steps.send(answer)
        except StopIteration as end:
            self._result = end.value
            return None
        finally:
            self._spent.append(time.perf_counter() - started)
