"""Error responses: the HTTP status and JSON body of a refused request or handshake."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException

from lanestream.api.request_id import current_request_id
from lanestream.errors import LanestreamError, ProtocolError, one_line, wire_status
from lanestream.protocol import error_message

if TYPE_CHECKING:
    from fastapi import FastAPI, WebSocket


class Problem(BaseModel):
    """The body of every error response. `request_id` is null if the head of the request was refused."""

    code: str
    message: str
    hint: str
    request_id: str | None = None


def install_error_handlers(app: FastAPI) -> None:
    """Makes `app` answer every error with a Problem and count it."""
    app.add_exception_handler(LanestreamError, _handle_error)
    app.add_exception_handler(RequestValidationError, _handle_invalid_request)
    app.add_exception_handler(HTTPException, _handle_http_error)
    app.add_exception_handler(Exception, _handle_error)


async def deny_handshake(socket: WebSocket, error: LanestreamError) -> None:
    """Answers a WebSocket handshake with an error response, so that the socket is never opened."""
    socket.app.state.service.metrics.refused(error.code)
    await socket.send_denial_response(_error_response(error))


async def _handle_error(request: Request, error: Exception) -> JSONResponse:
    request.app.state.service.metrics.refused(error_message(error).code)
    return _error_response(error)


async def _handle_invalid_request(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)  # noqa: S101 - the class this handler is registered for
    problem = error.errors()[0]
    location = ".".join(str(part) for part in problem["loc"])
    return await _handle_error(request, ProtocolError(f"{location}: {problem['msg']}", "see /docs"))


async def _handle_http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)  # noqa: S101 - the class this handler is registered for
    code = HTTPStatus(error.status_code).name.lower()
    request.app.state.service.metrics.refused(code)
    # The path as it was sent: a Host header can change the path that `request.url` returns.
    message = one_line(f"{request.method} {one_line(request.scope['path'], 80)}: {error.detail}")
    response = _response(error.status_code, code, message, "see /docs")
    response.headers.update(error.headers or {})
    return response


def raw_response(status: HTTPStatus, code: str, message: str, hint: str) -> bytes:
    """Returns an error response as bytes, for a connection that is closed before the application sees its request."""
    body = Problem(code=code, message=message, hint=hint).model_dump_json().encode()
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}\r\n"
        f"content-type: application/json\r\ncontent-length: {len(body)}\r\nconnection: close\r\n\r\n"
    )
    return head.encode() + body


def _error_response(error: Exception) -> JSONResponse:
    shown = error_message(error)
    return _response(wire_status(error).http_status, shown.code, shown.message, shown.hint)


def _response(status: int, code: str, message: str, hint: str) -> JSONResponse:
    """Returns the response with this status and body, and the headers that the status requires."""
    headers = {}
    if status in (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, HTTPStatus.REQUEST_TIMEOUT):
        # The rest of a body that is too large or too slow is never read.
        headers["connection"] = "close"
    if status == HTTPStatus.UNAUTHORIZED:
        headers["www-authenticate"] = "Bearer"
    problem = Problem(code=code, message=message, hint=hint, request_id=current_request_id())
    return JSONResponse(problem.model_dump(), status, headers)
