"""A time limit for the head of an HTTP request. uvicorn has none and would keep a silent connection open forever."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

_TIMEOUT_RESPONSE: Final = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"

if TYPE_CHECKING:
    # uvicorn does not annotate this class.
    class _HttpProtocol(HttpToolsProtocol):
        def __init__(self, *arguments: object, **named: object) -> None: ...
else:
    _HttpProtocol = HttpToolsProtocol


class HeaderTimeoutProtocol(_HttpProtocol):
    """HTTP/1.1 whose request heads must be complete `head_s` seconds after the connection or after their first byte.

    Request bodies have their own limit, and uvicorn closes connections that are idle between two requests.
    """

    head_s: float

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Starts the timer for the first request."""
        super().connection_made(transport)
        self._timer: asyncio.TimerHandle | None = None
        self._start_timer()

    def on_message_begin(self) -> None:
        """Starts the timer for a further request."""
        super().on_message_begin()
        self._start_timer()

    def on_headers_complete(self) -> None:
        """Stops the timer: the head is complete."""
        self._stop_timer()
        super().on_headers_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops the timer: the client is gone."""
        self._stop_timer()
        super().connection_lost(exc)

    def _start_timer(self) -> None:
        if self._timer is None:
            self._timer = self.loop.call_later(self.head_s, self._time_out)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _time_out(self) -> None:
        # Never write into the response to an earlier, pipelined request.
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(_TIMEOUT_RESPONSE)
        self.transport.close()


def with_header_timeout(head_s: float) -> type[HeaderTimeoutProtocol]:
    """Returns the protocol class with a limit of `head_s` seconds; uvicorn creates the instances."""
    return type("HeaderTimeoutProtocol", (HeaderTimeoutProtocol,), {"head_s": head_s})
