"""Authentication: API keys and access tokens, and for browsers the origin of the page. Checked before any work is done.

Each route declares its guard itself; nothing depends on how a path is spelled, so no spelling of a path evades it.
"""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Self
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from lanestream.api.access_tokens import TokenSigner
from lanestream.errors import ForbiddenError, ProtocolError, UnauthorizedError
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
    """Identifies callers. Without `keys` every caller is accepted; `origins` are the allowed foreign web origins.

    `signer` signs and verifies access tokens; None if they are not accepted.
    """

    keys: Sequence[ApiKey] = ()
    origins: frozenset[str] = frozenset()
    signer: TokenSigner | None = None

    @classmethod
    def from_settings(cls, settings: Settings) -> Self:
        """Returns the authenticator for these settings. Raises SettingsError if the file of API keys can't be used."""
        return cls(_read_keys(settings), frozenset(settings.allowed_origins), TokenSigner.from_settings(settings))

    def with_keys_of(self, settings: Settings) -> Self:
        """Returns this authenticator with the keys that the file has now. Raises SettingsError if it can't be used."""
        return replace(self, keys=_read_keys(settings))

    def knows(self, caller: Caller) -> bool:
        """Returns whether `caller`, who was authenticated before, would still be: keys can be removed."""
        return not self.keys or any(key.name == caller.identity for key in self.keys)

    def authenticate(self, connection: HTTPConnection) -> Caller:
        """Returns the caller behind a request, or behind a WebSocket that is not accepted yet.

        Raises ForbiddenError for a web page of a foreign origin, and UnauthorizedError for a missing or unknown key
        and for an access token that has expired or whose key was removed.
        """
        # Browsers send the page's origin; programs usually send none.
        self.check_origin(connection, connection.headers.get("origin"))
        if not self.keys:
            return Caller(_ANONYMOUS, connection.client.host if connection.client else _ANONYMOUS)
        credential = _credential(connection)
        key = find_key(self.keys, credential)
        name = self._token_subject(credential) if key is None else key.name
        if name is None:
            raise UnauthorizedError("this API key is unknown", "ask the operator of the service for a key")
        return Caller(name, name)

    def issue_token(self, connection: HTTPConnection) -> str:
        """Returns an access token for the caller whose API key a request has.

        Raises ProtocolError if the service requires no keys, and UnauthorizedError for anything but a valid key: a
        token can't be used to get another one.
        """
        if self.signer is None or not self.keys:
            raise ProtocolError("this service requires no API key", "connect without a token")
        key = find_key(self.keys, _credential(connection))
        if key is None:
            raise UnauthorizedError("an access token is issued only for an API key", _HOW)
        return self.signer.sign(key.name)

    def _token_subject(self, credential: str) -> str | None:
        """Returns the name in an access token; None if it is not a token, or if its key was removed."""
        name = None if self.signer is None else self.signer.verify(credential)
        return name if any(key.name == name for key in self.keys) else None

    def check_origin(self, connection: HTTPConnection, origin: str | None) -> None:
        """Raises ForbiddenError if pages of this origin may not use the service under the host name of `connection`."""
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


def _read_keys(settings: Settings) -> tuple[ApiKey, ...]:
    from_file = () if settings.api_keys_file is None else read_keys(settings.api_keys_file)
    return (*settings.api_keys, *from_file)


def _credential(connection: HTTPConnection) -> str:
    """Returns the key or token in the Authorization header, or if that header is missing, in a subprotocol.

    Raises UnauthorizedError if there is neither.
    """
    header = connection.headers.get("authorization")
    if header is not None:
        scheme, _, credential = header.strip().partition(" ")
        if scheme.lower() == _SCHEME:
            return credential.strip()
    else:
        for subprotocol in connection.scope.get("subprotocols", ()):
            if subprotocol.startswith(KEY_SUBPROTOCOL):
                return str(subprotocol).removeprefix(KEY_SUBPROTOCOL)
    raise UnauthorizedError("an API key is required", _HOW)


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
