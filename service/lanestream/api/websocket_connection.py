"""uvicorn's WebSocket with the limits that it lacks: on the rate and the size of messages, and on their memory.

Frames are found in what the peer has sent before the library parses them, and passed on one by one. So the frames of
one packet do not keep the event loop busy, a frame that is too large is refused by its header, and a peer that sends
too fast, or more than there is memory for, is read more slowly, which slows it down.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from lanestream.api.connections import STATE_KEY, Connection
from lanestream.api.problems import raw_response
from lanestream.errors import BusyError, ProtocolError, wire_status
from lanestream.protocol import MOST_TEXT_BYTES, error_message
from lanestream.streaming.token_bucket import TokenBucket

if TYPE_CHECKING:
    from asyncio.transports import BaseTransport

    from uvicorn._types import ASGIReceiveEvent, ASGISendEvent
    from websockets.http11 import Request

    from lanestream.api.byte_budget import Charge

    # uvicorn does not annotate these classes.
    class _WebSocketProtocol(WebSocketsSansIOProtocol):
        def __init__(self, *arguments: object, **named: object) -> None: ...
else:
    _WebSocketProtocol = WebSocketsSansIOProtocol

# Frames that are passed on before other connections get their turn.
_FRAMES_AT_ONCE: Final = 16
# Tokens that a message of the stream costs; a ping, a pong and a fragment cost one.
_MESSAGE_COST: Final = 4.0
# How soon a peer that waits for room is looked at again.
_RETRY_S: Final = 0.05
# What a connection may keep without being charged for it.
_FREE_BYTES: Final = 1 << 16
_CONTINUATION, _TEXT, _BINARY = 0, 1, 2
_FINAL_BIT: Final = 0x80
_OPCODE_BITS: Final = 0x0F
_MASK_BIT: Final = 0x80
_MASK_BYTES: Final = 4
_MOST_CONTROL_BYTES: Final = 125


@dataclass(frozen=True)
class FrameHeader:
    """The header of a WebSocket frame (RFC 6455, section 5.2): `size` is that of header and payload in bytes."""

    opcode: int
    final: bool
    payload: int
    size: int

    @property
    def is_data(self) -> bool:
        """Whether the frame is a message or a fragment of one; the others are pings, pongs and closes."""
        return self.opcode in (_CONTINUATION, _TEXT, _BINARY)


def read_frame_header(data: bytes | bytearray) -> FrameHeader | None:
    """Returns the header at the start of `data`; None if it is incomplete."""
    if len(data) < 2:
        return None
    payload, start = data[1] & ~_MASK_BIT, 2
    if payload >= 126:
        start = 4 if payload == 126 else 10
        if len(data) < start:
            return None
        payload = int.from_bytes(data[2:start], "big")
    start += _MASK_BYTES if data[1] & _MASK_BIT else 0
    return FrameHeader(data[0] & _OPCODE_BITS, bool(data[0] & _FINAL_BIT), payload, start + payload)


class WebSocketConnection(_WebSocketProtocol):
    """A WebSocket on a connection that began as an `HttpConnection`."""

    # They exist from `connection_made` on, before any other event.
    _connection: Connection
    _bucket: TokenBucket
    _charge: Charge

    def __init__(self, **uvicorn: Any) -> None:
        super().__init__(**uvicorn)
        self._unread = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        # The message in parts: whether it is a text, and its bytes so far.
        self._in_text = False
        self._message_bytes = 0
        # The bytes of the message that the application has not received yet.
        self._delivered_bytes = 0
        self._full_since: float | None = None

    def connection_made(self, transport: BaseTransport) -> None:
        """Takes the connection over."""
        assert isinstance(transport, Connection)  # noqa: S101 - passed on by HttpConnection
        self._connection = transport
        self._bucket = transport.table.message_bucket()
        self._charge = transport.table.budget.charge(transport.account)
        super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """Ends the stream: the peer is gone."""
        super().connection_lost(exc)
        self._connection.lost()
        self._unread.clear()
        self.frames.clear()
        self._charge.set(0)
        self._cancel_timer()

    def data_received(self, data: bytes) -> None:
        """Receives the request of the handshake, then frames."""
        if self._connection.discard(data):
            return
        if not self.handshake_initiated:
            super().data_received(data)
            if not self.handshake_initiated:
                self.transport.write(
                    raw_response(
                        HTTPStatus.BAD_REQUEST,
                        ProtocolError.code,
                        "the request of the WebSocket handshake is not valid",
                        "send GET /v1/stream without a body, with at most 100 headers",
                    )
                )
                self._connection.linger()
            return
        self._unread += data
        self._pass_on()

    def handle_connect(self, event: Request) -> None:
        """Starts the application, which finds the connection in its scope."""
        super().handle_connect(event)
        if self.conn.handshake_exc is None and hasattr(self, "scope"):
            self.scope["state"][STATE_KEY] = self._connection

    def resume_writing(self) -> None:
        """Continues: the peer has read what it was sent."""
        super().resume_writing()
        self._pass_on_soon()

    def send_receive_event_to_app(self) -> None:
        """Passes a message to the application."""
        text = self.curr_msg_data_type == "text"
        if text and not _is_utf8(self.frames[0] if len(self.frames) == 1 else b"".join(self.frames)):
            self._fail(1007, "the text is not UTF-8")
            return
        super().send_receive_event_to_app()

    async def receive(self) -> ASGIReceiveEvent:
        """Returns the next event for the application."""
        message = await super().receive()
        # From here on the application is charged.
        self._charge.shrink(self._delivered_bytes)
        self._delivered_bytes = 0
        self._pass_on_soon()
        return message

    async def send(self, message: ASGISendEvent) -> None:
        """Sends what the application answers: the end of the handshake, or a message."""
        await super().send(message)
        self._pass_on_soon()

    def _pass_on_soon(self) -> None:
        if self._unread and self._timer is None:
            self._timer = self.loop.call_later(0.0, self._continue)

    def _continue(self) -> None:
        self._timer = None
        self._pass_on()

    def _pass_on(self) -> None:
        """Passes complete frames to the library, as long as the application, the peer and its limits allow it."""
        if not self.handshake_complete:
            self._connection.hold_reading(True)
            return
        for _ in range(_FRAMES_AT_ONCE):
            header = read_frame_header(self._unread)
            if header is None or not self._is_acceptable(header) or not self._has_room(header):
                break
            if len(self._unread) < header.size or not self._may_pass_on() or not self._spend(header):
                break
            frame = bytes(self._unread[: header.size])
            del self._unread[: header.size]
            super().data_received(frame)
            self._count_fragment(header)
        else:
            self._pass_on_soon()
        if not self.transport.is_closing():
            header = read_frame_header(self._unread)
            waits = header is not None and len(self._unread) >= header.size
            self._connection.hold_reading(waits or self._full_since is not None)

    def _may_pass_on(self) -> bool:
        """Returns whether the application waits for a message, and the peer has read what it was sent."""
        return not self.read_paused and self.writable.is_set() and not self.transport.is_closing()

    def _is_acceptable(self, header: FrameHeader) -> bool:
        """Refuses a frame by its header. Returns whether it may be waited for."""
        if not header.is_data:
            if header.payload > _MOST_CONTROL_BYTES:
                self._fail(1002, f"a control frame has more than {_MOST_CONTROL_BYTES} bytes")
            return header.payload <= _MOST_CONTROL_BYTES
        text = header.opcode == _TEXT or (header.opcode == _CONTINUATION and self._in_text)
        most = MOST_TEXT_BYTES if text else self.config.ws_max_size
        size = header.payload + (self._message_bytes if header.opcode == _CONTINUATION else 0)
        return size <= most or self._refuse_size(f"a message has more than {most:,} bytes")

    def _refuse_size(self, reason: str) -> bool:
        self._connection.table.report("message_size", self._connection.address)
        self._fail(1009, reason)
        return False

    def _spend(self, header: FrameHeader) -> bool:
        """Takes the tokens for a frame. If they are missing, returns False and continues when they are there."""
        now, cost = time.monotonic(), _MESSAGE_COST if header.is_data and header.final else 1.0
        buckets = self._bucket, self._connection.table.account_messages(self._connection.account)
        wait_s = max(bucket.seconds_until(cost, now) for bucket in buckets)
        if wait_s > 0.0:
            if self._timer is None:
                self._timer = self.loop.call_later(wait_s, self._continue)
            return False
        for bucket in buckets:
            bucket.spend(cost)
        return True

    def _count_fragment(self, header: FrameHeader) -> None:
        if header.opcode in (_TEXT, _BINARY):
            self._in_text, self._message_bytes = header.opcode == _TEXT, 0
        if header.is_data:
            self._message_bytes += header.payload
            if header.final:
                self._delivered_bytes, self._message_bytes = self._message_bytes, 0

    def _has_room(self, header: FrameHeader) -> bool:
        """Reserves memory for a whole frame, so that what has begun can end. Without room the peer has to wait.

        After the time limit the stream is ended.
        """
        account, now = self._connection.account, time.monotonic()
        if self._charge.caller != account:
            self._charge.set(0)
            self._charge = self._connection.table.budget.charge(account)
        kept = header.size + self._message_bytes + self._delivered_bytes
        try:
            self._charge.set(kept if kept > _FREE_BYTES else 0)
        except BusyError as error:
            self._full_since = self._full_since or now
            if now - self._full_since > self._connection.table.limits.send_s:
                self._connection.table.report("memory", self._connection.address)
                if not self.close_sent:
                    self.conn.send_text(error_message(error, fatal=True).model_dump_json().encode())
                self._fail(wire_status(error).close_code, error.message)
            elif self._timer is None:
                self._timer = self.loop.call_later(_RETRY_S, self._continue)
            return False
        self._full_since = None
        return True

    def _fail(self, code: int, reason: str) -> None:
        """Ends the stream with a close code."""
        self._unread.clear()
        self.conn.fail(code, reason)
        self.queue.put_nowait({"type": "websocket.disconnect", "code": code, "reason": reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self._connection.linger()

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _is_utf8(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True
