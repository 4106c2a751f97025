"""The whole way of a frame in one place: detectors, their networks, and the steps between image and result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from lanestream.detection import Detector, Network, Pipeline, chosen, in_one
from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.ego_prior import EgoPriorEstimator
from lanestream.detection.patches import PatchCutter, PatchGeometry
from lanestream.detection.regression_detector import RegressionDetector, RoadCropGeometry
from lanestream.errors import ModelError
from lanestream.inference import ClassifierInfo, LoadedModel, RegressorInfo, load_model
from lanestream.protocol import DetectorName
from lanestream.road.results import FrameResult
from lanestream.road.view import Image
from lanestream.runtime import DEFAULT_OPTIONS, Provider, RuntimeOptions
from lanestream.session import Session
from lanestream.workers.walk import FrameWalk

# The networks that are shipped, and served where no others are named.
SHIPPED_MODEL: Final = Path(__file__).parent / "models" / "classifier.onnx"
SHIPPED_REGRESSOR: Final = Path(__file__).parent / "models" / "regressor.onnx"


class Engine:
    """Detectors with their loaded networks, shared by all sessions of a process; the first one is the default."""

    def __init__(self, pipelines: Sequence[Pipeline]) -> None:
        self.pipelines = tuple(pipelines)

    @property
    def detector(self) -> Detector:
        """The default detector."""
        return self.pipelines[0].detector

    @property
    def network(self) -> Network:
        """The default detector's network."""
        return self.pipelines[0].network

    def pipeline(self, name: DetectorName | None = None) -> Pipeline:
        """The pipeline of that name, the default one where None. Raises NoDetectorError where it is not loaded."""
        return chosen({pipeline.name: pipeline for pipeline in self.pipelines}, name)

    def open_session(self, horizon: float | None = None, detector: DetectorName | None = None) -> Session:
        """A session for one camera; `horizon` is its row as a share of the image height, estimated where None.

        Raises NoDetectorError where `detector` is not loaded.
        """
        return Session(self.pipeline(detector), horizon)

    def process(self, session: Session, image: Image, timestamp: float) -> FrameResult:
        """One frame from image to lanes, in the calling thread, with the milliseconds of each stage."""
        walk = FrameWalk(in_one(session.follow(image, timestamp)))
        question = walk.go()
        inferring = 0.0
        while question is not None:
            started = time.perf_counter()
            answer = question.network.run(question.inputs)
            inferring += time.perf_counter() - started
            question = walk.go(answer)
        return replace(walk.result, timing_ms={**walk.timing_ms, "infer": 1e3 * inferring})


def load_engine(
    model: Path | None = None,
    provider: Provider = "auto",
    regressor: Path | None = SHIPPED_REGRESSOR,
    options: RuntimeOptions = DEFAULT_OPTIONS,
) -> Engine:
    """The engine for the model file at `model`, the shipped classifier where None, warmed up.

    A classifier is helped by the `regressor`, which tells it where to look and is a detector of its own; None goes
    without. A regressor as the `model` is the only detector. Raises ModelError for a file that can't be served,
    ProviderError where `provider` can't be had.
    """
    network = _warm(model or SHIPPED_MODEL, provider, options)
    if isinstance(network.info, RegressorInfo):
        return Engine([_whole_frames(_regression(network.info), network)])
    if regressor is None:
        return Engine([Pipeline("candidates", _candidates(network.info), network)])
    other = _warm(regressor, provider, options)
    if not isinstance(other.info, RegressorInfo):
        raise ModelError(f"{regressor} is a {other.info.kind}, not a regressor", "give a regressor, or `none`")
    regression = _regression(other.info)
    glance = EgoPriorEstimator(regression, other)
    return Engine(
        [
            Pipeline("candidates", _candidates(network.info), network, glance),
            _whole_frames(regression, other),
        ]
    )


def resolve_regressor(named: Path | None) -> Path | None:
    """The file that users mean by `named`: the default one where they name none, and no file by the name `none`."""
    if named is None:
        return SHIPPED_REGRESSOR
    return None if named == Path("none") else named


def _warm(path: Path, provider: Provider, options: RuntimeOptions) -> LoadedModel:
    network = load_model(path, provider, options)
    network.warm_up()
    return network


def _whole_frames(detector: RegressionDetector, network: Network) -> Pipeline:
    """The detector that needs one look; a frame whose horizon it does not know it looks at once more, closely."""
    return Pipeline("regression", detector, network, first_look=EgoPriorEstimator(detector, network))


def _candidates(info: ClassifierInfo) -> CandidateDetector:
    """The detector that asks a classifier about the strips it was trained on."""
    strip = PatchGeometry(info.strip.size, info.strip.half_width, info.strip.min_half_width, info.strip.lean)
    return CandidateDetector(info.threshold, cutter=PatchCutter(strip))


def _regression(info: RegressorInfo) -> RegressionDetector:
    """The detector that shows a regressor the canvases it was trained on."""
    canvas = info.canvas
    geometry = RoadCropGeometry(canvas.size, canvas.above, canvas.narrowest)
    return RegressionDetector(info.threshold, geometry, canvas.detail_width)
