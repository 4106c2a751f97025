"""Values in meters and the estimated direction of the camera, against the truth, with the true camera given."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lanestream_exporter.evaluation.tracking.comparison import ClipRun, FrameComparison, rounded

# An estimated direction of the camera counts from this many seconds after the start of a clip.
_SETTLED_S: Final = 20.0


@dataclass(frozen=True)
class _Quantity:
    """A value of the ego lane: its name in reports, the factor to its unit, and how to get the truth and the answer.

    Values that need both boundaries are compared only where both are followed in their role.
    """

    name: str
    factor: float
    truth: Callable[[FrameComparison], float | None]
    answer: Callable[[FrameComparison], float | None]
    needs_both: bool


_QUANTITIES: Final = (
    _Quantity("offset_cm", 100.0, lambda f: f.truth.ego.offset, lambda f: f.answer.ego.offset, True),
    _Quantity("lane_width_cm", 100.0, lambda f: f.truth.ego.lane_width, lambda f: f.answer.ego.lane_width, True),
    _Quantity("heading_deg", math.degrees(1.0), lambda f: f.truth.ego.heading, lambda f: f.answer.ego.heading, False),
    _Quantity("curvature_per_m", 1.0, lambda f: f.truth.ego.curvature, lambda f: f.answer.ego.curvature, False),
)


def meter_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns rms and bias of the errors in meters and degrees; see docs/evaluation.md."""
    return {
        quantity.name: _error_figures([error for run in runs for error in _errors(run, quantity)], digits=6)
        for quantity in _QUANTITIES
    }


def calibration_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the errors of the camera's estimated pitch and yaw, 20 seconds after the start of a clip or later."""
    errors = np.array([error for run in runs for error in _calibration_errors(run)]).reshape(-1, 2)
    return {"pitch_deg": _error_figures(errors[:, 0].tolist()), "yaw_deg": _error_figures(errors[:, 1].tolist())}


def _error_figures(errors: Sequence[float], digits: int = 4) -> dict[str, Any]:
    values = np.asarray(errors)
    return {
        "values": len(values),
        "rms": rounded(float(np.sqrt(np.mean(values**2))), digits) if len(values) else None,
        "bias": rounded(float(values.mean()), digits) if len(values) else None,
    }


def _errors(run: ClipRun, quantity: _Quantity) -> Iterator[float]:
    for frame in run.frames:
        true, answered = quantity.truth(frame), quantity.answer(frame)
        if true is not None and answered is not None and (not quantity.needs_both or _ego_is_right(frame)):
            yield quantity.factor * (answered - true)


def _ego_is_right(frame: FrameComparison) -> bool:
    """Whether both boundaries of the reported ego lane follow those of the true one."""
    followed = {
        frame.truth.lanes[truth_index].position: frame.answer.lanes[index].track_id
        for truth_index, index in frame.pairs.items()
    }
    ego = frame.answer.ego.left, frame.answer.ego.right
    return None not in ego and ego == (followed.get(-1), followed.get(1))


def _calibration_errors(run: ClipRun) -> Iterator[tuple[float, float]]:
    for frame in run.frames:
        estimated, truth = frame.answer.calibration, frame.truth
        elapsed = truth.timestamp - run.frames[0].truth.timestamp
        if estimated is not None and truth.pitch is not None and truth.yaw is not None and elapsed >= _SETTLED_S:
            yield estimated[0] - truth.pitch, estimated[1] - truth.yaw
