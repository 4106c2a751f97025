"""The systems that are measured: this code with a model file in this process, or another checkout in its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from lanestream import __version__
from lanestream.detection.interface import Detections, Detector, FrameContext, Infer
from lanestream.engine import load_engine, resolve_model, resolve_regressor
from lanestream.errors import SourceError
from lanestream.local import LocalCamera, LocalEngine
from lanestream.road.view import Image
from lanestream_exporter.evaluation.tracking import worker

CameraParameters = Mapping[str, Any] | None
# Sends a frame with its timestamp, and returns the function that waits for its `lanes` message.
Answerer = Callable[[Image, float], Callable[[], dict[str, Any]]]

# The names of systems in reports.
PRESENT: Final = "present"
AGAINST: Final = "against"

_PACKAGE_FOLDERS: Final = ("service", "client")


class System(Protocol):
    """Something that answers frames with `lanes` messages."""

    @property
    def description(self) -> dict[str, str]:
        """The version, and the checkout and the model if they are not the present ones."""
        ...

    def open(self, camera: CameraParameters, *, single_image: bool = False) -> Answerer:
        """Returns the answerer of a new stream, or of a `single_image`, which leaves the stream as it is.

        `camera` is as on the wire, None if unknown.
        """
        ...

    def close(self) -> None:
        """Frees what the system holds."""
        ...


class RecordingDetector:
    """Passes frames on to a detector and keeps its last result."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self.last: Detections | None = None

    def detect(self, image: NDArray[np.uint8], context: FrameContext, infer: Infer) -> Detections:
        """Returns the boundaries in a BGR working image (H, 640, 3) uint8."""
        self.last = self._detector.detect(image, context, infer)
        return self.last


class PresentSystem:
    """This code with a model file, by default the shipped one; `detector` has the detections of the last frame."""

    def __init__(self, model: Path | None = None) -> None:
        engine = load_engine(model, "cpu", resolve_regressor(None))
        name = engine.select()
        self.detector = RecordingDetector(engine.detectors[name])
        self._engine = LocalEngine(replace(engine, detectors={**engine.detectors, name: self.detector}))
        self.description = {"version": __version__} | ({} if model is None else {"model": str(model)})

    def open(self, camera: CameraParameters, *, single_image: bool = False) -> Answerer:
        """Returns the answerer of a new stream or a single image."""
        local = worker.open_camera(self._engine, camera, single_image)
        return lambda image, timestamp: lambda: _answer(local, image, timestamp)

    def close(self) -> None:
        """Does nothing."""


class CheckoutSystem:
    """The code in another folder of this project's source, in a process of its own with this Python."""

    def __init__(self, folder: Path, model: Path | None = None) -> None:
        folder = folder.resolve()
        if not (folder / "service" / "lanestream").is_dir():
            raise SourceError(f"{folder} has no service/lanestream", "give the folder of a checkout of this project")
        path = os.pathsep.join(str(folder / each) for each in _PACKAGE_FOLDERS)
        environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        # -P: the modules beside the worker are not the checkout's.
        self._process = subprocess.Popen(  # noqa: S603 - this Python, with a file of this package
            [sys.executable, "-P", worker.__file__, *([] if model is None else [str(resolve_model(model).resolve())])],
            env=environment,
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._folder = folder
        try:
            started = self._read()
        except SourceError:
            self.close()
            raise
        if not Path(started["package"]).is_relative_to(folder):
            self.close()
            raise SourceError(f"{folder} imported {started['package']}", "give a checkout with service/lanestream")
        self.description = {"version": started["version"], "checkout": str(folder)}
        self.description |= {} if model is None else {"model": str(model)}

    def open(self, camera: CameraParameters, *, single_image: bool = False) -> Answerer:
        """Returns the answerer of a new stream, which replaces the one before, or of a single image."""
        opening: dict[str, Any] = {"camera": None if camera is None else dict(camera)}
        seq = 0

        def answer(image: Image, timestamp: float) -> Callable[[], dict[str, Any]]:
            nonlocal opening, seq
            request = {
                "single_image": single_image,
                "size": image.shape[:2],
                "seq": seq,
                "timestamp": timestamp,
                **opening,
            }
            self._send(request, image)
            opening, seq = {}, seq + 1
            return self._read

        return answer

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()

    def _send(self, request: Mapping[str, Any], image: Image) -> None:
        if self._process.stdin is None:
            raise RuntimeError("the process has no stdin")
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n" + np.ascontiguousarray(image).tobytes())
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # reading reports how the process ended

    def _read(self) -> dict[str, Any]:
        line = b"" if self._process.stdout is None else self._process.stdout.readline()
        if not line:
            code = self._process.wait()
            raise SourceError(f"the process of {self._folder} ended with exit code {code}", "see its output above")
        reply: dict[str, Any] = json.loads(line)
        return reply


@dataclass(frozen=True)
class SystemSpec:
    """How to start a system: the checkout, None for this code in this process, and the model, None for the shipped."""

    name: str
    checkout: Path | None = None
    model: Path | None = None

    def start(self) -> PresentSystem | CheckoutSystem:
        """Starts the system. Raises SourceError for a folder that is not a checkout, ModelError for a bad model."""
        return PresentSystem(self.model) if self.checkout is None else CheckoutSystem(self.checkout, self.model)

    def describe(self) -> dict[str, str]:
        """Returns the description of the system, which is started for it."""
        with closing(self.start()) as system:
            return system.description


def _answer(camera: LocalCamera, image: Image, timestamp: float) -> dict[str, Any]:
    message = camera.lanes(image, seq=0, timestamp=timestamp).model_dump(mode="json", exclude={"timing_ms"})
    return message | {"nis": camera.nis.tolist()}
