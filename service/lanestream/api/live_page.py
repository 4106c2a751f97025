"""Serves the live page: files of the folder `static`, which need no key and hold no secret."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import BaseRoute
    from starlette.types import Scope

_FOLDER: Final = Path(__file__).parent / "static"

_POLICY: Final = (
    "default-src 'self'",
    "img-src 'self' blob: data:",
    "media-src 'self' blob:",
    "object-src 'none'",
    "base-uri 'none'",
    "form-action 'none'",
    "frame-ancestors 'none'",
)
_HEADERS: Final[Mapping[str, str]] = {
    # The page runs only its own scripts and connects only to this service, whatever a video or a message contains.
    "content-security-policy": "; ".join(_POLICY),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "permissions-policy": "camera=(self), display-capture=(self), microphone=(), geolocation=()",
    # Browsers ask again each time, and a page never mixes the files of two versions.
    "cache-control": "no-cache",
}


class _Files(StaticFiles):
    """The files of a folder with the headers of the page."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update(_HEADERS)
        return response


def routes() -> list[BaseRoute]:
    """Returns the routes of the page at `/` and of its files below `/static/`."""
    return [Route("/", _index), Mount("/static", _Files(directory=_FOLDER))]


async def _index(_: Request) -> FileResponse:
    return FileResponse(_FOLDER / "index.html", headers=dict(_HEADERS))
