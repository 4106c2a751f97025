"""Converts results into messages, the same way for HTTP, for streams and in process."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from lanestream.protocol import (
    CalibrationChangedModel,
    CalibrationModel,
    DepartureEventModel,
    DepartureModel,
    EgoModel,
    EventModel,
    LaneChangeModel,
    LaneModel,
    LanesMessage,
    LineModel,
    MarkingModel,
    Point,
    SceneCutModel,
    TimingModel,
)
from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES
from lanestream.road.curve import Curves
from lanestream.road.results import CalibrationChanged, DepartureEvent, EgoMeters, LaneChange, SceneCut

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lanestream.images.decoding import DecodedImage
    from lanestream.road.appearance import Appearance
    from lanestream.road.curve import FloatArray
    from lanestream.road.results import Calibration, Departure, EgoLane, Estimate, Event, FrameResult, LaneBoundary

_POINTS: Final = 24
# Decimals that keep a curve exact to a hundredth of a pixel over the tallest accepted image.
_HORIZON_DECIMALS: Final = 4
_COEFFICIENT_DECIMALS: Final = (4, 7, 4)
# Decimals that keep a point on the road exact to a millimeter at a distance of a hundred meters.
_GROUND_DECIMALS: Final = (8, 6, 4)

_PROBABILITY_DECIMALS: Final = 4
_TIME_DECIMALS: Final = 6
_DEGREE_DECIMALS: Final = 3


@dataclass(frozen=True)
class ProcessedFrame:
    """A processed frame: the (width, height) of its image file, and its result in pixels of that file, with timing."""

    size: tuple[int, int]
    result: FrameResult

    @classmethod
    def of(cls, picture: DecodedImage, result: FrameResult, timing_ms: dict[str, float]) -> ProcessedFrame:
        """Converts a `result` in pixels of the decoded image, which may be smaller than the file's."""
        return cls(picture.size, replace(result.to_image(picture.scaling), timing_ms=timing_ms))


def lanes_message(frame: ProcessedFrame, *, seq: int, timestamp: float, dropped: int = 0) -> LanesMessage:
    """Returns the message for `frame`; `timestamp` is in seconds on the client's clock."""
    width, height = frame.size
    result = frame.result
    return LanesMessage(
        seq=seq,
        timestamp=timestamp,
        width=width,
        height=height,
        horizon=round(result.horizon, 2),
        lanes=[_lane(lane, points) for lane, points in zip(result.lanes, _points(result.lanes), strict=True)],
        ego=_ego(result.ego),
        departure=None if result.departure is None else _departure(result.departure),
        calibration=None if result.calibration is None else _calibration(result.calibration),
        events=[_event(event) for event in result.events],
        dropped=dropped,
        timing_ms=TimingModel(**{stage: round(ms, 3) for stage, ms in result.timing_ms.items()}),
    )


def _lane(lane: LaneBoundary, points: list[Point]) -> LaneModel:
    road_edge = lane.appearance.road_edge
    return LaneModel(
        track_id=lane.track_id,
        position=lane.position,
        state=lane.state,
        probability=round(lane.probability, _PROBABILITY_DECIMALS),
        kind=lane.appearance.kind,
        kind_probability=round(max(road_edge, 1.0 - road_edge), _PROBABILITY_DECIMALS),
        marking=_marking(lane.appearance),
        points=points,
        line=LineModel(bottom=points[0], top=points[-1]),
        horizon=round(lane.curve.horizon, _HORIZON_DECIMALS),
        coefficients=_rounded(lane.curve.coefficients, _COEFFICIENT_DECIMALS),
        covariance=_significant(lane.covariance),
        age_s=round(lane.age_s, 3),
        ground=None if lane.ground is None else _rounded(lane.ground, _GROUND_DECIMALS),
        ground_covariance=None if lane.ground_covariance is None else _significant(lane.ground_covariance),
    )


def _marking(appearance: Appearance) -> MarkingModel | None:
    """Returns the most probable type and color; None of a road edge, or if they are not classified."""
    if appearance.kind == "road_edge" or appearance.types is None or appearance.colors is None:
        return None
    of_type, of_color = max(appearance.types), max(appearance.colors)
    return MarkingModel(
        type=MARKING_TYPES[appearance.types.index(of_type)],
        type_probability=round(of_type, _PROBABILITY_DECIMALS),
        color=MARKING_COLORS[appearance.colors.index(of_color)],
        color_probability=round(of_color, _PROBABILITY_DECIMALS),
        probability=round(of_type * of_color, _PROBABILITY_DECIMALS),
    )


def _rounded(values: tuple[float, float, float], decimals: tuple[int, int, int]) -> tuple[float, float, float]:
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


def _ego(ego: EgoLane) -> EgoModel:
    meters = ego.meters or EgoMeters()
    return EgoModel(
        left=ego.left,
        right=ego.right,
        left_kind=ego.left_kind,
        right_kind=ego.right_kind,
        **_estimate("offset", ego.offset, 4),
        **_estimate("offset_m", meters.offset, 3),
        **_estimate("lane_width_m", meters.lane_width, 3),
        **_estimate("heading", meters.heading, 6),
        **_estimate("curvature", meters.curvature, 8),
        **_estimate("lateral_speed", meters.lateral_speed, 3),
    )


def _estimate(name: str, estimate: Estimate | None, decimals: int) -> dict[str, float | None]:
    """Returns the fields of an estimate: its value and its sigma."""
    if estimate is None:
        return {name: None, f"{name}_sigma": None}
    return {name: round(estimate.value, decimals), f"{name}_sigma": round(estimate.sigma, decimals)}


def _departure(departure: Departure) -> DepartureModel:
    time_s = departure.time_to_crossing
    return DepartureModel(
        state=departure.state, side=departure.side, time_to_crossing=None if time_s is None else round(time_s, 3)
    )


def _calibration(calibration: Calibration) -> CalibrationModel:
    return CalibrationModel(
        pitch=round(calibration.pitch.value, _DEGREE_DECIMALS),
        pitch_sigma=round(calibration.pitch.sigma, _DEGREE_DECIMALS),
        yaw=round(calibration.yaw.value, _DEGREE_DECIMALS),
        yaw_sigma=round(calibration.yaw.sigma, _DEGREE_DECIMALS),
        settled=calibration.settled,
    )


def _event(event: Event) -> EventModel:
    timestamp = round(event.timestamp, _TIME_DECIMALS)
    match event:
        case LaneChange():
            return LaneChangeModel(track_id=event.track_id, direction=event.direction, timestamp=timestamp)
        case DepartureEvent():
            return DepartureEventModel(state=event.state, side=event.side, track_id=event.track_id, timestamp=timestamp)
        case CalibrationChanged():
            return CalibrationChangedModel(
                pitch=round(event.pitch, _DEGREE_DECIMALS), yaw=round(event.yaw, _DEGREE_DECIMALS), timestamp=timestamp
            )
        case SceneCut():
            return SceneCutModel(timestamp=timestamp)
