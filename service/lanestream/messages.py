"""From results to messages: the one way in which lanes are told, over HTTP, over a stream and in process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from lanestream.protocol import (
    EgoModel,
    LaneChangeModel,
    LaneModel,
    LanesMessage,
    LineModel,
    Point,
    TimingModel,
)

if TYPE_CHECKING:
    from lanestream.lanes import FloatArray, FrameResult, Image, LaneBoundary

_POINTS: Final = 24
# Decimals that keep a curve exact to a hundredth of a pixel over the tallest image that is accepted.
_HORIZON_DECIMALS: Final = 4
_COEFFICIENT_DECIMALS: Final = (4, 7, 4)


@dataclass(frozen=True)
class ProcessedFrame:
    """A frame at the end of its way: the decoded BGR image (H, W, 3) uint8 and its lanes, with all stages' timing."""

    image: Image
    result: FrameResult


def lanes_message(frame: ProcessedFrame, *, seq: int, timestamp: float, dropped: int = 0) -> LanesMessage:
    """The message about `frame`; `timestamp` in seconds on the client's clock."""
    height, width = frame.image.shape[:2]
    result = frame.result
    return LanesMessage(
        seq=seq,
        timestamp=timestamp,
        width=width,
        height=height,
        horizon=round(result.horizon, 2),
        lanes=[_lane(lane) for lane in result.lanes],
        ego=_ego(result),
        events=[LaneChangeModel(track_id=event.track_id, direction=event.direction) for event in result.events],
        dropped=dropped,
        timing_ms=TimingModel(**{stage: round(ms, 3) for stage, ms in result.timing_ms.items()}),
    )


def _lane(lane: LaneBoundary) -> LaneModel:
    points = _points(lane)
    v, b, k = (
        round(value, decimals) for value, decimals in zip(lane.curve.coefficients, _COEFFICIENT_DECIMALS, strict=True)
    )
    return LaneModel(
        track_id=lane.track_id,
        position=lane.position,
        state=lane.state,
        probability=round(lane.probability, 4),
        points=points,
        line=LineModel(bottom=points[0], top=points[-1]),
        horizon=round(lane.curve.horizon, _HORIZON_DECIMALS),
        coefficients=(v, b, k),
        covariance=_significant(lane.covariance),
        age_s=round(lane.age_s, 3),
    )


def _points(lane: LaneBoundary) -> list[Point]:
    # Rounded rows first, so that the points are on the curve.
    rows = np.linspace(lane.bottom, lane.top, _POINTS).round(2)
    columns = lane.curve.x(rows)
    return [(round(float(x), 2), float(y)) for x, y in zip(columns, rows, strict=True)]


def _significant(matrix: FloatArray) -> list[list[float]]:
    return [[float(f"{value:.6g}") for value in row] for row in matrix]


def _ego(result: FrameResult) -> EgoModel:
    offset = result.ego.offset
    return EgoModel(left=result.ego.left, right=result.ego.right, offset=None if offset is None else round(offset, 4))
