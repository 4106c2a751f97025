"""Converts ROS messages to what the client of Lanestream takes, and its results to ROS messages.

Nothing here imports ROS: messages are used by their fields, and `MessageTypes` has the classes of those to create.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from pydantic import ValidationError

from lanestream_client import CameraModel, SourceFrame

if TYPE_CHECKING:
    from lanestream.protocol import LaneModel, LanesMessage

# Channels by encoding, and the order of the first three that makes BGR.
_ENCODINGS: Final = {
    "bgr8": (3, (0, 1, 2)),
    "rgb8": (3, (2, 1, 0)),
    "bgra8": (4, (0, 1, 2)),
    "rgba8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
}
_FILE_STARTS: Final = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF")  # JPEG, PNG, WebP
_DISTORTION_MODEL: Final = "plumb_bob"

_STATES: Final = {"detected": "DETECTED", "inferred": "INFERRED", "predicted": "PREDICTED"}
_KINDS: Final = {"marking": "MARKING", "road_edge": "ROAD_EDGE"}
_MARKING_TYPES: Final = {"solid": "SOLID", "dashed": "DASHED", "double": "DOUBLE", "dots": "DOTS"}
_COLORS: Final = {"white": "WHITE", "yellow": "YELLOW"}
_DEPARTURES: Final = {"none": "NO_DEPARTURE", "warning": "WARNING", "crossed": "CROSSED"}
_SIDES: Final = {None: "NO_SIDE", "left": "LEFT", "right": "RIGHT"}

# Markers show boundaries between these distances ahead of the camera (meters).
_NEAREST: Final = 3.0
_FARTHEST: Final = 40.0
_MARKER_POINTS: Final = 20
_MARKER_LIFETIME_NS: Final = 500_000_000
_RGB: Final = {"white": (1.0, 1.0, 1.0), "yellow": (1.0, 0.8, 0.0), "edge": (0.2, 0.8, 0.3)}


class ConversionError(ValueError):
    """A message can't be used; the text says why and what is accepted."""


@dataclass(frozen=True)
class MessageTypes:
    """The classes of the messages to create: lanestream_msgs' Lanes and Lane, and those of other packages."""

    lanes: Any
    lane: Any
    point32: Any
    point: Any
    marker: Any
    marker_array: Any


def frame_of_image(message: Any, seq: int) -> SourceFrame:
    """Returns the frame in a sensor_msgs/Image. Raises ConversionError for other encodings and missing bytes.

    Rows may be padded: `step` is their length in bytes.
    """
    if message.encoding not in _ENCODINGS:
        raise ConversionError(f"encoding {message.encoding!r} is not accepted; use {', '.join(_ENCODINGS)}")
    channels, order = _ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(message.data, np.uint8)
    if not (height and width) or step < width * channels or len(data) < height * step:
        raise ConversionError(f"{len(data)} bytes are not {height} rows of {width} pixels in steps of {step}")
    rows = data[: height * step].reshape(height, step)[:, : width * channels]
    pixels = rows.reshape(height, width, channels)[:, :, order]
    return SourceFrame(seq, timestamp_of(message.header.stamp), pixels=np.ascontiguousarray(pixels))


def frame_of_compressed_image(message: Any, seq: int) -> SourceFrame:
    """Returns the frame in a sensor_msgs/CompressedImage, without decoding it. Raises ConversionError."""
    data = bytes(message.data)
    if not data.startswith(_FILE_STARTS):
        raise ConversionError(f"format {message.format!r} is not accepted; use JPEG, PNG or WebP")
    return SourceFrame(seq, timestamp_of(message.header.stamp), data=data)


def timestamp_of(stamp: Any) -> float | None:
    """Returns a builtin_interfaces/Time in seconds, or None for zero, which means that the camera sets no time."""
    return None if stamp.sec == 0 and stamp.nanosec == 0 else float(stamp.sec + 1e-9 * stamp.nanosec)


def camera_of_parameters(height: float, field_of_view: float, pitch: str) -> CameraModel:
    """Returns a camera `height` meters above the road with a horizontal `field_of_view` in degrees.

    `pitch` is in degrees that the camera looks down, or "auto". Raises ConversionError.
    """
    return _camera({"height": height, "field_of_view": field_of_view, "pitch": _pitch(pitch)})


def camera_of_info(message: Any, height: float, pitch: str, *, rectified: bool) -> CameraModel:
    """Returns the camera that a sensor_msgs/CameraInfo describes, `height` meters above the road.

    `pitch` is as for `camera_of_parameters`. For `rectified` images the projection matrix applies, without distortion.
    Raises ConversionError if the camera is not calibrated or the lens has another model.
    """
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.width or message.roi.height:
        raise ConversionError("binning and regions of interest in CameraInfo are not accepted; publish full images")
    matrix = np.asarray(message.p, float).reshape(3, 4) if rectified else np.asarray(message.k, float).reshape(3, 3)
    focal, center = (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2])
    if min(focal) <= 0.0:
        raise ConversionError("CameraInfo has no focal length; calibrate the camera, or set field_of_view")
    distortion = [0.0] * 5
    if not rectified and any(message.d):
        if message.distortion_model != _DISTORTION_MODEL or len(message.d) != len(distortion):
            raise ConversionError(
                f"distortion model {message.distortion_model!r} is not accepted; use {_DISTORTION_MODEL}, or rectified"
                " images"
            )
        distortion = list(message.d)
    return _camera(
        {
            "height": height,
            "focal_length": focal,
            "principal_point": center,
            "image_size": (message.width, message.height),
            "distortion": tuple(distortion),
            "pitch": _pitch(pitch),
        }
    )


def _camera(values: dict[str, Any]) -> CameraModel:
    try:
        return CameraModel.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = str(first["loc"][0]) if first["loc"] else "the geometry"
        raise ConversionError(f"{name} of the camera is not accepted: {first['msg']}") from None


def _pitch(text: str) -> float | Literal["auto"]:
    if text == "auto":
        return "auto"
    try:
        return float(text)
    except ValueError:
        raise ConversionError(f"camera_pitch is {text!r}; give degrees that the camera looks down, or auto") from None


def lanes_message(lanes: LanesMessage, header: Any, ground_frame: str, types: MessageTypes) -> Any:
    """Returns the lanestream_msgs/Lanes of a result, with the `header` of its image."""
    message = types.lanes()
    message.header = header
    message.ground_frame_id = ground_frame
    message.width, message.height, message.horizon = lanes.width, lanes.height, lanes.horizon
    message.lanes = [_lane(lane, types) for lane in lanes.lanes]
    ego = lanes.ego
    # The service counts offset and lateral speed to the right, ROS to the left.
    message.offset = -_or_nan(ego.offset_m)
    message.lane_width = _or_nan(ego.lane_width_m)
    message.heading = _or_nan(ego.heading)
    message.curvature = _or_nan(ego.curvature)
    message.lateral_speed = -_or_nan(ego.lateral_speed)
    departure = lanes.departure
    message.departure = getattr(types.lanes, _DEPARTURES["none" if departure is None else departure.state])
    message.departure_side = getattr(types.lanes, _SIDES[None if departure is None else departure.side])
    message.time_to_crossing = _or_nan(None if departure is None else departure.time_to_crossing)
    return message


def _lane(lane: LaneModel, types: MessageTypes) -> Any:
    message = types.lane()
    message.track_id, message.position = lane.track_id, lane.position
    message.state = getattr(types.lane, _STATES[lane.state])
    message.probability, message.age = lane.probability, lane.age_s
    message.kind = getattr(types.lane, _KINDS[lane.kind])
    message.kind_probability = lane.kind_probability
    marking = lane.marking
    message.marking_type = types.lane.NO_TYPE if marking is None else getattr(types.lane, _MARKING_TYPES[marking.type])
    message.marking_type_probability = 0.0 if marking is None else marking.type_probability
    message.marking_color = types.lane.NO_COLOR if marking is None else getattr(types.lane, _COLORS[marking.color])
    message.marking_color_probability = 0.0 if marking is None else marking.color_probability
    message.points = [types.point32(x=float(x), y=float(y), z=0.0) for x, y in lane.points]
    message.horizon = lane.horizon
    message.coefficients = list(lane.coefficients)
    message.covariance = _row_by_row(lane.covariance)
    message.has_ground = lane.ground is not None
    message.ground = list(lane.ground or (0.0, 0.0, 0.0))
    message.ground_covariance = _row_by_row(lane.ground_covariance or [[0.0] * 3] * 3)
    return message


def markers_message(lanes: LanesMessage, stamp: Any, ground_frame: str, types: MessageTypes) -> Any:
    """Returns a visualization_msgs/MarkerArray that replaces the last one: the boundaries on the road, in meters.

    It only clears the last one if the camera is unknown.
    """
    clear = types.marker(action=types.marker.DELETEALL)
    clear.header.frame_id, clear.header.stamp = ground_frame, stamp
    markers = [clear]
    for lane in lanes.lanes:
        if lane.ground is None:
            continue
        marker = types.marker(ns="lanes", id=lane.track_id % (1 << 31), type=types.marker.LINE_STRIP)
        marker.action = types.marker.ADD
        marker.header.frame_id, marker.header.stamp = ground_frame, stamp
        marker.lifetime.nanosec = _MARKER_LIFETIME_NS
        marker.pose.orientation.w = 1.0
        marker.scale.x = 0.15 if abs(lane.position) == 1 else 0.08
        color = "edge" if lane.marking is None else lane.marking.color
        marker.color.r, marker.color.g, marker.color.b = _RGB[color]
        marker.color.a = 0.4 if lane.state == "predicted" else 1.0
        a, b, c = lane.ground
        for x in np.linspace(_NEAREST, _FARTHEST, _MARKER_POINTS).tolist():
            marker.points.append(types.point(x=x, y=(a * x + b) * x + c, z=0.0))
        markers.append(marker)
    return types.marker_array(markers=markers)


def _row_by_row(matrix: list[list[float]]) -> list[float]:
    return [float(value) for row in matrix for value in row]


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
