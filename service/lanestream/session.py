"""One camera: detect, then track. Its state is a small value."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, Detector, FrameContext, Infer, ModelRole
from lanestream.images.resizing import working_image
from lanestream.road.results import FrameResult
from lanestream.road.view import Image, Scaling
from lanestream.tracking.state import MAX_COUNT, TrackerState, check_range
from lanestream.tracking.tracker import LaneTracker

# The least weight of a new frame's horizon: bumps should not move the estimate, a minute of driving should.
_HORIZON_GAIN: Final = 0.1
# The limits of a saved state: a side of a working image in pixels, and the row of a horizon as a share of the height.
# Detectors place no horizon lower, because some road must be visible below it.
_LONGEST_SIDE: Final = 1 << 20
_HORIZONS: Final = (-1.0, 0.98)


@dataclass(frozen=True)
class SessionState:
    """The state of a session as a small value.

    `size` is the width and height of its working images. `horizon` is the camera's estimate and `prior_horizon` the
    ego-lane prior's in the last frame, both as shares of the height. `evidence` is the sum of the frames' horizon
    weights.
    """

    size: tuple[int, int] | None = None
    horizon: float | None = None
    prior_horizon: float | None = None
    evidence: float = 0.0
    tracker: TrackerState = field(default_factory=TrackerState)

    def validate(self) -> None:
        """Checks a state from outside this process. Raises ValueError, on one line, if no session can have it."""
        if self.size is not None and not all(0 < side <= _LONGEST_SIDE for side in self.size):
            raise ValueError(f"a side of the images is not between 1 and {_LONGEST_SIDE} pixels")
        check_range("horizon", self.horizon, *_HORIZONS)
        check_range("prior_horizon", self.prior_horizon, *_HORIZONS)
        check_range("evidence", self.evidence, 0.0, MAX_COUNT)
        self.tracker.validate()


class Session:
    """Tracks the lanes of one camera, frame by frame.

    `horizon` is its row as a share of the image height, if the caller knows it; otherwise it is estimated from the
    frames and smoothed over time. A frame of another size than the last one resets the tracker.
    """

    def __init__(self, detector: Detector, horizon: float | None = None) -> None:
        self._detector = detector
        self._configured = horizon
        self._size: tuple[int, int] | None = None
        self._horizon: float | None = None
        self._prior_horizon: float | None = None
        self._evidence = 0.0
        self._tracker = LaneTracker()

    @property
    def state(self) -> SessionState:
        """The complete state. Do not read it while a frame is being processed."""
        return SessionState(self._size, self._horizon, self._prior_horizon, self._evidence, self._tracker.state)

    def restore(self, state: SessionState, ids_lost: int = 0) -> None:
        """Continues where `state` was taken; `ids_lost` more track ids count as assigned.

        Raises ValueError for an incomplete state, and leaves the session as it was. A state from outside this process
        needs `SessionState.validate` first, which takes too long for every frame.
        """
        self._tracker = LaneTracker.restored(state.tracker, ids_lost)
        self._size, self._horizon, self._evidence = state.size, state.horizon, state.evidence
        self._prior_horizon = state.prior_horizon

    def process(self, image: Image, timestamp: float, infer: Infer) -> FrameResult:
        """Returns the lanes of one frame, a BGR image (H, W, 3) uint8, in pixels of that image.

        `timestamp` is the capture time in seconds; frames of a session are processed one at a time, in order. The
        result's timing has the milliseconds of `propose` (without waiting for `infer`), `fit` and `track`. If `infer`
        raises, the session stays as it was.
        """
        started = time.perf_counter()
        working, scaling = working_image(image)
        inference = _TimedInference(infer)
        detections = self._detector.detect(working, self._context(image, working, scaling), inference)
        detected = time.perf_counter()
        self._update_horizon(detections)
        result = self._tracker.update(detections.boundaries, timestamp, detections.view).to_image(scaling)
        result.timing_ms.update(
            propose=1e3 * (detected - started - inference.waited_s - detections.fit_s),
            fit=1e3 * detections.fit_s,
            track=1e3 * (time.perf_counter() - detected),
        )
        return result

    def _context(self, image: Image, working: Image, scaling: Scaling) -> FrameContext:
        height, width = working.shape[:2]
        is_known = self._size == (width, height)
        horizon = None if self._horizon is None else self._horizon * height
        if self._configured is not None:
            horizon = scaling.to_working(self._configured * image.shape[0])
        return FrameContext(
            horizon=horizon,
            tracked=self._tracker.curves if is_known else None,
            prior_horizon=None if self._prior_horizon is None or not is_known else self._prior_horizon * height,
        )

    def _update_horizon(self, detections: Detections) -> None:
        """Updates the horizon with a weighted mean of the frames' horizons that forgets old frames slowly."""
        view = detections.view
        size = view.width, view.height
        if self._size not in (None, size):
            self._tracker = LaneTracker()
            self._horizon, self._evidence = None, 0.0
        self._size = size
        prior_horizon = detections.prior_horizon
        self._prior_horizon = None if prior_horizon is None else prior_horizon / view.height
        share, weight = view.horizon / view.height, detections.horizon_weight
        self._evidence += weight
        gain = max(_HORIZON_GAIN * weight, weight / max(self._evidence, 1e-6))
        self._horizon = share if self._horizon is None else self._horizon + gain * (share - self._horizon)


class _TimedInference:
    """Calls `infer` and sums up the seconds that the calls take."""

    def __init__(self, infer: Infer) -> None:
        self._infer = infer
        self.waited_s = 0.0

    def __call__(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        started = time.perf_counter()
        try:
            return self._infer(role, inputs)
        finally:
            self.waited_s += time.perf_counter() - started
