"""Request ids: one for each request and each stream, in its response, in problems, in log records and in spans."""

from __future__ import annotations

import re
import secrets
from typing import TYPE_CHECKING, Final

from lanestream.logs import request_fields

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

REQUEST_ID_HEADER: Final = "X-Request-ID"
_HEADER: Final = REQUEST_ID_HEADER.lower().encode()
# What proxies and tracing libraries generate: UUIDs, hexadecimal numbers, base64. Nothing that could forge a log line.
_ACCEPTED: Final = re.compile(rb"[A-Za-z0-9._:=+/@-]{1,128}")
_GENERATED_BYTES: Final = 8
_STARTS: Final = frozenset({"http.response.start", "websocket.accept", "websocket.http.response.start"})


class RequestIds:
    """ASGI middleware that gives each request and each WebSocket an id: the caller's if it is well-formed.

    The server runs each of them in a task of its own, so the log fields of one never reach another.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Runs the application."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        given = next((value for name, value in scope["headers"] if name == _HEADER), b"")
        request_id = given if _ACCEPTED.fullmatch(given) else secrets.token_hex(_GENERATED_BYTES).encode()
        request_fields.set({"request_id": request_id.decode()})

        async def send_with_id(message: Message) -> None:
            if message["type"] in _STARTS:
                message = {**message, "headers": [*message.get("headers", ()), (_HEADER, request_id)]}
            await send(message)

        await self._app(scope, receive, send_with_id)


def current_request_id() -> str:
    """Returns the id of the request or stream that is handled; an empty string outside of them."""
    return request_fields.get().get("request_id", "")


def add_trace(trace_id: str | None) -> None:
    """Adds a trace to the log records of the request that is handled, if it has one."""
    if trace_id is not None:
        request_fields.set({**request_fields.get(), "trace_id": trace_id})
