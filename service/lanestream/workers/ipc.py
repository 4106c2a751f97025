"""Messages between a service and its worker processes: pickled Python objects with a length prefix.

Both ends are the same program on the same machine, connected by a socket that no other process can reach. Data from
clients is never unpickled.
"""

from __future__ import annotations

import asyncio
import pickle
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from lanestream.engine import Engine
    from lanestream.images.decoding import ImageLimits
    from lanestream.inference.batcher import BatchReport
    from lanestream.messages import ProcessedFrame
    from lanestream.session import SessionOptions, SessionState
    from lanestream.workers.frame_worker import EncodedFrame

    FrameOutcome = tuple[ProcessedFrame, SessionState] | Exception

_LENGTH: Final = struct.Struct("<Q")


@dataclass(frozen=True)
class WorkerSetup:
    """The first message to a worker: `load` returns its warm engine, `log` is the configuration of its logging."""

    load: Callable[[], Engine]
    limits: ImageLimits
    opencv_threads: int
    log: dict[str, Any]


@dataclass(frozen=True)
class FrameJob:
    """A frame, and the state and options of the session it belongs to."""

    frame: EncodedFrame
    state: SessionState
    options: SessionOptions


@dataclass(frozen=True)
class FrameDone:
    """The outcome of a job: lanes and the session's new state, or an error; and reports of recent batches.

    `number` says which of the worker's jobs it was, from 0 in the order in which they were sent. `cpu_s` is the
    processor time that it took (seconds).
    """

    number: int
    outcome: FrameOutcome
    cpu_s: float
    batches: tuple[BatchReport, ...] = ()


def encode_message(value: object) -> bytes:
    """Returns `value` as bytes to send."""
    body = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


async def read_message(reader: asyncio.StreamReader) -> Any:
    """Returns the next message. Raises EOFError at the end, and ConnectionError if the other process is gone."""
    (length,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
    return decode_message(await reader.readexactly(length))


def receive_message(channel: socket.socket) -> Any:
    """Returns the next message, blocking. Raises EOFError at the end."""
    return decode_message(receive_bytes(channel))


def receive_bytes(channel: socket.socket) -> bytearray:
    """Returns the next message before it is decoded, blocking. Raises EOFError at the end."""
    (length,) = _LENGTH.unpack(_receive_exactly(channel, _LENGTH.size))
    return _receive_exactly(channel, length)


def decode_message(body: bytes | bytearray) -> Any:
    """Returns the object in a message."""
    return pickle.loads(body)  # noqa: S301 - from our own process


def _receive_exactly(channel: socket.socket, length: int) -> bytearray:
    data = bytearray(length)
    left = memoryview(data)
    while len(left):
        count = channel.recv_into(left)
        if not count:
            raise EOFError
        left = left[count:]
    return data
