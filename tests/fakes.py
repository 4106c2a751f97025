"""Stand-ins for what is slow or can't be steered: a detector that knows the road, networks that wait to be told."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Detections, Pipeline, Prepared
from lanestream.engine import Engine
from lanestream.protocol import EgoModel, LanesMessage, Limits, Mode, ReadyMessage, TimingModel
from lanestream.road.curve import Curve
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_rows

WAIT_S = 10.0  # far more than anything takes; a test that hangs fails instead


class FakeDetector:
    """Sees the two boundaries of a straight ego lane in every frame; fails at a frame that is white all over."""

    slopes: tuple[float, ...] = (-1.15, 1.15)

    def survey(self, image: Image, horizon: float | None = None) -> None:
        pass

    def prepare(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        prior: object = None,
        survey: object = None,
    ) -> Prepared:
        height, width = image.shape[:2]
        view = RoadView(width, height, 0.4 * height if horizon is None else horizon)
        return Prepared(image, (lambda: np.zeros((2, 8, 8, 3), np.uint8),), view, (), 1.0)

    def finish(self, prepared: Prepared, outputs: NDArray[np.float32]) -> Detections:
        if prepared.image.min() == 255:
            raise RuntimeError("a detector's own mistake")
        found = []
        for b in self.slopes:
            curve = Curve(prepared.view.horizon, ((prepared.view.width - 1) / 2, b, 0.0))
            rows = visible_rows(curve, prepared.view, 0.1)
            if rows is None:
                continue
            found.append(Detection(curve, np.diag([1.0, 1e-4, 50.0]), *rows, 0.9))
        return Detections(tuple(found), prepared.view, prepared.horizon_weight)


class LeftDetector(FakeDetector):
    """Sees the left one of them alone."""

    slopes = (-1.15,)


class FakeNetwork:
    """Answers at once."""

    name = "fake 1"
    provider = "cpu"
    reason = "there is nothing else"
    fell_back = False
    sha256 = "fa4e"
    buckets = (1, 16)
    metadata: dict[str, Any] = {"kind": "fake"}  # noqa: RUF012

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.full((len(inputs), 2), 0.5, np.float32)


class OtherNetwork(FakeNetwork):
    """Answers at once, by another name."""

    name = "other 2"
    metadata: dict[str, Any] = {"kind": "other fake"}  # noqa: RUF012


class GatedNetwork(FakeNetwork):
    """Holds every frame until it is let through."""

    def __init__(self) -> None:
        self._arrived = threading.Semaphore(0)
        self._gate = threading.Semaphore(0)

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._arrived.release()
        assert self._gate.acquire(timeout=WAIT_S)
        return super().run(inputs)

    def wait_for_a_frame(self) -> None:
        """Returns when a frame is being held."""
        assert self._arrived.acquire(timeout=WAIT_S)

    def let_through(self, frames: int = 1) -> None:
        """Lets frames pass, held ones or later ones."""
        self._gate.release(frames)


def engine(network: FakeNetwork | None = None) -> Engine:
    """An engine of fakes."""
    return Engine([Pipeline("candidates", FakeDetector(), network or FakeNetwork())])


def two_detectors() -> Engine:
    """An engine of fakes with both detectors: `candidates`, the default, and `regression`, which sees less."""
    return Engine([*engine().pipelines, Pipeline("regression", LeftDetector(), OtherNetwork())])


def picture(width: int = 320, height: int = 180) -> Image:
    """A grey ramp."""
    return np.tile(np.linspace(30, 220, width).astype(np.uint8)[None, :, None], (height, 1, 3))


def image_file(kind: str = ".jpg", width: int = 320, height: int = 180, shade: int | None = None) -> bytes:
    """An image file of a grey ramp, or of one `shade`."""
    ramp = picture(width, height)
    image = ramp if shade is None else np.full_like(ramp, shade)
    return cv2.imencode(kind, image)[1].tobytes()


def limits(**other: float) -> Limits:
    """Limits as a service tells them, some of them `other`."""
    usual: dict[str, Any] = {
        "max_bytes": 99_999,
        "max_pixels": 99_999,
        "credits": 3,
        "frames_per_s": 240.0,
        "bytes_per_s": 256e6,
        "idle_s": 60.0,
        "session_s": 3600.0,
        "resume_s": 60.0,
    }
    return Limits(**{**usual, **other})


def ready(mode: Mode = "all", **other: Any) -> ReadyMessage:
    """What a service says that has opened a new session, some of it `other`."""
    usual: dict[str, Any] = {
        "session": "x",
        "resume_token": "secret",
        "resumed": False,
        "last_seq": None,
        "detector": "candidates",
        "model": "m",
        "provider": "cpu",
        "limits": limits(),
    }
    return ReadyMessage(mode=mode, **{**usual, **other})


def pause(seconds: float) -> None:
    """Lets real time pass, where a limit of the service is a time."""
    time.sleep(seconds)


def lanes(seq: int) -> LanesMessage:
    """What a service says of a frame on which it sees no lanes."""
    timing = TimingModel(decode=0, propose=0, queue=0, infer=0, track=0, total=0)
    ego = EgoModel(left=None, right=None, offset=None)
    return LanesMessage(
        seq=seq, timestamp=0, width=9, height=9, horizon=1, lanes=[], ego=ego, events=[], dropped=0, timing_ms=timing
    )
