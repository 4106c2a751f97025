"""The application: its routes, its life and the way errors leave it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from lanestream import __version__
from lanestream.api import rest, stream
from lanestream.api.service import Draw, Service
from lanestream.errors import LanestreamError, ProtocolError, answer_to
from lanestream.protocol import error_message

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.settings import Settings


def create_app(engine: Engine | None, settings: Settings, draw: Draw | None = None) -> FastAPI:
    """The application around a warm `engine`.

    Without an engine it lives but is not ready until `app.state.service.install(engine)`. `draw` paints the lanes of a
    message on a BGR image (H, W, 3) uint8; without it pictures are refused.
    """
    service = Service(settings, draw)
    if engine is not None:
        service.install(engine)

    @asynccontextmanager
    async def life(_: FastAPI) -> AsyncIterator[None]:
        yield
        await service.close()

    app = FastAPI(
        title="Lanestream",
        version=__version__,
        description="Camera frames in, tracked lane lines out. Streams of frames go to the WebSocket `/v1/stream`.",
        lifespan=life,
    )
    app.state.service = service
    app.include_router(rest.router)
    app.include_router(stream.router)
    app.add_exception_handler(LanestreamError, _tell)
    app.add_exception_handler(RequestValidationError, _tell_invalid)
    app.add_exception_handler(HTTPException, _tell_http)
    app.add_exception_handler(Exception, _tell)
    return app


async def _tell(request: Request, error: Exception) -> JSONResponse:
    told = error_message(error)
    request.app.state.service.metrics.refused(told.code)
    return _answer(answer_to(error).http_status, told.code, told.message, told.hint)


async def _tell_invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)  # noqa: S101  (this is the class it is registered for)
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    return await _tell(request, ProtocolError(f"{where}: {problem['msg']}", "see /docs"))


async def _tell_http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)  # noqa: S101  (this is the class it is registered for)
    code = HTTPStatus(error.status_code).name.lower()
    answer = _answer(error.status_code, code, f"{request.method} {request.url.path}: {error.detail}", "see /docs")
    answer.headers.update(error.headers or {})
    return answer


def _answer(status: int, code: str, message: str, hint: str) -> JSONResponse:
    # What is left of a body that is too large will not be read.
    headers = {"connection": "close"} if status == HTTPStatus.REQUEST_ENTITY_TOO_LARGE else None
    return JSONResponse({"code": code, "message": message, "hint": hint}, status, headers)
