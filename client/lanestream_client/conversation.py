"""The client's side of a stream, without its socket: shared by the client that blocks and the one that awaits.

Keeps a few frames in flight, one unless told otherwise: more would wait in the service and make every answer older,
which pays only where the network is slower than the service. None has to be dropped of a source that can wait.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lanestream.errors import (
    ConnectionFailedError,
    ImageTooLargeError,
    LanestreamError,
    OverrunError,
    ProtocolError,
    error_of,
)
from lanestream.protocol import (
    AnyServerMessage,
    CameraModel,
    DetectorName,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    LanesMessage,
    Mode,
    ReadyMessage,
    SummaryMessage,
    error_message,
    parse_client_message,
    parse_server_message,
)
from lanestream_client.frames import SourceFrame, StreamResult

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed

_TOO_BIG: Final = 1009


@dataclass(frozen=True)
class _Pending:
    frame: SourceFrame
    refused: ErrorMessage | None = None


class Conversation:
    """What was sent and what is owed, with up to `in_flight` frames unanswered.

    None of its methods waits; calls from several threads need a lock around them.
    """

    def __init__(
        self,
        mode: Mode,
        horizon: float | None = None,
        detector: DetectorName | None = None,
        camera: CameraModel | None = None,
        *,
        in_flight: int = 1,
    ) -> None:
        self.ready: ReadyMessage | None = None
        self.summary: SummaryMessage | None = None
        self._asked = {
            "mode": mode,
            "horizon": horizon,
            "detector": detector,
            "camera": None if camera is None else camera.model_dump(),
        }
        self._in_flight = in_flight
        self._pending: dict[int, _Pending] = {}
        self._last_seq = -1

    def opening(self) -> str:
        """The message that opens the stream. Raises ProtocolError where something was asked for that is none."""
        return parse_client_message(json.dumps({"type": "start", **self._asked})).model_dump_json(exclude_none=True)

    def opened(self, text: str | bytes) -> ReadyMessage:
        """Takes the service's answer to the opening. Raises the error that it tells, ProtocolError where it is odd."""
        message = _parsed(text)
        if isinstance(message, ErrorMessage):
            raise error_of(message.code, message.message, message.hint)
        if not isinstance(message, ReadyMessage):
            raise ProtocolError(f"the service answered `start` with `{message.type}`")
        self.ready = message
        return message

    @property
    def has_room(self) -> bool:
        """Whether one more frame may be sent now."""
        if self.ready is None:
            return False
        window = min(self._in_flight, self.ready.limits.credits)
        return sum(pending.refused is None for pending in self._pending.values()) < window

    def outgoing(self, frame: SourceFrame, data: bytes) -> list[str | bytes]:
        """The messages that send `frame`, encoded as `data`.

        None at all where it has more bytes than the service accepts, which would end the stream: its result is then an
        error, told in its turn. Raises ProtocolError where its number is not above that of the frame before, and
        OverrunError without room.
        """
        if not self.has_room or self.ready is None:
            raise OverrunError("a frame was to be sent without room for it")
        if frame.seq <= self._last_seq:
            raise ProtocolError(f"frame {frame.seq} came after frame {self._last_seq}", "numbers of frames must rise")
        self._last_seq = frame.seq
        most = self.ready.limits.max_bytes
        if len(data) > most:
            error = ImageTooLargeError(f"the frame has {len(data):,} bytes; the service accepts {most:,}")
            self._pending[frame.seq] = _Pending(frame, error_message(error, seq=frame.seq))
            return []
        self._pending[frame.seq] = _Pending(frame)
        return [FrameMessage(seq=frame.seq, timestamp=frame.timestamp).model_dump_json(exclude_none=True), data]

    def ending(self) -> str:
        """The message after the last frame."""
        return EndMessage().model_dump_json()

    def incoming(self, text: str | bytes) -> list[StreamResult]:
        """Takes a message of the service in; the results that it settles, in the frames' order.

        Raises the error that ends the stream, or that is not about a frame.
        """
        message = _parsed(text)
        if isinstance(message, SummaryMessage):
            self.summary = message
            return self._settled_before(self._last_seq + 1)
        if isinstance(message, ErrorMessage):
            if message.fatal or message.seq is None:
                raise error_of(message.code, message.message, message.hint)
            return self._settle(message.seq, message)
        if isinstance(message, LanesMessage):
            return self._settle(message.seq, message)
        raise ProtocolError(f"the service sent `{message.type}` in the middle of the stream")

    def _settle(self, seq: int, message: LanesMessage | ErrorMessage) -> list[StreamResult]:
        results = self._settled_before(seq)
        pending = self._pending.pop(seq, None)
        if pending is None:
            raise ProtocolError(f"the service answered frame {seq}, which was not sent")
        if isinstance(message, LanesMessage):
            return [*results, StreamResult(pending.frame, lanes=message)]
        return [*results, StreamResult(pending.frame, error=message)]

    def _settled_before(self, seq: int) -> list[StreamResult]:
        """Answers come in order: frames before `seq` without one were refused here, or dropped by the service."""
        earlier = [number for number in self._pending if number < seq]
        gone = [self._pending.pop(number) for number in earlier]
        return [StreamResult(pending.frame, error=pending.refused) for pending in gone if pending.refused is not None]


def lost(closed: ConnectionClosed) -> LanestreamError:
    """The error for a stream whose connection ended before its summary came."""
    close = closed.rcvd
    if close is None:
        return ConnectionFailedError("the connection to the service broke")
    if close.code == _TOO_BIG:
        return ImageTooLargeError("a frame had more bytes than the service accepts")
    reason = f": {close.reason}" if close.reason else ""
    return ConnectionFailedError(f"the service closed the stream with code {close.code}{reason}")


def _parsed(text: str | bytes) -> AnyServerMessage:
    if isinstance(text, bytes):
        raise ProtocolError("the service sent a binary message")
    return parse_server_message(text)
