"""A minimal client of the stream, message by message."""

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
    """Opens a stream; sends `start` if any of its fields are given."""
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        if start:
            send_message(socket, "start", **start)
            assert receive(socket)["type"] == "ready"
        yield socket


def send_message(socket: ClientConnection, kind: str, **fields: Any) -> None:
    """Sends a text message of a type."""
    socket.send(json.dumps({"type": kind, **fields}))


def receive(socket: ClientConnection) -> dict[str, Any]:
    """Returns the next message, which must be a valid one."""
    text = socket.recv(fakes.WAIT_S)
    assert isinstance(text, str)
    parse_server_message(text)
    message: dict[str, Any] = json.loads(text)
    return message


def receive_close(socket: ClientConnection) -> tuple[int, str]:
    """Returns the code and reason with which the service closes. Fails if a message comes first."""
    with pytest.raises(ConnectionClosed) as caught:
        socket.recv(fakes.WAIT_S)
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code, caught.value.rcvd.reason


def wait_until_read(socket: ClientConnection) -> None:
    """Returns when the service has read all earlier messages, which it does in order."""
    socket.send("?")
    assert receive(socket)["code"] == "bad_message"


def wait_until_released(url: str, **headers: str) -> None:
    """Returns when no stream has a session any more; a session is released after its client disconnects."""
    deadline = time.monotonic() + fakes.WAIT_S
    while "lane_sessions_active 0.0" not in httpx.get(f"{url}/metrics", headers=headers).text:
        assert time.monotonic() < deadline
        time.sleep(0.005)
