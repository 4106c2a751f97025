"""One camera's memory: its tracker and its horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Detections, Network, Pipeline, Prepared, Question, Steps
from lanestream.road.results import FrameResult
from lanestream.road.view import Image
from lanestream.tracking import LaneTracker
from lanestream.tracking.state import TrackerState

# The least that a new frame's horizon counts for the camera's: bumps should not move it, a minute of driving should.
_HORIZON_GAIN = 0.1


@dataclass(frozen=True)
class SessionState:
    """What a session remembers, as a small value.

    That is the size (width, height) of its frames, its horizon and the one that was last seen at a glance (both as
    shares of the height), and its tracker.
    """

    size: tuple[int, int] | None
    horizon: float | None
    glanced: float | None
    evidence: float
    tracker: TrackerState


class Session:
    """Follows the lanes of one camera, frame by frame.

    `horizon` is its row as a share of the image height where the caller knows it; otherwise it is estimated from the
    frames and steadied over time. A frame of another size than the last one starts the tracker afresh. `network` is
    what answers between the two halves of a frame.
    """

    def __init__(self, pipeline: Pipeline, horizon: float | None = None) -> None:
        self._pipeline = pipeline
        self.network: Network = pipeline.network
        self._configured = horizon
        self._estimate: float | None = None
        self._glanced: float | None = None
        self._evidence = 0.0
        self._size: tuple[int, int] | None = None
        self._tracker = LaneTracker()

    @property
    def state(self) -> SessionState:
        """All that it remembers. Not to be asked for while a frame is being concluded."""
        return SessionState(self._size, self._estimate, self._glanced, self._evidence, self._tracker.state)

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Goes on where `state` was taken; `ids_lost` as for `LaneTracker.restored`. Raises ValueError for a bad one.

        The session is then as it was before.
        """
        self._tracker = LaneTracker.restored(state.tracker, ids_lost)
        self._size, self._estimate, self._evidence = state.size, state.horizon, state.evidence
        self._glanced = state.glanced

    def follow(self, image: Image, timestamp: float) -> Steps[FrameResult]:
        """One frame of the camera, from a BGR image (H, W, 3) uint8 to its lanes; `timestamp` as for `conclude`.

        The session is left as it was until the last answer has come.
        """
        prepared = yield from self.prepare(image)
        *first, last = prepared.parts
        for part in first:
            yield Question(self.network, part(), waits=False)
        outputs = yield Question(self.network, last())
        return self.conclude(prepared, outputs, timestamp)

    def prepare(self, image: Image) -> Steps[Prepared]:
        """The first half of a frame: network inputs from a BGR image (H, W, 3) uint8. Leaves the session as it is."""
        height = image.shape[0]
        share = self._configured if self._configured is not None else self._estimate
        known = self._size == (image.shape[1], height)
        return self._pipeline.prepare(
            image,
            horizon=None if share is None else share * height,
            expected=self._tracker.curves if known else (),
            glanced=None if self._glanced is None or not known else self._glanced * height,
        )

    def conclude(self, prepared: Prepared, outputs: NDArray[np.float32], timestamp: float) -> FrameResult:
        """The second half: detections from the network's outputs, then one step of the tracker.

        `timestamp` is the capture time in seconds. Frames of a session are concluded one at a time, in order.
        """
        view = prepared.view
        findings = self._pipeline.detector.finish(prepared, outputs)
        if self._size not in (None, (view.width, view.height)):
            self._tracker = LaneTracker()
            self._estimate, self._evidence = None, 0.0
        self._size = (view.width, view.height)
        self._glanced = None if prepared.prior is None else prepared.prior.view.horizon / view.height
        self._steady_horizon(findings)
        return self._tracker.update(findings.detections, timestamp, findings.view)

    def _steady_horizon(self, findings: Detections) -> None:
        """A mean of what the frames say, weighed by how much they have to say, that forgets slowly."""
        share = findings.view.horizon / findings.view.height
        self._evidence += findings.horizon_weight
        gain = max(_HORIZON_GAIN * findings.horizon_weight, findings.horizon_weight / max(self._evidence, 1e-6))
        self._estimate = share if self._estimate is None else self._estimate + gain * (share - self._estimate)
