"""Authentication: API keys, and for browsers the origin of the page. Checked before any work is done.

Each route declares its guard itself; nothing depends on how a path is spelled, so no spelling of a path evades it.
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
from lanestream.keys import ApiKey, find_key, read_keys
from lanestream.protocol import KEY_SUBPROTOCOL
from lanestream.streaming.session_registry import Caller

if TYPE_CHECKING:
    from lanestream.settings import Settings

_log = logging.getLogger(__name__)

_ANONYMOUS: Final = "anonymous"
_SCHEME: Final = "bearer"
_HOW: Final = "send the header `Authorization: Bearer KEY`; from a browser, offer the subprotocol `bearer.KEY`"
_PORTS: Final = {"http": 80, "https": 443}


@dataclass(frozen=True)
class Authenticator:
    """Identifies callers. Without `keys` every caller is accepted; `origins` are the allowed foreign web origins."""

    keys: Sequence[ApiKey] = ()
    origins: frozenset[str] = frozenset()

    @classmethod
    def from_settings(cls, settings: Settings) -> Self:
        """Returns the authenticator for these settings. Raises SettingsError if the file of API keys can't be used."""
        from_file = read_keys(settings.api_keys_file) if settings.api_keys_file is not None else ()
        return cls((*settings.api_keys, *from_file), frozenset(settings.allowed_origins))

    def authenticate(self, connection: HTTPConnection) -> Caller:
        """Returns the caller behind a request, or behind a WebSocket that is not accepted yet.

        Raises ForbiddenError for a web page of a foreign origin, and UnauthorizedError for a missing or unknown key.
        """
        self._check_origin(connection)
        if not self.keys:
            return Caller(_ANONYMOUS, connection.client.host if connection.client else _ANONYMOUS)
        token = _token(connection)
        if token is None:
            raise UnauthorizedError("an API key is required", _HOW)
        key = find_key(self.keys, token)
        if key is None:
            raise UnauthorizedError("this API key is unknown", "ask the operator of the service for a key")
        return Caller(key.name, key.name)

    def _check_origin(self, connection: HTTPConnection) -> None:
        """Raises ForbiddenError for a foreign origin. Browsers send the page's origin; programs usually send none."""
        origin = connection.headers.get("origin")
        if origin is None or origin in self.origins or self._is_own(origin, connection.headers.get("host", "")):
            return
        raise ForbiddenError(
            "web pages of this origin are not allowed to use the service",
            "add the origin to LANESTREAM_ALLOWED_ORIGINS",
        )

    def _is_own(self, origin: str, host: str) -> bool:
        """Returns whether the service itself served a page of `origin`; `host` is the request's Host header."""
        # A proxy may terminate TLS, so only the page knows the scheme, which implies the default port.
        scheme = origin.partition("://")[0]
        address = _address(origin)
        if address is None or address != _address(f"{scheme}://{host}"):
            return False
        # DNS rebinding: the owner of a host name can point it at this service after a browser has loaded their page.
        # That works neither for IP addresses nor when keys are required, since their page has no key.
        return bool(self.keys) or _is_fixed(address[0])


def warn_if_open(authenticator: Authenticator, host: str, *, loopback: bool) -> None:
    """Logs a warning if everyone who can reach `host` may use the service."""
    if not authenticator.keys and not loopback:
        _log.warning(
            "NO API KEYS: everyone who can reach %s may use this service. Create a key with `lanestream key NAME`"
            " and set LANESTREAM_API_KEYS, or listen on 127.0.0.1",
            host,
        )


def _token(connection: HTTPConnection) -> str | None:
    """Returns the key in the Authorization header, or if that header is missing, in a subprotocol."""
    header = connection.headers.get("authorization")
    if header is not None:
        scheme, _, token = header.strip().partition(" ")
        return token.strip() if scheme.lower() == _SCHEME else None
    for subprotocol in connection.scope.get("subprotocols", ()):
        if subprotocol.startswith(KEY_SUBPROTOCOL):
            return str(subprotocol).removeprefix(KEY_SUBPROTOCOL)
    return None


def _address(url: str) -> tuple[str, int | None] | None:
    """Returns the host and port of a URL; None if it has no host."""
    try:
        parts = urlsplit(url)
        port = parts.port or _PORTS.get(parts.scheme)
    except ValueError:
        return None
    return (parts.hostname, port) if parts.hostname else None


def _is_fixed(host: str) -> bool:
    """Returns whether `host` is resolved without DNS."""
    if host == "localhost":
        return True
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
