"""HTTP connections on which nobody says anything: uvicorn would hold them for ever."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

_ANSWER: Final = b"HTTP/1.1 408 Request Timeout\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"

if TYPE_CHECKING:
    # What uvicorn does not annotate.
    class _Http(HttpToolsProtocol):
        def __init__(self, *arguments: object, **named: object) -> None: ...
else:
    _Http = HttpToolsProtocol


class PunctualHttp(_Http):
    """HTTP/1.1 with a limit to how long the head of a request may take, from the connection or from its first byte.

    Bodies have a limit of their own, and connections between two requests have uvicorn's.
    """

    head_s: float

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client came: it has to say what it wants."""
        super().connection_made(transport)
        self._due: asyncio.TimerHandle | None = None
        self._expect()

    def on_message_begin(self) -> None:
        """A head begins."""
        super().on_message_begin()
        self._expect()

    def on_headers_complete(self) -> None:
        """A head is there."""
        self._forget()
        super().on_headers_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        """The client is gone."""
        self._forget()
        super().connection_lost(exc)

    def _expect(self) -> None:
        if self._due is None:
            self._due = self.loop.call_later(self.head_s, self._give_up)

    def _forget(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _give_up(self) -> None:
        # The answer to an earlier request is no place for another one.
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(_ANSWER)
        self.transport.close()


def punctual(head_s: float) -> type[PunctualHttp]:
    """The protocol with this limit, in seconds."""
    return type("PunctualHttp", (PunctualHttp,), {"head_s": head_s})
