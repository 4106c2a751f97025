"""Converts results into messages, the same way for HTTP, for streams and in process."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean
from typing import TYPE_CHECKING, Final

import numpy as np

from lanestream.protocol import (
    CameraModel,
    EgoModel,
    LaneChangeModel,
    LaneModel,
    LanesMessage,
    LineModel,
    Point,
    TimingModel,
)
from lanestream.road.camera import Camera
from lanestream.road.curve import Curves

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lanestream.images.decoding import DecodedImage
    from lanestream.road.curve import FloatArray
    from lanestream.road.results import EgoLane, FrameResult, LaneBoundary

_POINTS: Final = 24
# Decimals that keep a curve exact to a hundredth of a pixel over the tallest accepted image.
_HORIZON_DECIMALS: Final = 4
_COEFFICIENT_DECIMALS: Final = (4, 7, 4)
# Decimals that keep a point on the road exact to a millimeter at a distance of a hundred meters.
_GROUND_DECIMALS: Final = (8, 6, 4)

GroundCurve = tuple[float, float, float]


@dataclass(frozen=True)
class ProcessedFrame:
    """A processed frame: the (width, height) of its image file, and its result in pixels of that file, with timing."""

    size: tuple[int, int]
    result: FrameResult

    @classmethod
    def of(cls, picture: DecodedImage, result: FrameResult, timing_ms: dict[str, float]) -> ProcessedFrame:
        """Converts a `result` in pixels of the decoded image, which may be smaller than the file's."""
        return cls(picture.size, replace(result.to_image(picture.scaling), timing_ms=timing_ms))


def lanes_message(
    frame: ProcessedFrame, *, seq: int, timestamp: float, dropped: int = 0, camera: CameraModel | None = None
) -> LanesMessage:
    """Returns the message for `frame`; `timestamp` is in seconds on the client's clock. A `camera` adds meters."""
    width, height = frame.size
    result = frame.result
    grounds = {} if camera is None else _grounds(result, Camera(camera.height, camera.field_of_view), width)
    return LanesMessage(
        seq=seq,
        timestamp=timestamp,
        width=width,
        height=height,
        horizon=round(result.horizon, 2),
        lanes=[
            _lane(lane, points, grounds.get(lane.track_id))
            for lane, points in zip(result.lanes, _points(result.lanes), strict=True)
        ],
        ego=_ego(result.ego, grounds),
        events=[LaneChangeModel(track_id=event.track_id, direction=event.direction) for event in result.events],
        dropped=dropped,
        timing_ms=TimingModel(**{stage: round(ms, 3) for stage, ms in result.timing_ms.items()}),
    )


def _grounds(result: FrameResult, camera: Camera, width: int) -> dict[int, GroundCurve]:
    """Returns the ground parabola of each lane by track id."""
    return {lane.track_id: camera.ground(lane.curve, width) for lane in result.lanes}


def _lane(lane: LaneBoundary, points: list[Point], ground: GroundCurve | None) -> LaneModel:
    return LaneModel(
        track_id=lane.track_id,
        position=lane.position,
        state=lane.state,
        probability=round(lane.probability, 4),
        points=points,
        line=LineModel(bottom=points[0], top=points[-1]),
        horizon=round(lane.curve.horizon, _HORIZON_DECIMALS),
        coefficients=_rounded(lane.curve.coefficients, _COEFFICIENT_DECIMALS),
        covariance=_significant(lane.covariance),
        age_s=round(lane.age_s, 3),
        ground=None if ground is None else _rounded(ground, _GROUND_DECIMALS),
    )


def _rounded(values: GroundCurve, decimals: tuple[int, int, int]) -> GroundCurve:
    a, b, c = (round(value, digits) for value, digits in zip(values, decimals, strict=True))
    return a, b, c


def _points(lanes: Sequence[LaneBoundary]) -> list[list[Point]]:
    """Returns the points of each lane, from its lowest row to its highest."""
    if not lanes:
        return []
    ends = np.array([(lane.bottom, lane.top) for lane in lanes])
    # Rows are rounded before the columns are computed, so that the points lie on the curve.
    rows = np.linspace(ends[:, 0], ends[:, 1], _POINTS, axis=1).round(2)
    columns = Curves.of([lane.curve for lane in lanes]).x(rows).round(2)
    return [[(x, y) for x, y in lane] for lane in np.stack([columns, rows], axis=-1).tolist()]


def _significant(matrix: FloatArray) -> list[list[float]]:
    return [[float(f"{value:.6g}") for value in row] for row in matrix]


def _ego(ego: EgoLane, grounds: dict[int, GroundCurve]) -> EgoModel:
    model = EgoModel(left=ego.left, right=ego.right, offset=None if ego.offset is None else round(ego.offset, 4))
    sides = [grounds[track] for track in (ego.left, ego.right) if track in grounds]
    if not sides:
        return model
    a, b, c = (fmean(values) for values in zip(*sides, strict=True))
    in_meters = {"heading": round(math.atan(b), 6), "curvature": round(2.0 * a, 8)}
    if len(sides) == 2:
        # Y points left: a lane center at +c means that the camera is c to the right of it.
        in_meters |= {"offset_m": round(c, 3), "lane_width_m": round(sides[0][2] - sides[1][2], 3)}
    return model.model_copy(update=in_meters)
