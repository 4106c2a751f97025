"""Where the service is, told once: one URL for requests and for streams."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

from lanestream.errors import SettingsError

_WEBSOCKET_SCHEMES = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}
_HTTP_SCHEMES = {"http": "http", "https": "https", "ws": "http", "wss": "https"}


@dataclass(frozen=True)
class Endpoint:
    """The service's place: `base` for people, `http` and `stream` for requests and for the WebSocket."""

    base: str
    http: str
    stream: str

    @classmethod
    def parse(cls, url: str) -> Endpoint:
        """The place at `url`, http, https, ws or wss, with or without a path before `/v1`. Raises SettingsError."""
        refused = SettingsError(f"{url!r} is no address of a service", "http://127.0.0.1:8000 would be one")
        try:
            parts = urlsplit(url if "://" in url else f"http://{url}")
            known = parts.scheme in _HTTP_SCHEMES and bool(parts.hostname) and parts.port != 0
        except ValueError:
            raise refused from None
        if not known:
            raise refused
        path = parts.path.removesuffix("/v1/stream").rstrip("/")
        place = f"{parts.netloc}{path}"
        scheme = _HTTP_SCHEMES[parts.scheme]
        return cls(url, f"{scheme}://{place}", f"{_WEBSOCKET_SCHEMES[parts.scheme]}://{place}/v1/stream")
