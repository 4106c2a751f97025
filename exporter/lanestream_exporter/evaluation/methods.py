"""The methods that are evaluated: models in the service's own engine, and the baselines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.classification import Classification
from lanestream.detection.interface import FrameContext, ModelRole
from lanestream.detection.patches import cut_patches
from lanestream.detection.proposals import MOST_CANDIDATES
from lanestream.engine import Engine
from lanestream.road.results import FrameResult
from lanestream.road.view import Image
from lanestream.session import SessionOptions
from lanestream_exporter.datasets.labels import LabeledFrame, to_working
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.outcomes import MOST_RANKED, FrameEvaluation, JudgedCandidates, judge

# Takes the frames of a clip in order, each with its time in seconds, and returns the boundaries of each.
ClipTracker = Callable[[Image, float], tuple[ReportedBoundary, ...]]


class Method(Protocol):
    """A method that finds boundaries."""

    @property
    def name(self) -> str:
        """Returns the name in reports, unique in an evaluation."""
        ...

    @property
    def kind(self) -> str:
        """Returns `classifier`, `regressor` or `baseline`."""
        ...

    @property
    def threshold(self) -> float | None:
        """Returns the probability from which a candidate is accepted; None for methods without candidates."""
        ...

    @property
    def regressor(self) -> str | None:
        """Returns the name of the regressor that gives a classifier its ego-lane prior; None without one."""
        ...

    def find(self, image: Image) -> tuple[ReportedBoundary, ...]:
        """Returns the boundaries in a single BGR image (H, W, 3)."""
        ...

    def detect(self, image: Image, frame: LabeledFrame) -> FrameEvaluation:
        """Evaluates a single BGR image (H, W, 3)."""
        ...

    def start_clip(self) -> ClipTracker:
        """Returns a tracker with empty state for the frames of one clip."""
        ...


class ServedModel:
    """A model file in the service's engine, with the tracker of its sessions."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        model = engine.main_model()
        self.name = model.name
        self.kind: str = model.info.kind
        detector = engine.detectors[engine.select()]
        self._candidates = detector if isinstance(detector, CandidateDetector) else None
        self.threshold = None if self._candidates is None else self._candidates.threshold
        has_prior = self._candidates is not None and self._candidates.regressor is not None
        self.regressor = engine.models["regressor"].name if has_prior else None

    def find(self, image: Image) -> tuple[ReportedBoundary, ...]:
        """Returns the boundaries in a single image."""
        session = self._engine.open_session(SessionOptions(single_image=True))
        return _reports(self._engine.process(session, image, 0.0))

    def detect(self, image: Image, frame: LabeledFrame) -> FrameEvaluation:
        """Evaluates a single image."""
        candidates = None if self._candidates is None else self._judge(self._candidates, *to_working(frame, image))
        return FrameEvaluation(frame, self.find(image), candidates)

    def _judge(self, detector: CandidateDetector, frame: LabeledFrame, image: Image) -> JudgedCandidates:
        """Judges the candidates of a working image: the same search as in `detect`, with more results."""
        proposals = detector.propose(image, FrameContext(), self._infer, MOST_RANKED)
        patches = cut_patches(image, proposals.curves, proposals.spans, proposals.view, detector.patch)
        return judge(proposals, Classification.of(self._infer("classifier", patches[:MOST_CANDIDATES])), frame)

    def _infer(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._engine.models[role].run(inputs)

    def start_clip(self) -> ClipTracker:
        """Returns the tracker of a new session."""
        session = self._engine.open_session()
        return lambda image, timestamp: _reports(self._engine.process(session, image, timestamp))


class BaselineDetector(Protocol):
    """The interface of a baseline's algorithm."""

    @property
    def name(self) -> str:
        """Returns the name in reports."""
        ...

    def detect(self, image: Image) -> tuple[ReportedBoundary, ...]:
        """Returns the ego boundaries of a BGR image (H, W, 3)."""
        ...


class Baseline:
    """A baseline as a method. It has no memory, so its results on clips are those of the single frames."""

    kind = "baseline"
    threshold = None
    regressor = None

    def __init__(self, detector: BaselineDetector) -> None:
        self._detector = detector
        self.name = detector.name

    def find(self, image: Image) -> tuple[ReportedBoundary, ...]:
        """Returns the boundaries in a single image."""
        return self._detector.detect(image)

    def detect(self, image: Image, frame: LabeledFrame) -> FrameEvaluation:
        """Evaluates a single image."""
        return FrameEvaluation(frame, self.find(image))

    def start_clip(self) -> ClipTracker:
        """Returns the detector itself, without state."""
        return lambda image, _: self._detector.detect(image)


def _reports(result: FrameResult) -> tuple[ReportedBoundary, ...]:
    return tuple(ReportedBoundary.from_lane(lane) for lane in result.lanes)
