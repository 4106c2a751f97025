"""Where the service is, and what opens its door, told once: one URL for requests and for streams."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import urlsplit

from lanestream.errors import SettingsError

_WEBSOCKET_SCHEMES = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}
_HTTP_SCHEMES = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
_KEY: Final = re.compile(r"[!-~]{1,512}")  # what a header can carry


@dataclass(frozen=True)
class Endpoint:
    """A replica's place: `base` for people, `http` and `stream` for requests and for the WebSocket.

    `headers` go with each request and each handshake. Nothing secret is in `base` or in the representation.
    """

    base: str
    http: str = field(repr=False)
    stream: str = field(repr=False)
    headers: Mapping[str, str] = field(repr=False)

    @classmethod
    def parse(cls, url: str, api_key: str | None = None) -> Endpoint:
        """The place at `url`, http, https, ws or wss, with or without a path before `/v1`. Raises SettingsError."""
        refused = SettingsError(f"{_shown(url)!r} is no address of a service", "http://127.0.0.1:8000 would be one")
        try:
            parts = urlsplit(url if "://" in url else f"http://{url}")
            known = parts.scheme in _HTTP_SCHEMES and bool(parts.hostname) and parts.port != 0
        except ValueError:
            raise refused from None
        if not known:
            raise refused
        path = parts.path.removesuffix("/v1/stream").rstrip("/")
        place = f"{parts.netloc}{path}"
        return cls(
            base=_shown(url),
            http=f"{_HTTP_SCHEMES[parts.scheme]}://{place}",
            stream=f"{_WEBSOCKET_SCHEMES[parts.scheme]}://{place}/v1/stream",
            headers=_headers(api_key),
        )


def endpoints(url: str | Sequence[str], api_key: str | None = None) -> tuple[Endpoint, ...]:
    """The replicas at one URL or several. Raises SettingsError where one is none, where there is none, or no key."""
    urls = [url] if isinstance(url, str) else url
    if not urls:
        raise SettingsError("no address of a service was given", "http://127.0.0.1:8000 would be one")
    return tuple(Endpoint.parse(each, api_key) for each in urls)


def _headers(api_key: str | None) -> dict[str, str]:
    if api_key is None:
        return {}
    if not _KEY.fullmatch(api_key):
        raise SettingsError(
            "the API key can't be sent", "a key is one word of ASCII characters; look for a stray space"
        )
    return {"Authorization": f"Bearer {api_key}"}


def _shown(url: str) -> str:
    """The URL without what stands before an @, which may be a password."""
    return re.sub(r"^([^/]*//)?[^/]*@", r"\1", url)
