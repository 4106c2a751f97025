"""Real cameras, in a process of their own: streams of the Python client that send encoded frames.

python -m capacity.cameras reads one request as JSON from its standard input, and writes the lives of the frames as JSON
to its standard output.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from bench.frames import forward_and_backward

from capacity.load import JITTER, FrameLife, Load
from lanestream.errors import LanestreamError
from lanestream_client import AsyncLaneClient, SourceFrame

# From the start of the process to the first frame: every stream is open by then.
_OPENING_S: Final = 1.0
_OPENING_EACH_S: Final = 0.02


@dataclass(frozen=True)
class CameraRequest:
    """What the process is asked to do: to send the JPEG files in the folder `frames` for `seconds`.

    `urls` has, for each camera, its nodes: the one that it connects to first, and those that it may change to.
    """

    load: Load
    urls: Sequence[Sequence[str]]
    seconds: float
    seed: int
    frames: Path


@dataclass
class CameraReport:
    """When the first frames were due (monotonic seconds), and the lives of all frames."""

    began: float = 0.0
    frames: list[FrameLife] = field(default_factory=list)


class CameraProcess:
    """The process, as its parent sees it."""

    def __init__(self, request: CameraRequest) -> None:
        content = {**asdict(request), "frames": str(request.frames.resolve())}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "capacity.cameras"],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdin is not None  # noqa: S101 - asked for
        self._process.stdin.write(json.dumps(content) + "\n")
        self._process.stdin.flush()

    def report(self) -> CameraReport:
        """Waits until all frames were sent. Raises RuntimeError if the process failed."""
        output, _ = self._process.communicate()
        if self._process.returncode:
            raise RuntimeError("the process with the cameras failed, see above")
        content = json.loads(output)
        return CameraReport(content["began"], [FrameLife(*frame) for frame in content["frames"]])

    def kill(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.wait()


class Cameras:
    """The cameras of one request."""

    def __init__(self, request: CameraRequest) -> None:
        self._request = request
        self._images = [path.read_bytes() for path in sorted(request.frames.glob("*.jpg"))]
        self.report = CameraReport()

    async def run(self) -> CameraReport:
        """Runs all streams to their ends."""
        count = len(self._request.urls)
        self.report.began = time.monotonic() + _OPENING_S + count * _OPENING_EACH_S
        await asyncio.gather(*(self._stream(camera) for camera in range(count)))
        return self.report

    async def _stream(self, camera: int) -> None:
        lives: dict[int, int] = {}
        load = self._request.load
        async with AsyncLaneClient(self._request.urls[camera], in_flight=load.in_flight) as client:
            async for result in client.stream(self._source(camera, lives), mode=load.mode):
                if result.lanes is not None:
                    index = lives[result.frame.seq]
                    life = self.report.frames[index]
                    self.report.frames[index] = FrameLife(camera, life.captured, time.monotonic())

    async def _source(self, camera: int, lives: dict[int, int]) -> AsyncIterator[SourceFrame]:
        load, chance = self._request.load, random.Random(f"{self._request.seed}-{camera}")  # noqa: S311
        first = self.report.began + load.phase_s(camera)
        end = self.report.began + self._request.seconds
        await asyncio.sleep(max(0.0, first - time.monotonic()))
        number = 0
        for seq in range(sys.maxsize):
            if load.fps is not None:
                # A camera does not wait: what could not be sent in time was never captured.
                number = max(number, int((time.monotonic() - first) * load.fps))
                due = first + (number + JITTER * (chance.random() - 0.5) * 2.0) / load.fps
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                number += 1
            now = time.monotonic()
            if now >= end:
                return
            lives[seq] = len(self.report.frames)
            self.report.frames.append(FrameLife(camera, now, None))
            image = self._images[forward_and_backward(7 * camera + seq, len(self._images))]
            yield SourceFrame(seq, now, image)


def main() -> None:
    """Runs the request on standard input."""
    # Its parent ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    content = json.loads(sys.stdin.readline())
    request = CameraRequest(**{**content, "load": Load(**content["load"]), "frames": Path(content["frames"])})
    try:
        report = asyncio.run(Cameras(request).run())
    except LanestreamError as error:
        sys.exit(f"error: {error}")
    frames = [(life.camera, life.captured, life.answered) for life in report.frames]
    json.dump({"began": report.began, "frames": frames}, sys.stdout)


if __name__ == "__main__":
    main()
