"""uvicorn's HTTP/1.1 with the limits that it lacks: size of heads, time for heads and bodies, requests in a pipeline.

All of them apply before authentication. What the peer has sent is parsed in pieces, so that a limit takes effect in the
middle of a packet, and the requests of one packet do not keep the event loop busy.
"""

from __future__ import annotations

import asyncio
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from lanestream.api.connections import STATE_KEY, Connection
from lanestream.api.problems import raw_response

if TYPE_CHECKING:
    from lanestream.api.connections import ConnectionTable, CutReason

    # uvicorn does not annotate this class.
    class _HttpProtocol(HttpToolsProtocol):
        def __init__(self, *arguments: object, **named: object) -> None: ...
else:
    _HttpProtocol = HttpToolsProtocol

# The head of a request: its bytes in total, the bytes of its target and of each header, and the number of headers. The
# last two are what the WebSocket handshake accepts, too. Chunk sizes and trailers count as a head.
_MOST_HEAD_BYTES: Final = 32_768
_MOST_TARGET_BYTES: Final = 8000
_MOST_HEADER_BYTES: Final = 8000
_MOST_HEADERS: Final = 100
# Requests that wait for the answer to an earlier one on the same connection.
_MOST_WAITING_REQUESTS: Final = 32
# A head is parsed in small pieces: a piece may contain many requests.
_HEAD_PIECE: Final = 512
_BODY_PIECE: Final = 1 << 16
# The rest of a body that is read after its answer, so that the connection can be used again.
_MOST_UNWANTED_BYTES: Final = 1 << 18
_HEAD_END: Final = b"\r\n\r\n"
# The application answers a slow body itself at its time limit; the connection is closed a little later.
_BODY_GRACE_S: Final = 2.0

_HINTS: Final = {
    HTTPStatus.REQUEST_TIMEOUT: "send the head of a request at once",
    HTTPStatus.REQUEST_URI_TOO_LONG: f"at most {_MOST_TARGET_BYTES:,} bytes are accepted",
    HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE: f"at most {_MOST_HEADERS} headers of {_MOST_HEADER_BYTES:,} bytes, "
    f"{_MOST_HEAD_BYTES:,} in total, are accepted",
}


class HttpConnection(_HttpProtocol):
    """HTTP/1.1 on one connection of `table`, which has the limits."""

    # It exists from `connection_made` on, before any other event.
    _connection: Connection

    def __init__(self, table: ConnectionTable, **uvicorn: Any) -> None:
        super().__init__(**uvicorn)
        self._table = table
        self._timer: asyncio.TimerHandle | None = None
        self._unread = bytearray()
        self._refusal: HTTPStatus | None = None
        self._over = False
        self._between_requests = True
        self._has_turn = self._waits_for_turn = False
        self._head_bytes = self._headers_received = self._unwanted_bytes = 0
        self._got_body = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Takes the connection, if there may be another one. With TLS it has been admitted already."""
        if isinstance(transport, Connection):
            self._connection = transport
        else:
            self._connection = Connection(transport, self._table, self.loop)
            self._table.admit(self._connection)
        self._over = self._connection.is_closing()
        if not self._over:
            super().connection_made(self._connection)
            self._expect("head", self._table.limits.head_s)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops the timers: the peer is gone."""
        self._over = True
        self._cancel_timer()
        if self.transport is not None:
            super().connection_lost(exc)
        self._connection.lost()

    def data_received(self, data: bytes) -> None:
        """Parses what the peer has sent."""
        if not self._connection.discard(data):
            self._unread += data
            self._parse()

    def on_message_begin(self) -> None:
        """Starts the time limit of a head."""
        if self._over:
            return
        super().on_message_begin()
        self.scope["state"][STATE_KEY] = self._connection
        self._head_bytes = self._headers_received = self._unwanted_bytes = 0
        self._between_requests = self._connection.in_body = False
        if not self._has_turn:
            self._table.count_request(self._connection.address)
        self._has_turn = False
        self._expect("head", self._table.limits.head_s)

    def on_url(self, url: bytes) -> None:
        """Receives a part of the request target."""
        super().on_url(url)
        if len(self.url) > _MOST_TARGET_BYTES:
            self._refusal = HTTPStatus.REQUEST_URI_TOO_LONG

    def on_header(self, name: bytes, value: bytes) -> None:
        """Receives a header, or a trailer, which is ignored."""
        self._headers_received += 1
        if self._headers_received > _MOST_HEADERS or len(name) + len(value) > _MOST_HEADER_BYTES:
            self._refusal = HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
        elif not self._connection.in_body:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Starts the request, and the time limit of its body."""
        if self._over or self._refusal is not None:
            return
        self._connection.in_body = True
        if len(self.pipeline) >= _MOST_WAITING_REQUESTS:
            self._cut("pipeline")
            return
        super().on_headers_complete()
        self._expect("body", self._table.limits.body_s + _BODY_GRACE_S)

    def on_body(self, body: bytes) -> None:
        """Receives a part of the body."""
        self._got_body = True
        if self._over or self._refusal is not None:
            return
        super().on_body(body)
        self._unwanted_bytes += len(body) if self.cycle.response_complete else 0
        if self._unwanted_bytes > _MOST_UNWANTED_BYTES:
            self._end()

    def on_message_complete(self) -> None:
        """Ends the time limit of the request: what follows is the service's own work."""
        self._between_requests, self._connection.in_body = True, False
        if self._over or self._refusal is not None:
            return
        self._cancel_timer()
        super().on_message_complete()
        if self.cycle is not None and self.cycle.response_complete:
            self._expect_next_request()

    def on_response_complete(self) -> None:
        """Continues with the next request, or waits for it."""
        super().on_response_complete()
        if self._between_requests and not self.pipeline and not self._over:
            self._expect_next_request()
        if self._unread:
            self.loop.call_soon(self._parse)

    def handle_websocket_upgrade(self) -> None:
        """Passes the connection on to the WebSocket protocol."""
        if self._refusal is not None:
            return
        self._over = True
        self._connection.in_body = False
        self._cancel_timer()
        self._unread.clear()
        self._connection.hold_reading(False)
        super().handle_websocket_upgrade()

    def _parse(self) -> None:
        """Feeds the parser piece by piece, until a request waits for an earlier answer or the peer is too fast."""
        while self._unread and not self._over and not self.pipeline:
            if self._between_requests and not self._take_turn():
                break
            size = self._piece_size()
            piece = bytes(self._unread[:size])
            del self._unread[:size]
            self._got_body = False
            super().data_received(piece)
            self._check_head(len(piece))
        if not self._over:
            self._connection.hold_reading(bool(self._unread))

    def _check_head(self, received: int) -> None:
        if self._over:
            return
        self._head_bytes = 0 if self._got_body else self._head_bytes + received
        if self._head_bytes > _MOST_HEAD_BYTES and not self._between_requests:
            self._refusal = self._refusal or HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE
        if self._refusal is not None:
            self._refuse(self._refusal)

    def _piece_size(self) -> int:
        """Returns how much to parse at a time: a part of a body, or of a head up to its end."""
        if self._connection.in_body:
            return _BODY_PIECE
        end = self._unread.find(_HEAD_END, 0, _HEAD_PIECE)
        return _HEAD_PIECE if end < 0 else end + len(_HEAD_END)

    def _take_turn(self) -> bool:
        """Returns whether the next request may begin; if not, it begins as soon as it may."""
        if not self._has_turn and not self._waits_for_turn:
            self._has_turn = self._table.begin_request(self._connection.address, self._proceed)
            self._waits_for_turn = not self._has_turn
        return self._has_turn

    def _proceed(self) -> None:
        self._has_turn, self._waits_for_turn = True, False
        self._parse()

    def _expect(self, what: CutReason, seconds: float) -> None:
        self._cancel_timer()
        self._timer = self.loop.call_later(seconds, self._time_out, what)

    def _expect_next_request(self) -> None:
        self._cancel_timer()
        self._timer = self.loop.call_later(self._table.limits.keep_alive_s, self.transport.close)

    def _cancel_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _time_out(self, what: CutReason) -> None:
        if what == "head":
            self._refuse(HTTPStatus.REQUEST_TIMEOUT)
        else:
            self._cut(what)

    def _refuse(self, status: HTTPStatus) -> None:
        """Answers the head of a request with an error, unless an earlier request is being answered, and closes."""
        if self.cycle is None or self.cycle.response_complete:
            message = f"the head of the request is refused: {status.phrase.lower()}"
            self._connection.write(raw_response(status, status.name.lower(), message, _HINTS[status]))
        self._table.report("head", self._connection.address)
        self._end()

    def _end(self) -> None:
        """Closes the connection after the last answer, whatever the peer still sends."""
        self._over = True
        self._cancel_timer()
        self._unread.clear()
        self._connection.linger()

    def _cut(self, reason: CutReason) -> None:
        self._over = True
        self._cancel_timer()
        self._connection.cut(reason)
