"""Who may come in: API keys, and for browsers the page that they come from. Asked before any work is done.

Routes are guarded by what they are, never by how their path reads: a request can't be spelled past the guard.
"""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from lanestream.errors import ForbiddenError, UnauthorizedError
from lanestream.keys import ApiKey, find, read_keys
from lanestream.protocol import KEY_SUBPROTOCOL
from lanestream.streaming.caller import ANONYMOUS, Caller

if TYPE_CHECKING:
    from lanestream.settings import Settings

_log = logging.getLogger(__name__)

_SCHEME: Final = "bearer"
_HOW: Final = "send the header `Authorization: Bearer KEY`, or from a browser offer the subprotocol `bearer.KEY`"
_PORTS: Final = {"http": 80, "https": 443}


@dataclass(frozen=True)
class Authenticator:
    """Lets callers in. Without `keys` everybody may come; `origins` are the web pages that may, beside our own."""

    keys: Sequence[ApiKey] = ()
    origins: frozenset[str] = frozenset()

    @classmethod
    def of(cls, settings: Settings) -> Self:
        """The authenticator that the settings ask for. Raises SettingsError where the file of keys can't be used."""
        listed = read_keys(settings.api_keys_file) if settings.api_keys_file is not None else ()
        return cls((*settings.api_keys, *listed), frozenset(settings.allowed_origins))

    def admit(self, connection: HTTPConnection) -> Caller:
        """The caller behind a request or a WebSocket that is not accepted yet.

        Raises ForbiddenError where it comes from a web page of a foreign origin, and UnauthorizedError where it comes
        without a key or with a wrong one.
        """
        self._check_origin(connection)
        if not self.keys:
            return Caller(ANONYMOUS, connection.client.host if connection.client else ANONYMOUS)
        token = _token(connection)
        if token is None:
            raise UnauthorizedError("an API key is needed", _HOW)
        key = find(self.keys, token)
        if key is None:
            raise UnauthorizedError("this API key is not known", "ask whoever runs the service for one")
        return Caller(key.name, key.name)

    def _check_origin(self, connection: HTTPConnection) -> None:
        """Browsers tell the page's origin, and let no page tell another; what is no browser mostly tells none."""
        origin = connection.headers.get("origin")
        if origin is None or origin in self.origins or self._is_ours(origin, connection.headers.get("host", "")):
            return
        raise ForbiddenError(
            "web pages of this origin may not use the service", "add the origin to LANESTREAM_ALLOWED_ORIGINS"
        )

    def _is_ours(self, origin: str, host: str) -> bool:
        """Whether a page of this origin came from us; `host` is what its browser calls us, with the port."""
        # Only the page knows whether a proxy in front of us speaks TLS, and with that which port goes without saying.
        scheme = origin.partition("://")[0]
        place = _place(origin)
        if place is None or place != _place(f"{scheme}://{host}"):
            return False
        # Whoever owns a name can have it lead to us after a browser has loaded their page by it (DNS rebinding). Nobody
        # can do that to an address; and where keys are asked for, their page has none.
        return bool(self.keys) or _is_fixed(place[0])


def warn_if_open(authenticator: Authenticator, host: str, *, loopback: bool) -> None:
    """Says loudly that everybody who can reach `host` may use the service, where that is so."""
    if not authenticator.keys and not loopback:
        _log.warning(
            "NO API KEYS: everybody who can reach %s may use this service. Make a key with `lanestream key NAME`"
            " and set LANESTREAM_API_KEYS, or listen on 127.0.0.1",
            host,
        )


def _token(connection: HTTPConnection) -> str | None:
    header = connection.headers.get("authorization")
    if header is not None:
        scheme, _, token = header.strip().partition(" ")
        return token.strip() if scheme.lower() == _SCHEME else None
    for offered in connection.scope.get("subprotocols", ()):
        if offered.startswith(KEY_SUBPROTOCOL):
            return str(offered).removeprefix(KEY_SUBPROTOCOL)
    return None


def _place(url: str) -> tuple[str, int | None] | None:
    """The host and the port of a URL; None where it names no host."""
    try:
        parts = urlsplit(url)
        port = parts.port or _PORTS.get(parts.scheme)
    except ValueError:
        return None
    return (parts.hostname, port) if parts.hostname else None


def _is_fixed(host: str) -> bool:
    """Whether no name service decides where this host is."""
    if host == "localhost":
        return True
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
