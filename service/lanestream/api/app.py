"""The application: its routes, its life and the way errors leave it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING

from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.security import HTTPBearer
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware

from lanestream import __version__
from lanestream.api import rest, websocket
from lanestream.api.problems import Problem, problem_of, problem_response
from lanestream.api.service import Draw, Service
from lanestream.errors import LanestreamError, ProtocolError, one_line
from lanestream.protocol import error_message
from lanestream.workers.thread_pool import ThreadPool

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.settings import Settings


def create_app(engine: Engine | None, settings: Settings, draw: Draw | None = None) -> FastAPI:
    """The application around a warm `engine`, whose frames are worked on in threads of this process.

    Without an engine it lives but is not ready until `app.state.service.install(runner)`. `draw` paints the lanes of a
    message on a BGR image (H, W, 3) uint8; without it pictures are refused. Raises SettingsError where the file of API
    keys can't be used.
    """
    service = Service(settings, draw)
    if engine is not None:
        threads = settings.threads_of(1)
        service.install(ThreadPool(engine, settings.image_limits, threads, service.metrics.batch))

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
    _include_routes(app, settings, with_keys=bool(service.authenticator.keys))
    if settings.allowed_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.allowed_origins,
            allow_methods=("GET", "POST"),
            allow_headers=("Authorization",),
        )
    app.add_exception_handler(LanestreamError, _tell)
    app.add_exception_handler(RequestValidationError, _tell_invalid)
    app.add_exception_handler(HTTPException, _tell_http)
    app.add_exception_handler(Exception, _tell)
    return app


def _include_routes(app: FastAPI, settings: Settings, *, with_keys: bool) -> None:
    """Adds the routes, those that are not for everybody behind the authenticator."""
    guard = [Depends(rest.admitted)]
    if with_keys:
        guard.append(Depends(HTTPBearer(auto_error=False, description="An API key, as `lanestream key` makes them.")))
    app.include_router(rest.open_router)
    app.include_router(rest.router, dependencies=guard, responses=rest.REFUSALS)
    if settings.metrics_access == "keys":
        app.include_router(rest.metrics_router, dependencies=guard, responses=rest.REFUSALS)
    elif settings.metrics_access == "open":
        app.include_router(rest.metrics_router)
    app.include_router(websocket.router)


async def _tell(request: Request, error: Exception) -> JSONResponse:
    request.app.state.service.metrics.refused(error_message(error).code)
    return problem_of(error)


async def _tell_invalid(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)  # noqa: S101  (this is the class it is registered for)
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    return await _tell(request, ProtocolError(f"{where}: {problem['msg']}", "see /docs"))


async def _tell_http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)  # noqa: S101  (this is the class it is registered for)
    code = HTTPStatus(error.status_code).name.lower()
    request.app.state.service.metrics.refused(code)
    # The path as it came: what `request.url` reads can be bent by the Host header.
    message = one_line(f"{request.method} {one_line(request.scope['path'], 80)}: {error.detail}")
    answer = problem_response(error.status_code, Problem(code=code, message=message, hint="see /docs"))
    answer.headers.update(error.headers or {})
    return answer
