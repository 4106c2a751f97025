"""The opening of a socket and its failures, shared by the client that blocks and the one that awaits."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from lanestream.errors import (
    ConnectionFailedError,
    EvictedError,
    IdleError,
    ImageTooLargeError,
    LanestreamError,
    ProtocolError,
    TooOldError,
)
from lanestream.protocol import SUBPROTOCOL
from lanestream_client import requests
from lanestream_client.endpoint import Endpoint

# How long `ready` may take after a quick handshake: the session is fetched then, or freed by another socket.
READY_S: Final = 5.0

# A machine that vanishes does not close its connections: only a ping that stays unanswered tells.
_PING_S: Final = 5.0
_PONG_S: Final = 10.0
_CLOSE_S: Final = 1.0

# By close codes, where no message told more. Those of a bad request would come again, so they don't count as a loss.
_CLOSED: Final[dict[int, type[LanestreamError]]] = {
    1002: ProtocolError,
    1003: ProtocolError,
    1007: ProtocolError,
    1008: ProtocolError,
    4001: EvictedError,
    4002: IdleError,
    4003: TooOldError,
}
_TOO_BIG: Final = 1009


def options(endpoint: Endpoint, timeout: float) -> dict[str, Any]:
    """The arguments of websockets' two `connect` functions; `timeout` in seconds."""
    return {
        "uri": endpoint.stream,
        "subprotocols": [Subprotocol(SUBPROTOCOL)],
        "compression": None,
        "additional_headers": endpoint.headers,
        "open_timeout": timeout,
        "ping_interval": _PING_S,
        "ping_timeout": _PONG_S,
        "close_timeout": _CLOSE_S,
        # No more comes than was asked for, and a full queue would hold up pongs: a caller that dawdles is no loss.
        "max_queue": None,
        "logger": _discreet_logger(),
    }


@contextmanager
def telling(endpoint: Endpoint) -> Iterator[None]:
    """Admission the failures of a socket in the block into the errors that a user can read."""
    try:
        yield
    except ConnectionClosed as error:
        raise lost(error) from None
    except InvalidStatus as error:
        raise requests.refused(error.response.status_code, error.response.body or b"", endpoint.base) from None
    except (OSError, WebSocketException) as error:
        raise requests.unreachable(endpoint.base, error) from None


def lost(closed: ConnectionClosed) -> LanestreamError:
    """The error for a stream whose connection ended before its summary came."""
    close = closed.rcvd
    if close is None:
        return ConnectionFailedError("the connection to the service broke")
    if close.code == _TOO_BIG:
        return ImageTooLargeError("a frame had more bytes than the service accepts")
    reason = f": {close.reason}" if close.reason else ""
    kind = _CLOSED.get(close.code, ConnectionFailedError)
    return kind(f"the service closed the stream with code {close.code}{reason}")


def _discreet_logger() -> logging.Logger:
    """One without debug messages: in these websockets writes the headers, and so the key, and the tokens."""
    logger = logging.getLogger("lanestream_client.websockets")
    logger.setLevel(logging.INFO)
    return logger
