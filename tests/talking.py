"""Talking to a stream by hand, message by message."""

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
    """A stream that was opened with `start`, or not at all."""
    with connect(f"{url.replace('http', 'ws')}/v1/stream", compression=None) as socket:
        if start:
            tell(socket, "start", **start)
            assert heard(socket)["type"] == "ready"
        yield socket


def tell(socket: ClientConnection, kind: str, **more: Any) -> None:
    """Sends a message of a kind."""
    socket.send(json.dumps({"type": kind, **more}))


def heard(socket: ClientConnection) -> dict[str, Any]:
    """The next message, which is one of the protocol."""
    text = socket.recv(fakes.WAIT_S)
    assert isinstance(text, str)
    parse_server_message(text)
    message: dict[str, Any] = json.loads(text)
    return message


def closed(socket: ClientConnection) -> tuple[int, str]:
    """The code and the reason that the service closed with, and no message before."""
    with pytest.raises(ConnectionClosed) as caught:
        socket.recv(fakes.WAIT_S)
    assert caught.value.rcvd is not None
    return caught.value.rcvd.code, caught.value.rcvd.reason


def all_was_read(socket: ClientConnection) -> None:
    """Returns when the service has taken in all that was sent before: it answers text at once, and in order."""
    socket.send("?")
    assert heard(socket)["code"] == "bad_message"


def all_released(url: str, **headers: str) -> None:
    """Returns when no stream has a session any more: a service lets go of one after its client is gone."""
    ends = time.monotonic() + fakes.WAIT_S
    while "lane_sessions_active 0.0" not in httpx.get(f"{url}/metrics", headers=headers).text:
        assert time.monotonic() < ends
        time.sleep(0.005)
