"""Fakes of what is slow or cannot be controlled: a detector that knows the road, and models that wait for the test."""

from __future__ import annotations

import threading
import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, FrameContext, Infer, ModelRole
from lanestream.engine import Engine
from lanestream.inference.loaded_model import Placement
from lanestream.protocol import EgoModel, LanesMessage, Limits, Mode, ReadyMessage, TimingModel
from lanestream.road.appearance import Appearance
from lanestream.road.curve import Curve
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView, visible_rows

WAIT_S = 10.0  # far longer than anything takes, so that a test fails instead of hanging

_MAIN_ROLES: dict[str, ModelRole] = {"candidates": "classifier", "regression": "regressor"}


class FakeDetector:
    """Sees the two boundaries of a straight ego lane in every frame; fails at a frame that is white all over."""

    role: ModelRole = "classifier"
    slopes: tuple[float, ...] = (-1.15, 1.15)
    appearances: tuple[Appearance, ...] = (Appearance(), Appearance())

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        height, width = image.shape[:2]
        view = RoadView(width, height, 0.4 * height if context.horizon is None else context.horizon)
        infer(self.role, np.zeros((2, 8, 8, 3), np.uint8))
        if image.min() == 255:
            raise RuntimeError("the detector failed")
        found = []
        for slope, appearance in zip(self.slopes, self.appearances, strict=False):
            curve = Curve(view.horizon, (view.middle, slope, 0.0))
            rows = visible_rows(curve, view)
            if rows is not None:
                covariance = np.diag([1.0, 1e-4, 50.0])
                found.append(Detection(curve, covariance, *rows, 0.9, expected=True, appearance=appearance))
        return Detections(tuple(found), view, horizon_weight=1.0)


class LeftDetector(FakeDetector):
    """Sees only the left boundary, with the regressor."""

    role = "regressor"
    slopes = (-1.15,)


class KindsDetector(FakeDetector):
    """Sees a dashed yellow marking on the left and the edge of the road on the right."""

    appearances = (Appearance(0.02, (0.03, 0.95, 0.01, 0.01), (0.04, 0.96)), Appearance(0.97, (0.25,) * 4, (0.5, 0.5)))


class DriftingDetector(FakeDetector):
    """Sees a lane 3.2 m wide, 25 times per second, from a camera 1.4 m high that drifts to the right after a second."""

    def __init__(self) -> None:
        self._frame = 0

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        offset = max(0.0, 0.5 * (0.04 * self._frame - 1.0))
        self._frame += 1
        self.slopes = (-(1.6 + offset) / 1.4, (1.6 - offset) / 1.4)
        return super().detect(image, context, infer)


class FakeModel:
    """Returns its outputs immediately."""

    name = "fake 1"
    largest_batch = 16
    placement = Placement("cpu", "the fake runs nowhere else", 1, {"CPU": 1}, (1, 16))
    sha256 = "fa4e"
    metadata: dict[str, Any] = {"kind": "fake"}  # noqa: RUF012

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return np.full((len(inputs), 2), 0.5, np.float32)


class OtherModel(FakeModel):
    """The same with another name."""

    name = "other 2"
    metadata: dict[str, Any] = {"kind": "other fake"}  # noqa: RUF012


class GatedModel(FakeModel):
    """Holds every frame until it is let through."""

    def __init__(self) -> None:
        self._arrived = threading.Semaphore(0)
        self._gate = threading.Semaphore(0)

    def run(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self._arrived.release()
        assert self._gate.acquire(timeout=WAIT_S)
        return super().run(inputs)

    def wait_for_a_frame(self) -> None:
        """Waits until a frame is being held."""
        assert self._arrived.acquire(timeout=WAIT_S)

    def let_through(self, frames: int = 1) -> None:
        """Lets so many frames pass, those held now or later ones."""
        self._gate.release(frames)


def engine(model: FakeModel | None = None, detector: FakeDetector | None = None) -> Engine:
    """Returns an engine of fakes with one detector, `candidates`."""
    return Engine({"classifier": model or FakeModel()}, {"candidates": detector or FakeDetector()}, _MAIN_ROLES)


def left_engine() -> Engine:
    """Returns an engine of fakes with one detector, `regression`, which sees only the left boundary."""
    return Engine({"regressor": OtherModel()}, {"regression": LeftDetector()}, _MAIN_ROLES)


def drifting_engine() -> Engine:
    """Returns an engine for one camera, which leaves its lane."""
    return engine(detector=DriftingDetector())


def kinds_engine() -> Engine:
    """Returns an engine that sees a dashed yellow marking on the left and the edge of the road on the right."""
    return engine(detector=KindsDetector())


def two_detectors() -> Engine:
    """Returns an engine of fakes with both detectors: `candidates`, the default, and `regression`."""
    one, other = engine(), left_engine()
    return Engine({**one.models, **other.models}, {**one.detectors, **other.detectors}, _MAIN_ROLES)


def picture(width: int = 320, height: int = 180) -> Image:
    """Returns a BGR image of a gray ramp."""
    return np.tile(np.linspace(30, 220, width).astype(np.uint8)[None, :, None], (height, 1, 3))


def image_file(kind: str = ".jpg", width: int = 320, height: int = 180, shade: int | None = None) -> bytes:
    """Returns an image file of a gray ramp, or of one `shade`."""
    ramp = picture(width, height)
    image = ramp if shade is None else np.full_like(ramp, shade)
    return cv2.imencode(kind, image)[1].tobytes()


def limits(**other: float) -> Limits:
    """Returns a service's limits, replaced by those in `other`."""
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
    """Returns the message for a new session, with the fields in `other`."""
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
    """Waits in real time, for limits that are times."""
    time.sleep(seconds)


def lanes(seq: int) -> LanesMessage:
    """Returns the message for a frame without lanes."""
    timing = TimingModel(decode=0, propose=0, queue=0, infer=0, track=0, total=0)
    ego = EgoModel(left=None, right=None, offset=None)
    return LanesMessage(
        seq=seq, timestamp=0, width=9, height=9, horizon=1, lanes=[], ego=ego, events=[], dropped=0, timing_ms=timing
    )
