"""Creates the application: routes, middleware, error handlers and lifespan."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from fastapi import Depends, FastAPI
from fastapi.security import HTTPBearer
from starlette.middleware.cors import CORSMiddleware

from lanestream import __version__
from lanestream.api import pages, rest, websocket
from lanestream.api.problems import install_error_handlers
from lanestream.api.request_id import REQUEST_ID_HEADER, RequestIds
from lanestream.api.service import DrawLanes, Service
from lanestream.workers.thread_pool import ThreadPool

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from lanestream.engine import Engine
    from lanestream.settings import Settings


def create_app(engine: Engine | None, settings: Settings, draw: DrawLanes | None = None) -> FastAPI:
    """Returns the application around a warm `engine`, which processes frames in threads of this process.

    Without an engine the application is alive but not ready until `app.state.service.install(pool)` is called. `draw`
    paints the lanes of a message on a BGR image (H, W, 3) uint8; without it, requests for pictures are refused. Raises
    SettingsError if the file of API keys or the Redis URL can't be used.
    """
    service = Service(settings, draw)
    if engine is not None:
        threads = settings.threads_per_process(1)
        service.install(ThreadPool(engine, settings.image_limits, threads, service.metrics.batch))

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        service.sessions.begin()
        yield
        await service.close()

    app = _Application(
        title="Lanestream",
        version=__version__,
        description="Camera frames in, tracked lane lines out. Streams of frames go to the WebSocket `/v1/stream`.",
        # FastAPI's own pages load scripts from another site.
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.service = service
    _include_routes(app, settings, with_keys=bool(service.authenticator.keys))
    if settings.allowed_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.allowed_origins,
            allow_methods=("GET", "POST"),
            allow_headers=("Authorization", REQUEST_ID_HEADER),
            expose_headers=(REQUEST_ID_HEADER,),
        )
    install_error_handlers(app)
    return app


class _Application(FastAPI):
    def build_middleware_stack(self) -> ASGIApp:
        """Returns the application with all middleware: outermost the ids, which answers to unexpected errors need."""
        return RequestIds(super().build_middleware_stack())


def _include_routes(app: FastAPI, settings: Settings, *, with_keys: bool) -> None:
    """Adds the public routes, and the others behind the authenticator."""
    guard = [Depends(rest.authenticated)]
    if with_keys:
        # Documents the key in OpenAPI; `rest.authenticated` checks it.
        guard.append(Depends(HTTPBearer(auto_error=False, description="An API key created by `lanestream key`.")))
    app.include_router(rest.public_router)
    app.include_router(rest.router, dependencies=guard, responses=rest.AUTH_PROBLEMS)
    if settings.metrics_access == "keys":
        app.include_router(rest.metrics_router, dependencies=guard, responses=rest.AUTH_PROBLEMS)
    elif settings.metrics_access == "open":
        app.include_router(rest.metrics_router)
    app.include_router(websocket.router)
    app.router.routes.extend(pages.docs_page())
    if settings.live_page:
        app.router.routes.extend(pages.live_page())
