"""What is measured: models with the service's own engine, and the peers."""

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
from lanestream_exporter.evaluation.boundaries import Found
from lanestream_exporter.evaluation.outcomes import MOST_CANDIDATES, Outcome, judge

# Takes the frames of a clip in order, each with its time in seconds, and says what is there.
Follower = Callable[[Image, float], tuple[Found, ...]]


class Method(Protocol):
    """Something that finds boundaries: `kind` is classifier, regressor or peer."""

    @property
    def name(self) -> str:
        """The method's name in reports, unique among those of one evaluation."""
        ...

    @property
    def kind(self) -> str:
        """What it is."""
        ...

    @property
    def threshold(self) -> float | None:
        """The probability from which on a candidate is accepted; None for what has no candidates."""
        ...

    @property
    def guided_by(self) -> str | None:
        """The regressor that shows a classifier where to look; None without one."""
        ...

    def look(self, image: Image, frame: LabelledFrame) -> Outcome:
        """A BGR image (H, W, 3) by itself."""
        ...

    def follow(self) -> Follower:
        """A fresh memory for the frames of one clip."""
        ...


class Model:
    """A model file in the service's engine, with the tracker of its sessions."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.name = engine.network.name
        self.kind = str(engine.network.metadata["kind"])
        detector = engine.detector
        self._wide: CandidateDetector | None = None
        self.threshold: float | None = None
        self.guided_by: str | None = None
        if isinstance(detector, CandidateDetector):
            self._wide = replace(detector, search=replace(detector.search, limit=MOST_CANDIDATES))
            self.threshold = detector.threshold
            glance = engine.pipeline().glance
            self.guided_by = None if glance is None else glance.network.name

    def look(self, image: Image, frame: LabelledFrame) -> Outcome:
        """A single image: the first frame of a new session."""
        session = self._engine.open_session()
        prepared = answered(session.prepare(image))
        outputs = self._engine.network.run(prepared.inputs)
        found = _found(session.conclude(prepared, outputs, 0.0))
        if self._wide is None:
            return Outcome(frame, found)
        wide = answered(replace(self._engine.pipeline(), detector=self._wide).prepare(image))
        return Outcome(frame, found, judge(prepared, outputs, wide, frame))

    def follow(self) -> Follower:
        """A session with its tracker."""
        session = self._engine.open_session()
        return lambda image, timestamp: _found(self._engine.process(session, image, timestamp))


class FinderOfBoundaries(Protocol):
    """A peer's whole interface."""

    @property
    def name(self) -> str:
        """The peer's name in reports."""
        ...

    def find(self, image: Image) -> tuple[Found, ...]:
        """The ego boundaries of a BGR image (H, W, 3)."""
        ...


class Peer:
    """A peer as a method. It has no memory: of a clip it says what it says of its single frames."""

    kind = "peer"
    threshold = None
    guided_by = None

    def __init__(self, finder: FinderOfBoundaries) -> None:
        self._finder = finder
        self.name = finder.name

    def look(self, image: Image, frame: LabelledFrame) -> Outcome:
        """A single image."""
        return Outcome(frame, self._finder.find(image))

    def follow(self) -> Follower:
        """The same, frame by frame."""
        return lambda image, _: self._finder.find(image)


def _found(result: FrameResult) -> tuple[Found, ...]:
    return tuple(Found.of(lane) for lane in result.lanes)
