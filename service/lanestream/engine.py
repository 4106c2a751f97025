"""The whole way of a frame in one place: a detector, its network, and the steps between image and result."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from lanestream.detection import LaneDetector, Network
from lanestream.detection.detector import CandidateDetector
from lanestream.detection.regression import RegressionDetector
from lanestream.detection.strips import StripCutter
from lanestream.geometry import CanvasGeometry, StripGeometry
from lanestream.inference import ModelInfo, OnnxModel, RegressorInfo
from lanestream.inference.providers import Provider
from lanestream.lanes import FrameResult, Image
from lanestream.sessions import Session

# The network that is shipped and served where no other is named.
SHIPPED_MODEL = Path(__file__).parent / "models" / "classifier.onnx"


class Engine:
    """A loaded network and its detector, shared by all sessions of a process."""

    def __init__(self, detector: LaneDetector, network: Network) -> None:
        self.detector = detector
        self.network = network

    def open_session(self, horizon: float | None = None) -> Session:
        """A session for one camera; `horizon` is its row as a share of the image height, estimated where None."""
        return Session(self.detector, horizon)

    def process(self, session: Session, image: Image, timestamp: float) -> FrameResult:
        """One frame from image to lanes, in the calling thread, with the milliseconds of each stage."""
        started = time.perf_counter()
        prepared = session.prepare(image)
        proposed = time.perf_counter()
        outputs = self.network.run(prepared.inputs)
        inferred = time.perf_counter()
        result = session.conclude(prepared, outputs, timestamp)
        tracked = time.perf_counter()
        timing = {
            "propose": 1e3 * (proposed - started),
            "infer": 1e3 * (inferred - proposed),
            "track": 1e3 * (tracked - inferred),
        }
        return replace(result, timing_ms=timing)


def load_engine(model: Path | None = None, provider: Provider = "auto") -> Engine:
    """The engine for the model file at `model`, the shipped one where None, warmed up.

    Raises ModelError for a file that can't be served, ProviderError where `provider` can't be had.
    """
    network = OnnxModel.load(model or SHIPPED_MODEL, provider)
    network.warm_up()
    return Engine(_detector(network.info), network)


def _detector(info: ModelInfo) -> LaneDetector:
    """The detector that asks a network the questions it was trained for."""
    if isinstance(info, RegressorInfo):
        canvas = info.canvas
        geometry = CanvasGeometry(canvas.size, canvas.above, canvas.narrowest)
        return RegressionDetector(info.threshold, geometry, canvas.detail_width)
    strip = StripGeometry(info.strip.size, info.strip.half_width, info.strip.min_half_width)
    return CandidateDetector(info.threshold, cutter=StripCutter(strip))
