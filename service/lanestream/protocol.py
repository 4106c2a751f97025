"""The wire contract: the messages of `/v1/stream` and `/v1/detect`, and the rules of their order.

Light on purpose: pydantic and the standard library only, so that the client can share it. Coordinates are pixels of the
image that was sent (x right, y down, pixel centres at integers), timestamps are seconds on the client's clock.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from lanestream.errors import LanestreamError, ProtocolError, one_line

SUBPROTOCOL: Final = "lanestream.v1"
# What comes after it in the name of another subprotocol is an API key: browsers can't set headers on a WebSocket.
KEY_SUBPROTOCOL: Final = "bearer."
# Beyond it a number of JSON is not the same one for everybody who reads it (RFC 8259, section 6).
MOST_SEQ: Final = 2**53 - 1

Point = tuple[float, float]
Mode = Literal["latest", "all"]
SessionName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
DetectorName = Literal["candidates", "regression"]
CameraHeight = Annotated[float, Field(ge=0.3, le=4.0, description="Metres from the road up to the camera.")]
FieldOfView = Annotated[float, Field(ge=20.0, le=150.0, description="Degrees between the image's left and right edge.")]


class Message(BaseModel):
    """A JSON object on the wire; a field that nobody knows is an error, so that a typing slip is seen."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class CameraModel(Message):
    """What has to be known of a camera to tell lanes in metres: it looks ahead, over a flat road."""

    height: CameraHeight
    field_of_view: FieldOfView


class StartMessage(Message):
    """Client: opens the stream. Without it the first frame opens the stream with the defaults.

    With the token of a session that lives the stream goes on where that session was, on another socket or on another
    replica of the service: the same boundaries keep their ids. With a token that nobody knows it begins afresh.
    """

    type: Literal["start"] = "start"
    session: SessionName | None = Field(
        default=None, description="A name for the session, seen in logs and in `ready`; made up where absent."
    )
    resume_token: Annotated[str, Field(max_length=128)] | None = Field(
        default=None, description="What `ready` or `draining` told when the session was last open."
    )
    mode: Mode = "latest"
    detector: DetectorName | None = Field(
        default=None, description="What finds the lanes; the service's default where absent."
    )
    horizon: Annotated[float, Field(gt=0.0, lt=1.0)] | None = Field(
        default=None, description="Row of the horizon as a share of the image height; estimated where absent."
    )
    camera: CameraModel | None = Field(default=None, description="Lanes are told in metres too where it is given.")


class FrameMessage(Message):
    """Client: numbers the binary message that follows. What is absent is assigned by the service."""

    type: Literal["frame"] = "frame"
    seq: Annotated[int, Field(ge=0, le=MOST_SEQ)] | None = None
    timestamp: Annotated[float, Field(ge=-1e15, le=1e15, allow_inf_nan=False)] | None = Field(
        default=None, description="Capture time in seconds; any clock that does not go backwards."
    )


class EndMessage(Message):
    """Client: no more frames; the service answers what it holds, then sends a summary and closes."""

    type: Literal["end"] = "end"


class Limits(Message):
    """What the service accepts."""

    max_bytes: int = Field(description="Bytes of one image file at most.")
    max_pixels: int = Field(description="Pixels of one image at most.")
    credits: int = Field(description="Mode `all`: how many frames may be unanswered at a time.")
    frames_per_s: float = Field(description="Frames a second at most, on average.")
    bytes_per_s: float = Field(description="Bytes a second at most, on average.")
    idle_s: float = Field(description="A stream from which nothing comes for so long is closed.")
    session_s: float = Field(description="A session ends for good after this time.")
    resume_s: float = Field(description="How long after its last socket a session can be resumed.")


class ReadyMessage(Message):
    """Service: the stream is open. `last_seq` is the last frame that a resumed session has answered for."""

    type: Literal["ready"] = "ready"
    session: str
    resume_token: str = Field(description="Opens this session again; keep it as secret as a key.")
    resumed: bool = Field(description="Whether the session goes on; false for a new one.")
    last_seq: int | None
    mode: Mode
    detector: str
    model: str
    provider: str
    limits: Limits


class LineModel(Message):
    """A boundary's end points: what a straight line between its lowest and its highest row would join."""

    bottom: Point
    top: Point


class LaneModel(Message):
    """One tracked boundary: x(y) = v + b u + k / u with u = y - horizon and `coefficients` [v, b, k].

    It holds between the rows of `line`. On a flat road this is a parabola of the ground, seen in perspective.
    """

    track_id: int
    position: int = Field(description="-1 ego left, +1 ego right, -2 and +2 the next ones out.")
    state: Literal["detected", "predicted"]
    probability: float
    points: list[Point] = Field(description="From the lowest row to the highest.")
    line: LineModel
    horizon: float
    coefficients: tuple[float, float, float]
    covariance: list[list[float]] = Field(description="3 x 3, of the coefficients.")
    age_s: float
    ground: tuple[float, float, float] | None = Field(
        default=None,
        description="[a, b, c] of Y = a X^2 + b X + c on the road, in metres from the camera: X forward, Y left."
        " Null without a camera.",
    )

    def x(self, y: float) -> float:
        """The boundary's column at row `y`; nearer than one row to the horizon counts as one row."""
        v, b, k = self.coefficients
        u = max(y - self.horizon, 1.0)
        return v + b * u + k / u


class EgoModel(Message):
    """The lane the camera is in: its boundaries' track ids, and the camera's offset from the centre.

    The offset is a share of the lane width, positive to the right; null unless both boundaries are known. The rest is
    there where the stream has a camera model, and told at the camera: `offset_m` and `lane_width_m` where both
    boundaries are known, `heading` and `curvature` where one is, as the mean of those known.
    """

    left: int | None
    right: int | None
    offset: float | None
    offset_m: float | None = Field(default=None, description="Metres, positive to the right of the lane's centre.")
    lane_width_m: float | None = Field(default=None, description="Metres.")
    heading: float | None = Field(
        default=None, description="Radians from the vehicle's heading to the lane's, positive to the left."
    )
    curvature: float | None = Field(default=None, description="1/m, positive where the lane bends to the left.")


class LaneChangeModel(Message):
    """The camera crossed a boundary."""

    type: Literal["lane_change"] = "lane_change"
    track_id: int
    direction: Literal["left", "right"]


class TimingModel(Message):
    """Milliseconds by stage; `queue` is waiting, `total` runs from the frame's arrival to its reply."""

    decode: float
    propose: float
    queue: float
    infer: float
    fit: float = 0.0
    track: float
    total: float


class LanesMessage(Message):
    """Service: the lanes of one frame."""

    type: Literal["lanes"] = "lanes"
    seq: int
    timestamp: float
    width: int
    height: int
    horizon: float
    lanes: list[LaneModel]
    ego: EgoModel
    events: list[LaneChangeModel]
    dropped: int = Field(description="Frames of this stream that were never processed, so far.")
    timing_ms: TimingModel


class ErrorMessage(Message):
    """Service: something was wrong. A frame's error costs that frame; a fatal one ends the stream."""

    type: Literal["error"] = "error"
    code: str
    message: str
    hint: str = ""
    seq: int | None = None
    fatal: bool = False


class DrainingMessage(Message):
    """Service: it is about to stop. Frames that it has taken are answered, later ones refused, then the socket closes.

    The session can be resumed on another replica, or on this one when it is back.
    """

    type: Literal["draining"] = "draining"
    resume_token: str | None = Field(description="Null where the stream was opened without `start`.")
    deadline_s: float = Field(description="The socket is closed after so many seconds at the latest.")


class SummaryMessage(Message):
    """Service: the answer to `end`: what became of the frames that came over this socket.

    `frames` counts received ones, each of them answered, failed or dropped.
    """

    type: Literal["summary"] = "summary"
    frames: int
    answered: int
    failed: int
    dropped: int
    duration_s: float


ClientMessage = Annotated[StartMessage | FrameMessage | EndMessage, Field(discriminator="type")]
ServerMessage = Annotated[
    ReadyMessage | LanesMessage | ErrorMessage | DrainingMessage | SummaryMessage, Field(discriminator="type")
]
AnyClientMessage = StartMessage | FrameMessage | EndMessage
AnyServerMessage = ReadyMessage | LanesMessage | ErrorMessage | DrainingMessage | SummaryMessage

_CLIENT: Final[TypeAdapter[AnyClientMessage]] = TypeAdapter(ClientMessage)
_SERVER: Final[TypeAdapter[AnyServerMessage]] = TypeAdapter(ServerMessage)


def parse_client_message(text: str) -> AnyClientMessage:
    """The client message in `text`. Raises ProtocolError with one line that says what was wrong."""
    try:
        return _CLIENT.validate_json(text)
    except ValidationError as error:
        raise ProtocolError(
            f"not a stream message: {_first_problem(error)}",
            'send a text message like {"type": "start"|"frame"|"end", ...} or a binary message with an image file',
        ) from None


def parse_server_message(text: str) -> AnyServerMessage:
    """The service message in `text`. Raises ProtocolError where it is none."""
    try:
        return _SERVER.validate_json(text)
    except ValidationError as error:
        raise ProtocolError(f"the service sent something unknown: {_first_problem(error)}") from None


def camera_of(height: float | None, field_of_view: float | None) -> CameraModel | None:
    """The camera of two options that go together; None without both. Raises ProtocolError for a half or a bad one."""
    if height is None and field_of_view is None:
        return None
    try:
        return CameraModel.model_validate({"height": height, "field_of_view": field_of_view})
    except ValidationError as error:
        raise ProtocolError(
            f"not a camera: {_first_problem(error)}",
            "give both its height, 0.3 to 4 m, and its horizontal field of view, 20 to 150 degrees, or neither",
        ) from None


def error_message(error: BaseException, *, seq: int | None = None, fatal: bool = False) -> ErrorMessage:
    """How `error` is told. Nothing of an error that was not raised on purpose is told: it is in the service's log."""
    if isinstance(error, LanestreamError):
        return ErrorMessage(code=error.code, message=error.message, hint=error.hint, seq=seq, fatal=fatal)
    return ErrorMessage(
        code=LanestreamError.code,
        message="something went wrong in the service",
        hint="see its log",
        seq=seq,
        fatal=fatal,
    )


def schemas() -> dict[str, dict[str, Any]]:
    """JSON Schemas of the messages that a client sends and of those that the service sends."""
    return {"client": _CLIENT.json_schema(), "server": _SERVER.json_schema(mode="serialization")}


def _first_problem(error: ValidationError) -> str:
    problem = error.errors(include_url=False, include_input=False)[0]
    # Both may quote what was sent, however long that is.
    where, why = one_line(".".join(map(str, problem["loc"])), 80), one_line(problem["msg"])
    return f"{where}: {why}" if where else why
