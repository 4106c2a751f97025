"""Where a service is, how to connect to it, and which error each failure to do so becomes.

The blocking and the async client share this module. One URL serves both REST requests and streams.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.client import responses
from ssl import SSLContext
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit

import httpx
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.http11 import Response
from websockets.typing import Subprotocol

from lanestream.errors import (
    ConnectionFailedError,
    EvictedError,
    IdleError,
    ImageTooLargeError,
    LanestreamError,
    ProtocolError,
    SettingsError,
    TooOldError,
    error_from_code,
    one_line,
)
from lanestream.protocol import SUBPROTOCOL
from lanestream_client.proxies import Proxy, find_proxy
from lanestream_client.redaction import redact_url, redact_urls
from lanestream_client.tls import tls_hint

# How long `ready` may take after a fast handshake: the service may first have to fetch the session from its store, or
# to close the previous socket of the session.
READY_TIMEOUT_S: Final = 5.0

_WEBSOCKET_SCHEMES: Final = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}
_HTTP_SCHEMES: Final = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
_KEY: Final = re.compile(r"[!-~]{1,512}")  # the characters that are safe in a header
_URL_HINT: Final = "use a URL such as http://127.0.0.1:8000"

# A machine that vanishes does not close its connections. Only an unanswered ping reveals the loss.
_PING_INTERVAL_S: Final = 5.0
_PING_TIMEOUT_S: Final = 10.0
_CLOSE_TIMEOUT_S: Final = 1.0

# The error for a close code if no message explained it. Other codes mean a lost connection. A request that was wrong
# would be refused again, so its codes do not.
_CLOSE_CODE_ERRORS: Final[Mapping[int, type[LanestreamError]]] = {
    1002: ProtocolError,
    1003: ProtocolError,
    1007: ProtocolError,
    1008: ProtocolError,
    4001: EvictedError,
    4002: IdleError,
    4003: TooOldError,
}
_MESSAGE_TOO_BIG: Final = 1009
_REQUEST_ID_HEADER: Final = "X-Request-ID"
_MOST_ID_CHARACTERS: Final = 128

Transport = TypeVar("Transport", httpx.BaseTransport, httpx.AsyncBaseTransport)


@dataclass(frozen=True)
class Endpoint:
    """The address of one replica: `base` for people, `http` for requests, `stream` for WebSockets.

    `headers` are sent with each request and each handshake. Both go through `proxy`, unless it is None, and use `tls`
    for https, or the defaults. Neither `base` nor the representation holds a secret.
    """

    base: str
    http: str = field(repr=False)
    stream: str = field(repr=False)
    headers: Mapping[str, str] = field(repr=False)
    proxy: Proxy | None = None
    tls: SSLContext | None = None

    @classmethod
    def parse(cls, url: str, api_key: str | None = None, tls: SSLContext | None = None) -> Endpoint:
        """Parses an http, https, ws or wss URL, with or without a path before `/v1`.

        Raises SettingsError if the URL, the key or the environment's proxy for the URL is not valid, or if there is a
        `tls` for a URL without TLS, and MissingExtraError if that proxy needs packages that are missing.
        """
        invalid = SettingsError(f"{redact_url(url)!r} is not a valid service URL", _URL_HINT)
        try:
            parts = urlsplit(url if "://" in url else f"http://{url}")
            valid = parts.scheme in _HTTP_SCHEMES and bool(parts.hostname) and parts.port != 0
        except ValueError:
            raise invalid from None
        if not valid:
            raise invalid
        address = parts.netloc + parts.path.removesuffix("/v1/stream").rstrip("/")
        http = f"{_HTTP_SCHEMES[parts.scheme]}://{address}"
        if tls is not None and not http.startswith("https:"):
            raise SettingsError(f"{redact_url(url)!r} does not use TLS, but a certificate is given", "use https://")
        return cls(
            base=redact_url(url),
            http=http,
            stream=f"{_WEBSOCKET_SCHEMES[parts.scheme]}://{address}/v1/stream",
            headers=_headers(api_key),
            proxy=find_proxy(http),
            tls=tls,
        )

    @property
    def without_proxy(self) -> str:
        """What to do if the proxy is to blame."""
        return f"check the proxy, or add {urlsplit(self.http).hostname} to NO_PROXY to connect without it"


def parse_endpoints(
    url: str | Sequence[str], api_key: str | None = None, tls: SSLContext | None = None
) -> tuple[Endpoint, ...]:
    """Parses the URL or URLs of a service's replicas. Raises SettingsError if one is not valid or none is given."""
    urls = [url] if isinstance(url, str) else url
    if not urls:
        raise SettingsError("no service URL was given", _URL_HINT)
    return tuple(Endpoint.parse(each, api_key, tls) for each in urls)


def connect_options(endpoint: Endpoint, timeout: float) -> dict[str, Any]:
    """Returns the arguments for either of websockets' `connect` functions. `timeout` is in seconds."""
    return {
        **({} if endpoint.tls is None else {"ssl": endpoint.tls}),
        "uri": endpoint.stream,
        "subprotocols": [Subprotocol(SUBPROTOCOL)],
        "proxy": None if endpoint.proxy is None else endpoint.proxy.url,
        "compression": None,
        "additional_headers": endpoint.headers,
        "open_timeout": timeout,
        "ping_interval": _PING_INTERVAL_S,
        "ping_timeout": _PING_TIMEOUT_S,
        "close_timeout": _CLOSE_TIMEOUT_S,
        # The frames in flight bound the queue. If it could fill up, a slow caller would hold up pongs and look dead.
        "max_queue": None,
        "logger": _logger_without_debug(),
    }


def http_options(endpoints: Sequence[Endpoint], transport: Callable[..., Transport]) -> dict[str, Any]:
    """Returns the arguments for either of httpx's clients that decide how to connect; `transport` is the class."""
    # With a transport of its own, a client does not read the variables for proxies.
    tls = endpoints[0].tls
    verify: dict[str, Any] = {} if tls is None else {"verify": tls}
    proxied = {endpoint.http: transport(proxy=endpoint.proxy.url, **verify) for endpoint in endpoints if endpoint.proxy}
    return {"transport": transport(**verify), "mounts": proxied}


@contextmanager
def websocket_errors(endpoint: Endpoint) -> Iterator[None]:
    """Converts websockets' exceptions in the block to LanestreamErrors."""
    try:
        yield
    except ConnectionClosed as error:
        raise closed_error(error) from None
    except InvalidStatus as error:
        raise refusal_error(error.response.status_code, error.response.body or b"", endpoint) from None
    except (OSError, WebSocketException) as error:
        raise _unreachable_error(endpoint, error) from None


@contextmanager
def handshake_errors(endpoint: Endpoint) -> Iterator[None]:
    """Converts the exception in the block for a connection that ends during the handshake to a LanestreamError."""
    try:
        yield
    except ConnectionClosed as error:
        raise _unreachable_error(endpoint, error.__cause__ or ConnectionError("the connection was closed")) from None


@contextmanager
def stream_errors(response: Response | None) -> Iterator[None]:
    """Adds the request id in the response to a handshake to the errors of its stream in the block."""
    try:
        yield
    except (ConnectionClosed, LanestreamError) as raised:
        error = closed_error(raised) if isinstance(raised, ConnectionClosed) else raised
        error.request_id = _shown_id(None if response is None else response.headers.get(_REQUEST_ID_HEADER))
        raise error from None


@contextmanager
def http_errors(endpoint: Endpoint) -> Iterator[None]:
    """Converts httpx's exceptions in the block to ConnectionFailedErrors."""
    try:
        yield
    except httpx.HTTPError as error:
        raise _unreachable_error(endpoint, error) from None


def closed_error(closed: ConnectionClosed) -> LanestreamError:
    """Returns the error for a stream whose connection ended before its summary arrived."""
    close = closed.rcvd
    if close is None:
        return ConnectionFailedError("the connection to the service broke")
    if close.code == _MESSAGE_TOO_BIG:
        return ImageTooLargeError("a frame had more bytes than the service accepts")
    reason = f": {close.reason}" if close.reason else ""
    kind = _CLOSE_CODE_ERRORS.get(close.code, ConnectionFailedError)
    return kind(f"the service closed the stream with code {close.code}{reason}")


def refusal_error(status: int, body: bytes | bytearray, endpoint: Endpoint) -> LanestreamError:
    """Returns the error in an unsuccessful response, or a ConnectionFailedError if it is not from Lanestream."""
    try:
        problem: dict[str, Any] = json.loads(body)
        error = error_from_code(str(problem["code"]), str(problem["message"]), str(problem["hint"]))
        error.request_id = _shown_id(problem.get("request_id"))
        return error
    except (ValueError, TypeError, KeyError):
        answer = f"{endpoint.base} answered {status} {responses.get(status, '')}".rstrip()
    if endpoint.proxy is not None:
        return ConnectionFailedError(f"{answer} through {endpoint.proxy}", endpoint.without_proxy)
    return ConnectionFailedError(answer, "check that a Lanestream service runs at this URL")


def _unreachable_error(endpoint: Endpoint, error: BaseException) -> ConnectionFailedError:
    timed_out = isinstance(error, TimeoutError | httpx.TimeoutException)
    reason = "the connection timed out" if timed_out else redact_urls(re.sub(r"^\[Errno -?\d+\] ", "", str(error)))
    reason = one_line(reason) or type(error).__name__
    failure = f"can't reach the service at {endpoint.base}"
    hint = tls_hint(error)
    if hint is not None:
        return ConnectionFailedError(f"{failure}: {reason}", hint)
    if endpoint.proxy is not None:
        return ConnectionFailedError(f"{failure} through {endpoint.proxy}: {reason}", endpoint.without_proxy)
    if endpoint.http.startswith("https:") and not timed_out:
        # With TLS 1.3 a server that misses the certificate of its client may just close the connection.
        hint = "check that a service runs there, and whether it asks for a certificate (--client-certificate)"
        return ConnectionFailedError(f"{failure}: {reason}", hint)
    return ConnectionFailedError(f"{failure}: {reason}", "start one with `lanestream serve`")


def _shown_id(request_id: object) -> str | None:
    """Returns a request id from the service or a proxy for a message; None if there is none."""
    return one_line(request_id, _MOST_ID_CHARACTERS) if isinstance(request_id, str) and request_id else None


def _headers(api_key: str | None) -> dict[str, str]:
    if api_key is None:
        return {}
    if not _KEY.fullmatch(api_key):
        raise SettingsError(
            "the API key can't be sent", "a key is 1 to 512 ASCII characters without spaces; check for a stray space"
        )
    return {"Authorization": f"Bearer {api_key}"}


def _logger_without_debug() -> logging.Logger:
    """Returns a logger without debug messages: websockets would log headers, and so API keys, and resume tokens."""
    logger = logging.getLogger("lanestream_client.websockets")
    logger.setLevel(logging.INFO)
    return logger
