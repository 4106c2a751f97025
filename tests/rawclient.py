"""Clients that speak to the service byte by byte, to send what no library would."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

import fakes

UPGRADE = (
    b"GET /v1/stream HTTP/1.1\r\nHost: x\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)
TEXT, BINARY, PING, CONTINUATION = 1, 2, 9, 0


@contextmanager
def connect(url: str, *, read_buffer: int | None = None, source: str = "127.0.0.1") -> Iterator[socket.socket]:
    """Opens a TCP connection; with `read_buffer` the system keeps hardly anything that is not read."""
    with socket.socket() as connection:
        if read_buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, read_buffer)
        connection.bind((source, 0))
        connection.settimeout(fakes.WAIT_S)
        connection.connect((urlsplit(url).hostname, urlsplit(url).port))
        yield connection


def read_all(connection: socket.socket) -> bytes:
    """Reads until the service closes the connection, however it does that."""
    data = b""
    with suppress(ConnectionError):
        while part := connection.recv(1 << 16):
            data += part
    return data


def is_closed(connection: socket.socket) -> bool:
    """Waits until the service has closed the connection."""
    read_all(connection)
    return True


def send_until_closed(connection: socket.socket, data: bytes, limit: int = 1 << 24) -> None:
    """Sends `data` again and again until the service closes the connection. Fails if it has not after `limit` bytes."""
    sent = 0
    with suppress(ConnectionError):
        while sent < limit:
            sent += connection.send(data)
        raise AssertionError(f"the service has read {sent:,} bytes")


def frame(opcode: int, payload: bytes = b"", *, final: bool = True) -> bytes:
    """A masked WebSocket frame, with a mask of zeros."""
    length = len(payload)
    if length < 126:
        size = bytes([length])
    else:
        size = b"\x7e" + struct.pack(">H", length) if length < 1 << 16 else b"\x7f" + struct.pack(">Q", length)
    return bytes([opcode | (0x80 if final else 0), size[0] | 0x80]) + size[1:] + bytes(4) + payload


def open_stream(connection: socket.socket, key: str | None = None) -> None:
    """Completes the handshake of a WebSocket."""
    authorization = b"" if key is None else f"Authorization: Bearer {key}\r\n".encode()
    connection.sendall(UPGRADE + authorization + b"\r\n")
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        head += connection.recv(1)
    assert head.startswith(b"HTTP/1.1 101 ")
