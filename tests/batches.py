"""Batches in tests: small clips, engines that other processes can load, and runs of the command."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import av
import fakes
import numpy as np

from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.engine import SHIPPED_REGRESSOR
from lanestream.local import LocalEngine
from lanestream.road.view import Image
from lanestream_client.batch.command import batch

# The options of the smallest real engine.
REGRESSION: Final = ("--model", str(SHIPPED_REGRESSOR), "--regressor", "none", "--provider", "cpu")


class FakeEngines:
    """Loads fake engines. Other processes can import it."""

    def __call__(self, model: object, provider: object, regressor: object, threads: int | None = None) -> LocalEngine:
        assert threads == 1
        return LocalEngine(fakes.engine())

    def most_processes(self) -> int:
        return 2


class FatalDetector(fakes.FakeDetector):
    """Ends its process at a white frame, fails at a black one, and takes its time at any other."""

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        if image.min() > 240:
            os.kill(os.getpid(), signal.SIGKILL)
        if image.max() < 16:
            raise RuntimeError("the detector\nfailed")
        time.sleep(0.01)
        return super().detect(image, context, infer)


class FatalEngines(FakeEngines):
    """Loads engines with a FatalDetector."""

    def __call__(self, *_: object) -> LocalEngine:
        return LocalEngine(fakes.engine(detector=FatalDetector()))


class BrokenEngines(FakeEngines):
    """Loads no engine: its process ends."""

    def __call__(self, *_: object) -> LocalEngine:
        os._exit(7)


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file can get larger than this, here and in processes that are started in the block."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def run(*arguments: object, engines: FakeEngines | None = None) -> int:
    """Runs `lanestream batch` in this process, with workers in others, and returns its exit code."""
    code = batch.main([str(each) for each in arguments], obj=engines or FakeEngines(), standalone_mode=False)
    assert isinstance(code, int | None)
    return code or 0


def write_clip(path: Path, frames: int = 3, shade: int | None = None, created: str | None = None) -> Path:
    """Writes a video, 320 x 180 with 25 frames per second, of a gray ramp or of one `shade`."""
    with av.open(str(path), "w") as container:
        if created is not None:
            container.metadata["creation_time"] = created
        stream = container.add_stream("mpeg4", rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = 320, 180, "yuv420p"
        for number in range(frames):
            image = (
                np.roll(fakes.picture(), 8 * number, axis=1) if shade is None else np.full_like(fakes.picture(), shade)
            )
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    return path


class Batch:
    """A batch in a process group of its own, with the smallest real engine."""

    def __init__(self, *arguments: object) -> None:
        command = [sys.executable, "-m", "lanestream.cli", "batch", *REGRESSION, *map(str, arguments)]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )

    def wait_for_files(self, out: Path, number: int) -> None:
        """Waits until this many units are published, or it has ended."""
        while self.process.poll() is None and len(list(out.glob("frames/*.jsonl"))) < number:
            time.sleep(0.005)

    def finish(self) -> tuple[int, str, str]:
        """Waits until it has ended, and returns its exit code, output and errors."""
        output, errors = self.process.communicate(timeout=120)
        assert "Traceback" not in errors, errors
        return self.process.returncode, output, errors


def rows(out: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """Returns the lines of all result files by file and frame, without their timing. Each frame is there once."""
    found: dict[tuple[str, int], dict[str, Any]] = {}
    for path in sorted((out / "frames").iterdir()):
        for line in path.read_text().splitlines():
            row = json.loads(line)
            del row["timing_ms"]
            key = row["file"], row["seq"]
            assert key not in found, f"{key} is in the results twice"
            found[key] = row
    return found
