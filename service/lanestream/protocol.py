"""The wire contract: the messages of `/v1/stream` and `/v1/detect`.

It imports pydantic and the standard library only, so that the client can share it. Coordinates are pixels of the image
that was sent (x right, y down, pixel centers at integers). Timestamps are seconds on the client's clock.

To add a message, define its model here and add it to `ClientMessage` or `ServerMessage`. The JSON Schemas and the
AsyncAPI document follow from that; `StreamProtocol` and the client give it its meaning.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from lanestream.errors import LanestreamError, ProtocolError, one_line

SUBPROTOCOL: Final = "lanestream.v1"
# The prefix of a second subprotocol that carries an API key: browsers can't set headers on a WebSocket.
KEY_SUBPROTOCOL: Final = "bearer."
# Larger JSON numbers are not read the same by every parser (RFC 8259, section 6).
MAX_SEQ: Final = 2**53 - 1
# The largest text message that the service reads, and the most values in it: parsing must stay cheap for any text.
MOST_TEXT_BYTES: Final = 1 << 16
_MOST_VALUES: Final = 64
# The highest speed of a vehicle in m/s that is accepted.
_MOST_SPEED: Final = 150.0

Point = tuple[float, float]
Mode = Literal["latest", "all"]
SessionName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
DetectorName = Literal["candidates", "regression"]
BoundaryKind = Literal["marking", "road_edge"]
Kinds = Annotated[tuple[BoundaryKind, ...], Field(min_length=1)]
MarkingType = Literal["solid", "dashed", "double", "dots"]
MarkingColor = Literal["white", "yellow"]
Side = Literal["left", "right"]
Indicator = Literal["off", "left", "right"]
WarningCode = Literal["timestamps_in_milliseconds", "timestamps_not_advancing"]
CameraHeight = Annotated[float, Field(ge=0.3, le=4.0, description="Height of the camera above the road in meters.")]
FieldOfView = Annotated[float, Field(ge=20.0, le=150.0, description="Horizontal field of view in degrees.")]
# A camera that looks down has its horizon above the image, up to this fraction of the height.
HIGHEST_HORIZON: Final = -0.6
Horizon = Annotated[float, Field(ge=HIGHEST_HORIZON, lt=1.0)]
Auto = Literal["auto"]
FocalLength = Annotated[float, Field(ge=10.0, le=1e5)]
ImageSide = Annotated[int, Field(ge=64, le=1 << 16)]
PixelCoordinate = Annotated[float, Field(ge=-1e5, le=1e5)]
DistortionCoefficient = Annotated[float, Field(ge=-100.0, le=100.0)]


class Message(BaseModel):
    """A JSON object on the wire. Unknown fields of what a service sends are ignored: a later version may add some.

    `example` is shown in the AsyncAPI document. `replies` of a client message are the types of the messages that answer
    it.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    example: ClassVar[dict[str, Any] | None] = None
    replies: ClassVar[tuple[str, ...]] = ()


class StrictMessage(Message):
    """A JSON object from a client. An unknown field is an error, so that typing mistakes are noticed."""

    model_config = ConfigDict(extra="forbid")


class CameraModel(StrictMessage):
    """The camera parameters that coordinates in meters need, over a flat road.

    A camera file holds this object as JSON. Either `field_of_view` or `focal_length` is required. With `auto`, pitch or
    yaw are estimated while driving; without a pitch, that of each frame follows from its horizon.
    """

    height: CameraHeight
    field_of_view: FieldOfView | None = None
    focal_length: tuple[FocalLength, FocalLength] | None = Field(
        default=None, description="[fx, fy] in pixels of an image of `image_size`."
    )
    principal_point: tuple[PixelCoordinate, PixelCoordinate] | None = Field(
        default=None, description="[cx, cy] in pixels of an image of `image_size`; its middle if missing."
    )
    image_size: tuple[ImageSide, ImageSide] | None = Field(
        default=None, description="[width, height] of the images that were calibrated; that of the frames if missing."
    )
    distortion: tuple[
        DistortionCoefficient,
        DistortionCoefficient,
        DistortionCoefficient,
        DistortionCoefficient,
        DistortionCoefficient,
    ] = Field(default=(0.0, 0.0, 0.0, 0.0, 0.0), description="OpenCV's [k1, k2, p1, p2, k3].")
    pitch: Annotated[float, Field(ge=-20.0, le=60.0)] | Auto | None = Field(
        default=None, description="Degrees that the camera looks down, or `auto`."
    )
    yaw: Annotated[float, Field(ge=-45.0, le=45.0)] | Auto = Field(
        default=0.0, description="Degrees that the camera looks to the left of the vehicle's direction, or `auto`."
    )
    roll: float = Field(
        default=0.0,
        ge=-30.0,
        le=30.0,
        description="Degrees that the camera is turned clockwise, as the driver sees it.",
    )
    lateral: float = Field(
        default=0.0, ge=-2.0, le=2.0, description="Meters that the camera is left of the vehicle's middle."
    )

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if (self.field_of_view is None) == (self.focal_length is None):
            raise ValueError("give either field_of_view or focal_length")
        if self.principal_point is not None and self.image_size is not None:
            (x, y), (width, height) = self.principal_point, self.image_size
            if not (0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0):
                raise ValueError("principal_point is outside of image_size")
        return self


class DepartureOptions(StrictMessage):
    """When to warn of lane departures, which needs a camera. The service's settings apply to missing fields."""

    vehicle_width: Annotated[float, Field(ge=0.5, le=4.0)] | None = Field(
        default=None, description="Width of the vehicle over the outer edges of its wheels in meters."
    )
    warning_s: Annotated[float, Field(ge=0.0, le=5.0)] | None = Field(
        default=None, description="Seconds before a line is crossed in which a warning comes."
    )
    least_speed: Annotated[float, Field(ge=0.0, le=_MOST_SPEED)] | None = Field(
        default=None, description="Below this speed in m/s no warning comes, if frames report the speed."
    )


class StartMessage(StrictMessage):
    """Client: opens the stream. Without it, the first image opens the stream with the defaults.

    With the token of a session that still exists, the stream continues that session on another socket or another
    replica of the service: the same boundaries keep their ids. With an unknown token, a new session starts.
    """

    example = {"type": "start", "mode": "all", "camera": {"height": 1.4, "field_of_view": 62.0}}
    replies = ("ready", "error")

    type: Literal["start"] = "start"
    session: SessionName | None = Field(
        default=None, description="Name of the session in logs and in `ready`; generated if missing."
    )
    resume_token: Annotated[str, Field(max_length=128)] | None = Field(
        default=None, description="The token of `ready` or `draining` of the session to resume."
    )
    mode: Mode = Field(
        default="latest", description="`latest`: a newer frame replaces a waiting one; `all`: every frame is answered."
    )
    detector: DetectorName | None = Field(
        default=None, description="The detector that finds the lanes; the service's default if missing."
    )
    horizon: Horizon | None = Field(
        default=None,
        description="Row of the horizon as a fraction of the image height, negative above the image; estimated if "
        "missing.",
    )
    camera: CameraModel | None = Field(default=None, description="If present, lanes are also reported in meters.")
    departure: DepartureOptions | None = Field(
        default=None, description="When to warn of lane departures; the service's settings if missing."
    )
    kinds: Kinds | None = Field(
        default=None,
        description="The kinds of boundaries to report: `marking`, `road_edge` or both; the service's setting if "
        "missing.",
    )


class FrameMessage(StrictMessage):
    """Client: number, capture time and motion for the binary message that follows.

    The service assigns a missing number and a missing time.
    """

    example = {"type": "frame", "seq": 7, "timestamp": 0.28, "speed": 24.5, "indicator": "off"}
    replies = ("lanes", "error")

    type: Literal["frame"] = "frame"
    seq: Annotated[int, Field(ge=0, le=MAX_SEQ)] | None = Field(
        default=None, description="Number of the frame; the previous one plus one if missing."
    )
    timestamp: Annotated[float, Field(ge=-1e15, le=1e15, allow_inf_nan=False)] | None = Field(
        default=None, description="Capture time in seconds, on any clock that does not run backwards."
    )
    speed: Annotated[float, Field(ge=0.0, le=_MOST_SPEED, allow_inf_nan=False)] | None = Field(
        default=None, description="Speed of the vehicle in m/s."
    )
    indicator: Indicator | None = Field(default=None, description="Direction indicator of the vehicle.")


class EndMessage(StrictMessage):
    """Client: no more frames follow. The service answers the frames it holds, sends a summary and closes the socket."""

    example = {"type": "end"}
    replies = ("summary",)

    type: Literal["end"] = "end"


class Limits(Message):
    """The limits of the service."""

    max_bytes: int = Field(description="Maximum size of an image file in bytes.")
    max_pixels: int = Field(description="Maximum number of pixels of an image.")
    credits: int = Field(description="Maximum number of unanswered frames in mode `all`.")
    frames_per_s: float = Field(description="Maximum average number of frames per second.")
    bytes_per_s: float = Field(description="Maximum average number of bytes per second.")
    idle_s: float = Field(description="A stream that is idle for this many seconds is closed.")
    session_s: float = Field(description="Maximum age of a session in seconds.")
    resume_s: float = Field(description="A session can be resumed for this many seconds after its socket closed.")


class ReadyMessage(Message):
    """Service: the stream is open. `last_seq` is the last answered frame of a resumed session."""

    type: Literal["ready"] = "ready"
    session: str = Field(description="Name of the session in the service's logs.")
    resume_token: str = Field(description="Resumes this session; keep it as secret as an API key.")
    resumed: bool = Field(description="Whether an earlier session continues; false for a new one.")
    last_seq: int | None = Field(description="Number of the last answered frame of a resumed session.")
    mode: Mode = Field(description="The mode of the stream.")
    detector: str = Field(description="The detector that finds the lanes.")
    model: str = Field(description="Name and version of its network.")
    provider: str = Field(description="The execution provider that runs its network.")
    limits: Limits


class LineModel(Message):
    """The end points of a boundary, [x, y] in pixels: a straight line would join its lowest and its highest row."""

    bottom: Point = Field(description="The point in the lowest row.")
    top: Point = Field(description="The point in the highest row.")


class MarkingModel(Message):
    """How a marking is painted, as all frames in which it was detected have shown so far."""

    type: MarkingType = Field(description="The most probable type; `dots` are raised dots.")
    type_probability: float = Field(description="Probability of this type.")
    color: MarkingColor = Field(description="The more probable color.")
    color_probability: float = Field(description="Probability of this color.")
    probability: float = Field(description="Probability that type and color are both right.")


class LaneModel(Message):
    """A tracked lane boundary: x(y) = v + b u + k / u with u = y - horizon and `coefficients` [v, b, k].

    The curve is valid between the rows of `line`. On a flat road it is a parabola on the ground, seen in perspective.
    """

    track_id: int = Field(description="Identity of the boundary, which it keeps while it is tracked.")
    position: int = Field(description="-1 is ego left, +1 ego right, -2 and +2 are the next boundaries outwards.")
    state: Literal["detected", "inferred", "predicted"] = Field(
        description="`detected` in this frame, `inferred` from the road where little or no paint was seen, or"
        " `predicted` only."
    )
    probability: float = Field(description="Probability that it is a boundary.")
    kind: BoundaryKind = Field(
        default="marking", description="A `marking` on the road, or a `road_edge`: a curb, or where the pavement ends."
    )
    kind_probability: float = Field(default=1.0, description="Probability that it is of this kind.")
    marking: MarkingModel | None = Field(
        default=None, description="Null for a road edge, and if the model does not classify markings."
    )
    points: list[Point] = Field(description="Points [x, y] on the curve in pixels, from the lowest row to the highest.")
    line: LineModel = Field(description="The end points of the curve.")
    horizon: float = Field(description="Row of the horizon of the curve in pixels.")
    coefficients: tuple[float, float, float] = Field(
        description="[v, b, k] of the curve: v in pixels, b in pixels per row, k in square pixels."
    )
    covariance: list[list[float]] = Field(description="3 x 3 covariance of the coefficients, in their units.")
    age_s: float = Field(description="Seconds since its track began.")
    ground: tuple[float, float, float] | None = Field(
        default=None,
        description="[a, b, c] of Y = a X^2 + b X + c on the road, in meters: X forward of the camera, Y left of the"
        " vehicle's middle."
        " Null without a camera.",
    )
    ground_covariance: list[list[float]] | None = Field(
        default=None, description="3 x 3 covariance of [a, b, c]. Null without a camera."
    )

    def x(self, y: float) -> float:
        """Returns the boundary's column at row `y`. Rows less than one row below the horizon count as one row below."""
        v, b, k = self.coefficients
        u = max(y - self.horizon, 1.0)
        return v + b * u + k / u


class EgoModel(Message):
    """The lane the camera is in: the track ids and kinds of its boundaries, and the camera's offset from the center.

    `offset` is a fraction of the lane width, positive to the right; null unless both boundaries are known. The fields
    in meters need a camera model and apply at the vehicle's middle: `offset_m` and `lane_width_m` if both boundaries
    are known, `heading` and `curvature` if at least one is. Each has its standard deviation in `..._sigma`.
    """

    left: int | None = Field(description="Track id of the left boundary; null without one.")
    right: int | None = Field(description="Track id of the right boundary; null without one.")
    left_kind: BoundaryKind | None = Field(default=None, description="Kind of the left boundary; null without one.")
    right_kind: BoundaryKind | None = Field(default=None, description="Kind of the right boundary; null without one.")
    offset: float | None = Field(
        description="Distance of the camera from the center of the lane as a share of its width, positive to the right."
    )
    offset_sigma: float | None = Field(default=None, description="Standard deviation of `offset`.")
    offset_m: float | None = Field(default=None, description="Offset in meters, positive to the right of the center.")
    offset_m_sigma: float | None = Field(default=None, description="Standard deviation of `offset_m` in meters.")
    lane_width_m: float | None = Field(default=None, description="Lane width in meters.")
    lane_width_m_sigma: float | None = Field(
        default=None, description="Standard deviation of `lane_width_m` in meters."
    )
    heading: float | None = Field(
        default=None, description="Angle from the vehicle's heading to the lane's in radians, positive to the left."
    )
    heading_sigma: float | None = Field(default=None, description="Standard deviation of `heading` in radians.")
    curvature: float | None = Field(
        default=None, description="Curvature of the lane in 1/m, positive if it curves to the left."
    )
    curvature_sigma: float | None = Field(default=None, description="Standard deviation of `curvature` in 1/m.")
    lateral_speed: float | None = Field(
        default=None, description="Speed of the vehicle across its lane in m/s, positive to the right."
    )
    lateral_speed_sigma: float | None = Field(default=None, description="Standard deviation of `lateral_speed` in m/s.")


class DepartureModel(Message):
    """Whether the vehicle leaves its lane, and on which side."""

    state: Literal["none", "warning", "crossed"] = Field(
        default="none",
        description="`warning` before its wheels cross a boundary, `crossed` from then until they are back inside.",
    )
    side: Side | None = Field(default=None, description="Null if the state is `none`.")
    time_to_crossing: float | None = Field(
        default=None,
        description="Seconds until the wheels on the side that the vehicle approaches reach its boundary, at most 10;"
        " 0 beyond it. Null if it approaches none.",
    )


class CalibrationModel(Message):
    """The estimated direction of the camera in degrees, if `start` had `auto` for its pitch or its yaw."""

    pitch: float = Field(description="Pitch of the camera in degrees, positive if it looks down.")
    pitch_sigma: float = Field(description="Standard deviation of the pitch in degrees.")
    yaw: float = Field(description="Yaw of the camera in degrees, positive if it looks to the left.")
    yaw_sigma: float = Field(description="Standard deviation of the yaw in degrees.")
    settled: bool = Field(description="Whether the estimate is good enough to be used.")


class LaneChangeModel(Message):
    """The vehicle's middle, or the camera if that is unknown, crossed a lane boundary."""

    type: Literal["lane_change"] = "lane_change"
    track_id: int = Field(description="Track id of the boundary.")
    direction: Side = Field(description="The side to which the vehicle changes.")
    timestamp: float = Field(description="Time of the crossing, interpolated between frames.")


class DepartureEventModel(Message):
    """A departure warning began, or the vehicle's wheels crossed a boundary of its lane."""

    type: Literal["departure"] = "departure"
    state: Literal["warning", "crossed"] = Field(description="What began: a warning, or a crossing.")
    side: Side = Field(description="The side of the boundary.")
    track_id: int = Field(description="Track id of the boundary.")
    timestamp: float = Field(description="Time of the warning or the crossing, interpolated between frames.")


class SceneCutModel(Message):
    """The frame shows another scene than the one before: all track ids are new."""

    type: Literal["scene_cut"] = "scene_cut"
    timestamp: float = Field(description="Time of the first frame of the new scene.")


class CalibrationChangedModel(Message):
    """The camera points in another direction than before, in degrees."""

    type: Literal["calibration_changed"] = "calibration_changed"
    pitch: float = Field(description="The new pitch in degrees, positive if the camera looks down.")
    yaw: float = Field(description="The new yaw in degrees, positive if the camera looks to the left.")
    timestamp: float = Field(description="Time of the frame in which it was noticed.")


EventModel = LaneChangeModel | DepartureEventModel | SceneCutModel | CalibrationChangedModel


class TimingModel(Message):
    """Duration of each stage in milliseconds. `total` is their sum."""

    decode: float = Field(description="Decoding the image file.")
    propose: float = Field(description="Working image, ego-lane prior and candidates, without the networks.")
    queue: float = Field(description="Waiting before the frame was processed.")
    infer: float = Field(description="Waiting for the networks.")
    fit: float = Field(default=0.0, description="Fitting curves to the paint.")
    track: float = Field(description="The tracker.")
    total: float = Field(description="From the frame's arrival to its reply.")


class LanesMessage(Message):
    """Service: the lanes of one frame."""

    type: Literal["lanes"] = "lanes"
    seq: int = Field(description="Number of the frame.")
    timestamp: float = Field(description="Capture time of the frame in seconds.")
    width: int = Field(description="Width of the image in pixels.")
    height: int = Field(description="Height of the image in pixels.")
    horizon: float = Field(description="Row of the horizon in this frame in pixels.")
    lanes: list[LaneModel] = Field(description="The reported boundaries.")
    ego: EgoModel
    departure: DepartureModel | None = Field(default=None, description="Null without a camera.")
    calibration: CalibrationModel | None = Field(
        default=None, description="Null unless the camera's pitch or yaw is `auto`."
    )
    events: list[Annotated[EventModel, Field(discriminator="type")]] = Field(
        description="What happened since the previous frame."
    )
    dropped: int = Field(description="Frames of this stream that were dropped so far.")
    timing_ms: TimingModel


class ErrorMessage(Message):
    """Service: an error. With a `seq` it answers that frame; a fatal error ends the stream."""

    example = {
        "type": "error",
        "code": "bad_image",
        "message": "the JPEG image is cut short: its end is missing",
        "hint": "send the whole file",
        "seq": 7,
        "fatal": False,
    }

    type: Literal["error"] = "error"
    code: str = Field(description="The kind of error, for programs; never changes its meaning.")
    message: str = Field(description="What is wrong, for people.")
    hint: str = Field(default="", description="What to do, for people.")
    seq: int | None = Field(default=None, description="The frame that the error answers; null if none.")
    fatal: bool = Field(default=False, description="Whether the service closes the stream.")


class WarningMessage(Message):
    """Service: what the client sends is accepted, but probably wrong. Each code comes at most once in a session."""

    example = {
        "type": "warning",
        "code": "timestamps_in_milliseconds",
        "message": "the timestamps of the frames look like milliseconds",
        "hint": "send the capture time in seconds",
        "seq": 1,
    }

    type: Literal["warning"] = "warning"
    code: WarningCode = Field(description="The kind of warning, for programs.")
    message: str = Field(description="What is probably wrong, for people.")
    hint: str = Field(description="What to do, for people.")
    seq: int = Field(description="The frame that showed it.")


# What each warning says: its message and its hint.
WARNINGS: Final[Mapping[WarningCode, tuple[str, str]]] = MappingProxyType(
    {
        "timestamps_in_milliseconds": (
            "the timestamps of the frames look like milliseconds",
            "send the capture time in seconds",
        ),
        "timestamps_not_advancing": (
            "the timestamps of the frames do not advance",
            "send each frame's own capture time, on a clock that does not run backwards",
        ),
    }
)


class DrainingMessage(Message):
    """Service: it is about to stop. It answers the frames it holds, refuses later ones, then closes the socket.

    The session can be resumed on another replica, or on this one after its restart.
    """

    example = {"type": "draining", "resume_token": "4Hs0...", "deadline_s": 10.0}

    type: Literal["draining"] = "draining"
    resume_token: str | None = Field(description="Null if the stream was opened without `start`.")
    deadline_s: float = Field(description="The socket is closed after this many seconds at the latest.")


class SummaryMessage(Message):
    """Service: the reply to `end` with the counts of all frames received over this socket.

    `frames` is the number of received frames, each of which was answered, failed or dropped.
    """

    example = {"type": "summary", "frames": 250, "answered": 248, "failed": 1, "dropped": 1, "duration_s": 10.02}

    type: Literal["summary"] = "summary"
    frames: int = Field(description="Frames received.")
    answered: int = Field(description="Frames answered with lanes.")
    failed: int = Field(description="Frames answered with an error.")
    dropped: int = Field(description="Frames without an answer, because newer ones replaced them.")
    duration_s: float = Field(description="Seconds since the socket was opened.")


ClientMessage = StartMessage | FrameMessage | EndMessage
ServerMessage = ReadyMessage | LanesMessage | WarningMessage | ErrorMessage | DrainingMessage | SummaryMessage

# What pydantic adds to the location of a value that may have several types.
_UNION_BRANCHES: Final = ("constrained-float", "float", "literal['auto']")

_CLIENT: Final[TypeAdapter[ClientMessage]] = TypeAdapter(Annotated[ClientMessage, Field(discriminator="type")])
_SERVER: Final[TypeAdapter[ServerMessage]] = TypeAdapter(Annotated[ServerMessage, Field(discriminator="type")])


def parse_client_message(text: str) -> ClientMessage:
    """Returns the client message in `text`. Raises ProtocolError if it is malformed."""
    # An error is built for every unknown field, so their number is limited before.
    if text.count(",") >= _MOST_VALUES:
        raise ProtocolError(
            f"not a valid stream message: it has more than {_MOST_VALUES} values", "see /v1/asyncapi.json"
        )
    try:
        return _CLIENT.validate_json(text)
    except ValidationError as error:
        raise ProtocolError(
            f"not a valid stream message: {_first_problem(error)}",
            'send a text message like {"type": "start"|"frame"|"end", ...}, or an image file as a binary message',
        ) from None


def parse_server_message(text: str) -> ServerMessage:
    """Returns the service message in `text`. Raises ProtocolError if it is malformed."""
    try:
        return _SERVER.validate_json(text)
    except ValidationError as error:
        raise ProtocolError(f"the service sent an invalid message: {_first_problem(error)}") from None


def parse_camera(height: float | None, field_of_view: float | None, text: str | None = None) -> CameraModel | None:
    """Returns the camera of two options that belong together, or of the JSON `text`; None if all are None.

    Raises ProtocolError if it is not valid.
    """
    if height is None and field_of_view is None:
        return None if text is None else parse_camera_json(text)
    if text is not None:
        raise ProtocolError(
            "the camera is given twice", "give either the whole camera, or its height and its field of view"
        )
    try:
        return CameraModel.model_validate({"height": height, "field_of_view": field_of_view})
    except ValidationError as error:
        raise ProtocolError(
            f"not a valid camera: {_first_problem(error)}",
            "give both the height (0.3 to 4 m) and the horizontal field of view (20 to 150 degrees), or neither",
        ) from None


def parse_camera_json(text: str | bytes) -> CameraModel:
    """Returns the camera in the JSON object `text`, such as the content of a camera file. Raises ProtocolError."""
    try:
        return CameraModel.model_validate_json(text)
    except ValidationError as error:
        raise ProtocolError(
            f"not a valid camera: {_first_problem(error)}",
            'give a JSON object such as {"height": 1.4, "field_of_view": 62}, see docs/cameras.md',
        ) from None


def read_camera_file(path: Path) -> CameraModel:
    """Returns the camera in a camera file. Raises ProtocolError, on one line, if it can't be read or is not valid."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise ProtocolError(
            f"can't read {path}: {(error.strerror or str(error)).lower()}", "give a camera file"
        ) from None
    try:
        return parse_camera_json(text)
    except ProtocolError as error:
        raise ProtocolError(f"{path}: {error.message}", error.hint) from None


def error_message(error: BaseException, *, seq: int | None = None, fatal: bool = False) -> ErrorMessage:
    """Returns the message that reports `error`. Details of an unexpected error appear only in the service's log."""
    if isinstance(error, LanestreamError):
        return ErrorMessage(code=error.code, message=error.message, hint=error.hint, seq=seq, fatal=fatal)
    return ErrorMessage(
        code=LanestreamError.code,
        message="an unexpected error occurred in the service",
        hint="see the log of the service",
        seq=seq,
        fatal=fatal,
    )


def warning_message(code: WarningCode, seq: int) -> WarningMessage:
    """Returns the message that warns of `code`, which the frame `seq` showed."""
    message, hint = WARNINGS[code]
    return WarningMessage(code=code, message=message, hint=hint, seq=seq)


def json_schemas() -> dict[str, dict[str, Any]]:
    """Returns the JSON Schemas of the messages that the client sends and that the service sends."""
    return {"client": _CLIENT.json_schema(), "server": _SERVER.json_schema(mode="serialization")}


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False, include_input=False)[0]
    # Both may quote what was sent, at any length.
    location = one_line(".".join(str(part) for part in problem["loc"] if part not in _UNION_BRANCHES), 80)
    reason = one_line(problem["msg"].removeprefix("Value error, "))
    return f"{location}: {reason}" if location else reason
