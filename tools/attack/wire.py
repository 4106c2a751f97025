"""HTTP requests and WebSocket frames byte by byte, and a connection that sends whatever an attacker likes."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import socket
import struct
from contextlib import suppress
from types import TracebackType
from typing import Any, Final, Self

from attack.target import Target

TEXT: Final = 1
BINARY: Final = 2
CONTINUATION: Final = 0
CLOSE: Final = 8
PING: Final = 9
PONG: Final = 10
# Without a close frame, browsers and libraries report this code.
ABNORMAL_CLOSURE: Final = 1006

_RECEIVE_BYTES: Final = 1 << 16
_SMALL_BUFFER_BYTES: Final = 2048
_SMALL_SEGMENT_BYTES: Final = 536
_STATUS: Final = re.compile(rb"HTTP/1\.1 (\d{3}) ")
_CONTENT_LENGTH: Final = re.compile(rb"\r\ncontent-length: (\d+)\r\n", re.IGNORECASE)
# Lengths of a frame's payload that don't fit into 7 bits.
_LENGTH_16: Final = 126
_LENGTH_64: Final = 127


def head(method: str, path: str, *headers: tuple[str, str], key: str | None = None) -> bytes:
    """Returns the head of a request without the empty line at its end."""
    lines = [f"{method} {path} HTTP/1.1", "Host: 127.0.0.1"]
    if key is not None:
        lines.append(f"Authorization: Bearer {key}")
    lines += [f"{name}: {value}" for name, value in headers]
    return "".join(f"{line}\r\n" for line in lines).encode()


def request(method: str, path: str, *headers: tuple[str, str], key: str | None = None, body: bytes = b"") -> bytes:
    """Returns a complete request."""
    length = (("Content-Length", str(len(body))),) if body else ()
    return head(method, path, *headers, *length, key=key) + b"\r\n" + body


def upgrade(*headers: tuple[str, str], key: str | None = None) -> bytes:
    """Returns the head of the handshake of a stream without the empty line at its end."""
    nonce = base64.b64encode(os.urandom(16)).decode()
    usual = (
        ("Upgrade", "websocket"),
        ("Connection", "Upgrade"),
        ("Sec-WebSocket-Version", "13"),
        ("Sec-WebSocket-Key", nonce),
        ("Sec-WebSocket-Protocol", "lanestream.v1"),
    )
    return head("GET", "/v1/stream", *usual, *headers, key=key)


def status(answer: bytes) -> int | None:
    """Returns the status of a response, None if it is not one."""
    match = _STATUS.match(answer)
    return None if match is None else int(match[1])


def frame_head(opcode: int, size: int, *, final: bool = True, reserved: int = 0) -> bytes:
    """Returns what a client sends before a payload of `size` bytes. `reserved` are the three reserved bits.

    The mask is zero, which leaves the payload as it is.
    """
    first = (0x80 if final else 0) | reserved << 4 | opcode
    if size < _LENGTH_16:
        length = struct.pack(">B", 0x80 | size)
    elif size < 1 << 16:
        length = struct.pack(">BH", 0x80 | _LENGTH_16, size)
    else:
        length = struct.pack(">BQ", 0x80 | _LENGTH_64, size)
    return bytes([first]) + length + bytes(4)


def frame(opcode: int, payload: bytes = b"", *, final: bool = True, reserved: int = 0) -> bytes:
    """Returns a WebSocket frame as a client sends it."""
    return frame_head(opcode, len(payload), final=final, reserved=reserved) + payload


class Connection:
    """A TCP connection to a service. Every method may raise ConnectionError if the service resets it."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._buffer = bytearray()

    @classmethod
    async def open(cls, target: Target, *, source: str | None = None, reads_slowly: bool = False) -> Self:
        """Connects, from the address `source` if given.

        With `reads_slowly` it has small buffers, so that little can be sent to it before it reads.
        """
        sock = socket.socket()
        try:
            sock.setblocking(False)
            if reads_slowly:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SMALL_BUFFER_BYTES)
                # The size of the sender's buffer depends on it.
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, _SMALL_SEGMENT_BYTES)
            if source is not None:
                sock.bind((source, 0))
            await asyncio.get_running_loop().sock_connect(sock, (target.host, target.port))
        except BaseException:
            sock.close()
            raise
        return cls(sock)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection."""
        self._socket.close()

    async def send(self, data: bytes | bytearray | memoryview) -> None:
        """Sends all of `data`, for however long the service takes to read it."""
        await asyncio.get_running_loop().sock_sendall(self._socket, data)

    async def receive(self) -> bytes:
        """Returns some bytes that the service sent; none if it has closed the connection."""
        if self._buffer:
            data = bytes(self._buffer)
            self._buffer.clear()
            return data
        try:
            return await asyncio.get_running_loop().sock_recv(self._socket, _RECEIVE_BYTES)
        except ConnectionError:
            return b""

    async def discard(self) -> None:
        """Reads until the service closes the connection."""
        while await self.receive():
            pass

    async def closed_within(self, seconds: float) -> bool:
        """Reads until the service closes the connection, at most so long, and returns whether it has."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self.discard()
                return True
        return False

    async def response(self) -> tuple[int, bytes]:
        """Returns the status and the body of the next response. Raises ConnectionError if it is not complete."""
        head = await self._read_until(b"\r\n\r\n")
        number, length = status(head), _CONTENT_LENGTH.search(head)
        if number is None:
            raise ConnectionError(f"not a response: {head[:80]!r}")
        return number, await self._read(int(length[1]) if length else 0)

    async def _read_until(self, end: bytes) -> bytes:
        while (at := self._buffer.find(end)) < 0:
            await self._read_more()
        return self._take(at + len(end))

    async def _read(self, size: int) -> bytes:
        while len(self._buffer) < size:
            await self._read_more()
        return self._take(size)

    async def _read_more(self) -> None:
        data = await asyncio.get_running_loop().sock_recv(self._socket, _RECEIVE_BYTES)
        if not data:
            raise ConnectionResetError("the service closed the connection")
        self._buffer += data

    def _take(self, size: int) -> bytes:
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        return data


class Stream(Connection):
    """A WebSocket to /v1/stream."""

    @classmethod
    async def open(cls, target: Target, *, source: str | None = None, reads_slowly: bool = False) -> Self:
        """Connects with the attacker's key. Raises ConnectionError if the handshake is refused."""
        stream = await super().open(target, source=source, reads_slowly=reads_slowly)
        try:
            await stream.send(upgrade(key=target.attacker_key) + b"\r\n")
            response = await stream._read_until(b"\r\n\r\n")
            if b" 101 " not in response[:16]:
                raise ConnectionError(f"the handshake was refused: {response[:80]!r}")
        except BaseException:
            stream.close()
            raise
        return stream

    async def start(self, **fields: object) -> dict[str, Any]:
        """Sends `start` and returns `ready`. Raises ConnectionRefusedError if an error comes instead."""
        await self.send_json("start", **fields)
        message = await self.receive_json()
        if message["type"] != "ready":
            raise ConnectionRefusedError(message["code"])
        return message

    async def receive_answer(self) -> dict[str, Any]:
        """Returns the next answer to a frame: its lanes or an error."""
        while True:
            message = await self.receive_json()
            if message.get("seq") is not None:
                return message

    async def send_json(self, kind: str, **fields: object) -> None:
        """Sends a message of a type."""
        await self.send(frame(TEXT, json.dumps({"type": kind, **fields}).encode()))

    async def receive_json(self) -> dict[str, Any]:
        """Returns the next message. Raises ConnectionError if the service closes the stream instead.

        The error's text is then the close code.
        """
        while True:
            opcode, payload = await self.receive_frame()
            if opcode == TEXT:
                message: dict[str, Any] = json.loads(payload)
                return message
            if opcode == CLOSE:
                raise ConnectionResetError(str(struct.unpack(">H", payload[:2])[0] if payload else ABNORMAL_CLOSURE))

    async def receive_frame(self) -> tuple[int, bytes]:
        """Returns the opcode and the payload of the next frame."""
        first, second = await self._read(2)
        size = second & 0x7F
        if size == _LENGTH_16:
            (size,) = struct.unpack(">H", await self._read(2))
        elif size == _LENGTH_64:
            (size,) = struct.unpack(">Q", await self._read(8))
        return first & 0xF, await self._read(size)

    async def close_code(self) -> int:
        """Reads until the service closes the stream, and returns its close code, 1006 without one."""
        with suppress(ConnectionError):
            while True:
                opcode, payload = await self.receive_frame()
                if opcode == CLOSE and payload:
                    return int(struct.unpack(">H", payload[:2])[0])
        return ABNORMAL_CLOSURE
