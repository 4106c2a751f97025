"""What a service and its worker processes send each other: Python's own values, each with its length before it.

Both ends are the same program on the same machine, joined by a socket that nobody else can reach; nothing that comes
from outside is ever read as such a value.
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
    from lanestream.protocol import DetectorName
    from lanestream.session import SessionState
    from lanestream.workers.frame_worker import EncodedFrame

    Outcome = tuple[ProcessedFrame, SessionState] | Exception

_LENGTH: Final = struct.Struct("<Q")


@dataclass(frozen=True)
class Setup:
    """What a worker process begins with: `load` returns its warm engine, `log` says how it logs."""

    load: Callable[[], Engine]
    limits: ImageLimits
    opencv_threads: int
    log: dict[str, Any]


@dataclass(frozen=True)
class Job:
    """A frame with all that is known of its camera; the other fields are those of `WorkerPool.open_camera`."""

    number: int
    frame: EncodedFrame
    state: SessionState
    horizon: float | None
    detector: DetectorName | None
    crowded: bool


@dataclass(frozen=True)
class Done:
    """What a job came to: lanes and the camera's new state, or an error; and the batches that ran meanwhile."""

    number: int
    outcome: Outcome
    batches: tuple[BatchReport, ...] = ()


def packed(value: object) -> bytes:
    """`value` as it is sent."""
    body = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


async def received(reader: asyncio.StreamReader) -> Any:
    """The next value. Raises EOFError after the last one, and ConnectionError where the other end has gone."""
    (length,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
    return pickle.loads(await reader.readexactly(length))  # noqa: S301 - of our own process


def receive(channel: socket.socket) -> Any:
    """The next value, waited for. Raises EOFError after the last one."""
    (length,) = _LENGTH.unpack(_exactly(channel, _LENGTH.size))
    return pickle.loads(_exactly(channel, length))  # noqa: S301 - of our own process


def _exactly(channel: socket.socket, length: int) -> bytearray:
    data = bytearray(length)
    left = memoryview(data)
    while len(left):
        count = channel.recv_into(left)
        if not count:
            raise EOFError
        left = left[count:]
    return data
