"""Service times: what one frame costs a node that has nothing else to do. Everything else is predicted from them."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Final

from bench.frames import forward_and_backward
from websockets.asyncio.client import connect

from capacity.nodes import Node
from lanestream_client import AsyncLaneClient, SourceFrame

_FPS: Final = 4.0
_IDLE_S: Final = 5.0
# The first frames search for the horizon and open the session; they are not like the others.
_SETTLING: Final = 8
# Streams that are resumed and then saved once a second, to see what that costs.
_OPENED: Final = 40
_SETTLED_S: Final = 0.5
_SAVED_S: Final = 5.0


@dataclass(frozen=True)
class ServiceTime:
    """What one frame takes, in seconds.

    `loop_s` is processor time of the service's own process, `worker_s` that of the worker, and `wait_s` the time that
    the worker waits for a device. `rest_s` is everything else from capture to answer: the network and the client.
    """

    loop_s: float
    worker_s: float
    wait_s: float
    rest_s: float


@dataclass(frozen=True)
class Calibration:
    """The service times of frames, in the order of their measurement.

    `open_s` and `save_s` are processor time of the service's own process: to resume a stream on a new socket, and to
    save a session.
    """

    frames: tuple[ServiceTime, ...]
    open_s: float
    save_s: float

    @classmethod
    def read(cls, path: Path) -> Calibration:
        """Reads a calibration. Raises ValueError if the file is not one, and OSError."""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            return cls(tuple(ServiceTime(**each) for each in content["frames"]), content["open_s"], content["save_s"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is not a calibration: {error}") from None

    @property
    def network_s(self) -> float:
        """The delay in one direction, in seconds: half of the rest, most of which is the client in fact."""
        return median(each.rest_s for each in self.frames) / 2.0

    def on_device(self, wait_s: float) -> Calibration:
        """Returns the same frames on a device: the workers wait for `wait_s` seconds instead of computing."""
        return replace(self, frames=tuple(replace(each, worker_s=0.0, wait_s=wait_s) for each in self.frames))

    def with_rest_of(self, other: Calibration) -> Calibration:
        """Returns these frames with the median rest of another calibration.

        A limit of the processor time stretches everything, so that the rest can only be measured without one.
        """
        rest_s = median(each.rest_s for each in other.frames)
        return replace(self, frames=tuple(replace(each, rest_s=rest_s) for each in self.frames))

    def write(self, path: Path) -> None:
        """Writes the calibration as JSON, rounded to microseconds."""
        rows = [{name: round(value, 6) for name, value in asdict(each).items()} for each in self.frames]
        content = {"open_s": round(self.open_s, 6), "save_s": round(self.save_s, 6), "frames": rows}
        path.write_text(json.dumps(content) + "\n", encoding="utf-8")


def calibrate(node: Node, images: Sequence[bytes], count: int, *, waits: bool) -> Calibration:
    """Measures `count` frames of one camera that sends few of them to a node without any other load.

    `waits` says that it is a `waiting_node`. Any other node only computes.
    """
    return asyncio.run(_Calibrator(node, images, count, waits).run())


async def measure_sessions(node: Node, idle: float) -> tuple[float, float]:
    """Returns the processor time of the service's own process to resume a stream, and to save a session, in seconds.

    `idle` is its processor time per second without any stream. A stream without frames is saved once a second.
    """
    async with AsyncExitStack() as sockets:
        tokens = [await _open_stream(node, sockets, {"type": "start"}) for _ in range(_OPENED)]
    await asyncio.sleep(_SETTLED_S)
    async with AsyncExitStack() as sockets:
        before = node.cpu_s()[0]
        for token in tokens:
            await _open_stream(node, sockets, {"type": "start", "resume_token": token})
        opened = node.cpu_s()[0]
        await asyncio.sleep(_SAVED_S)
        saved = node.cpu_s()[0]
    return (opened - before) / _OPENED, (saved - opened - idle * _SAVED_S) / (_OPENED * _SAVED_S)


async def _open_stream(node: Node, sockets: AsyncExitStack, start: dict[str, str]) -> str:
    """Opens a stream that is closed with the other `sockets`, and returns its resume token."""
    socket = await sockets.enter_async_context(connect(f"{node.url.replace('http', 'ws', 1)}/v1/stream"))
    await socket.send(json.dumps(start))
    return str(json.loads(await socket.recv())["resume_token"])


class _Calibrator:
    def __init__(self, node: Node, images: Sequence[bytes], count: int, waits: bool) -> None:
        self._node, self._images, self._waits = node, images, waits
        self._count = _SETTLING + count
        # The processor times before each frame, and after the last one.
        self._cpu: list[tuple[float, float]] = []
        self._captured: list[float] = []
        self._frames: list[tuple[float, float]] = []

    async def run(self) -> Calibration:
        before = self._node.cpu_s()[0]
        await asyncio.sleep(_IDLE_S)
        idle = (self._node.cpu_s()[0] - before) / _IDLE_S
        async with AsyncLaneClient(self._node.url) as client:
            async for result in client.stream(self._source(), mode="all"):
                if result.lanes is None:
                    raise RuntimeError("a frame was not answered during the calibration")
                wait_s = 1e-3 * result.lanes.timing_ms.fit if self._waits else 0.0
                self._frames.append((time.monotonic() - self._captured[result.frame.seq], wait_s))
        open_s, save_s = await measure_sessions(self._node, idle)
        frames = tuple(self._service_time(number, idle, save_s) for number in range(_SETTLING, self._count))
        return Calibration(frames, open_s, save_s)

    async def _source(self) -> AsyncIterator[SourceFrame]:
        due = time.monotonic()
        for seq in range(self._count):
            due += 1.0 / _FPS
            await asyncio.sleep(due - time.monotonic())
            self._cpu.append(self._node.cpu_s())
            self._captured.append(time.monotonic())
            yield SourceFrame(seq, self._captured[-1], self._images[forward_and_backward(seq, len(self._images))])
        await asyncio.sleep(1.0 / _FPS)
        self._cpu.append(self._node.cpu_s())

    def _service_time(self, number: int, idle: float, save_s: float) -> ServiceTime:
        (loop, worker), (next_loop, next_worker) = self._cpu[number], self._cpu[number + 1]
        response, wait_s = self._frames[number]
        # Frames are so far apart that the session is saved after each.
        loop_s = max(0.0, next_loop - loop - idle / _FPS - save_s)
        worker_s = next_worker - worker
        return ServiceTime(loop_s, worker_s, wait_s, max(0.0, response - loop_s - worker_s - wait_s))
