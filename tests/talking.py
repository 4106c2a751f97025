"""Raw WebSocket helpers for tests that send and receive single stream messages."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import fakes
import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lanestream.protocol import parse_server_message


@contextmanager
def stream(url: str, **start: Any) -> Iterator[ClientConnection]:
    """Connects a stream. Opens it with a `start` message if there are arguments for one."""
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        if start:
            tell(socket, "start", **start)
            assert heard(socket)["type"] == "ready"
        yield socket


def tell(socket: ClientConnection, kind: str, **fields: Any) -> None:
    """Sends a message of type `kind`."""
    socket.send(json.dumps({"type": kind, **fields}))


def heard(socket: ClientConnection) -> dict[str, Any]:
    """Returns the next message, after checking it against the protocol."""
    text = socket.recv(fakes.WAIT_S)
    assert isinstance(text, str)
    parse_server_message(text)
    message: dict[str, Any] = json.loads(text)
    return message


def closed(socket: ClientConnection) -> tuple[int, str]:
    """Returns the code and the reason with which the service closes. Fails if a message comes before."""
    with pytest.raises(ConnectionClosed) as caught:
        socket.recv(fakes.WAIT_S)
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code, caught.value.rcvd.reason


def all_was_read(socket: ClientConnection) -> None:
    """Waits until the service has read all earlier messages: it answers text immediately and in order."""
    socket.send("?")
    assert heard(socket)["code"] == "bad_message"


def all_released(url: str, **headers: str) -> None:
    """Waits until no stream has a session: the service releases one only after its client has gone."""
    deadline = time.monotonic() + fakes.WAIT_S
    while "lane_sessions_active 0.0" not in httpx.get(f"{url}/metrics", headers=headers).text:
        assert time.monotonic() < deadline
        time.sleep(0.005)
