"""The pages for browsers: the live page, and the documentation of the REST API. Both work without internet access."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fastapi.openapi.docs import get_swagger_ui_html
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.routing import BaseRoute
    from starlette.types import Scope

_FOLDER: Final = Path(__file__).parent / "static"

# A page runs only its own scripts and connects only to this service, whatever a video or a message contains.
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
    "content-security-policy": "; ".join(_POLICY),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "permissions-policy": "camera=(self), display-capture=(self), microphone=(), geolocation=()",
    # Browsers ask again each time, and a page never mixes the files of two versions.
    "cache-control": "no-cache",
}
# Swagger UI is started by a script in its page, and sets styles in its scripts.
_DOCS_POLICY: Final = (*_POLICY, "script-src 'self' 'unsafe-inline'", "style-src 'self' 'unsafe-inline'")


class _Files(StaticFiles):
    """Files with the headers of the pages."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update(_HEADERS)
        return response


def live_page() -> list[BaseRoute]:
    """Returns the routes of the live page at `/` and of its files below `/static/`."""
    return [Route("/", _index), Mount("/static", _Files(directory=_FOLDER))]


def docs_page() -> list[BaseRoute]:
    """Returns the routes of the API's documentation at `/docs`: Swagger UI, whose files are part of a package."""
    return [Route("/docs", _docs), Mount("/swagger", _Files(packages=[("fastapi_swagger", "resources")]))]


async def _index(_: Request) -> FileResponse:
    return FileResponse(_FOLDER / "index.html", headers=dict(_HEADERS))


async def _docs(_: Request) -> Response:
    # Relative, since a proxy may serve the service below a path.
    page = get_swagger_ui_html(
        openapi_url="openapi.json",
        title="Lanestream",
        swagger_js_url="swagger/swagger-ui-bundle.js",
        swagger_css_url="swagger/swagger-ui.css",
        swagger_favicon_url="swagger/favicon-32x32.png",
    )
    page.headers.update({**_HEADERS, "content-security-policy": "; ".join(_DOCS_POLICY)})
    return page
