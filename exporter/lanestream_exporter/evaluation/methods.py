"""The methods that are evaluated: models in the service's own engine, and the baselines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from lanestream.detection import answered
from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.engine import Engine
from lanestream.road.results import FrameResult
from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.outcomes import MOST_CANDIDATES, FrameOutcome, judge

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

    def detect(self, image: Image, frame: LabelledFrame) -> FrameOutcome:
        """Evaluates a single BGR image (H, W, 3)."""
        ...

    def start_clip(self) -> ClipTracker:
        """Returns a tracker with empty state for the frames of one clip."""
        ...


class ServedModel:
    """A model file in the service's engine, with the tracker of its sessions."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.name = engine.network.name
        self.kind = str(engine.network.metadata["kind"])
        detector = engine.detector
        self._wide: CandidateDetector | None = None
        self.threshold: float | None = None
        self.regressor: str | None = None
        if isinstance(detector, CandidateDetector):
            self._wide = replace(detector, search=replace(detector.search, limit=MOST_CANDIDATES))
            self.threshold = detector.threshold
            prior_estimator = engine.pipeline().glance
            self.regressor = None if prior_estimator is None else prior_estimator.network.name

    def detect(self, image: Image, frame: LabelledFrame) -> FrameOutcome:
        """Evaluates a single image as the first frame of a new session."""
        session = self._engine.open_session()
        prepared = answered(session.prepare(image))
        outputs = self._engine.network.run(prepared.inputs)
        reports = _reports(session.conclude(prepared, outputs, 0.0))
        if self._wide is None:
            return FrameOutcome(frame, reports)
        wide = answered(replace(self._engine.pipeline(), detector=self._wide).prepare(image))
        return FrameOutcome(frame, reports, judge(prepared, outputs, wide, frame))

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

    def detect(self, image: Image, frame: LabelledFrame) -> FrameOutcome:
        """Evaluates a single image."""
        return FrameOutcome(frame, self._detector.detect(image))

    def start_clip(self) -> ClipTracker:
        """Returns the detector itself, without state."""
        return lambda image, _: self._detector.detect(image)


def _reports(result: FrameResult) -> tuple[ReportedBoundary, ...]:
    return tuple(ReportedBoundary.from_lane(lane) for lane in result.lanes)
