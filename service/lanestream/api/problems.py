"""How a refused request is answered: the status and the JSON body of an error."""

from __future__ import annotations

from http import HTTPStatus
from typing import TYPE_CHECKING

from fastapi.responses import JSONResponse
from pydantic import BaseModel

from lanestream.errors import answer_to
from lanestream.protocol import error_message

if TYPE_CHECKING:
    from fastapi import WebSocket


class Problem(BaseModel):
    """What every refused request is answered with."""

    code: str
    message: str
    hint: str


def problem_of(error: BaseException) -> JSONResponse:
    """The answer that tells `error`."""
    told = error_message(error)
    return problem_response(answer_to(error).http_status, Problem(code=told.code, message=told.message, hint=told.hint))


def problem_response(status: int, problem: Problem) -> JSONResponse:
    """The answer with this status and body, and the headers that belong to the status."""
    headers = {}
    if status in (HTTPStatus.REQUEST_ENTITY_TOO_LARGE, HTTPStatus.REQUEST_TIMEOUT):
        # What is left of a body that is too large or too slow will not be read.
        headers["connection"] = "close"
    if status == HTTPStatus.UNAUTHORIZED:
        headers["www-authenticate"] = "Bearer"
    return JSONResponse(problem.model_dump(), status, headers)


async def deny(socket: WebSocket, error: BaseException) -> None:
    """Answers a WebSocket's handshake with `error` as any request would be, so that it is never opened."""
    socket.app.state.service.metrics.refused(error_message(error).code)
    await socket.send_denial_response(problem_of(error))
