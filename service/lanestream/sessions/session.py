"""One camera's memory: its tracker and its horizon."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import LaneDetector, Prepared
from lanestream.lanes import FrameResult
from lanestream.tracking import LaneTracker

if TYPE_CHECKING:
    from lanestream.lanes import Image

# How much of a new frame's horizon goes into the camera's: bumps should not move it, a minute of driving should.
_HORIZON_GAIN = 0.08


class Session:
    """Follows the lanes of one camera, frame by frame.

    `horizon` is its row as a share of the image height where the caller knows it; otherwise it is estimated from the
    frames and steadied over time. A frame of another size than the last one starts the tracker afresh.
    """

    def __init__(self, detector: LaneDetector, horizon: float | None = None) -> None:
        self._detector = detector
        self._configured = horizon
        self._estimate: float | None = None
        self._size: tuple[int, int] | None = None
        self._tracker = LaneTracker()

    def prepare(self, image: Image) -> Prepared:
        """The first half of a frame: network inputs from a BGR image (H, W, 3) uint8. Leaves the session as it is."""
        height = image.shape[0]
        share = self._configured if self._configured is not None else self._estimate
        return self._detector.prepare(image, None if share is None else share * height)

    def conclude(self, prepared: Prepared, outputs: NDArray[np.float32], timestamp: float) -> FrameResult:
        """The second half: detections from the network's outputs, then one step of the tracker.

        `timestamp` is the capture time in seconds. Frames of a session are concluded one at a time, in order.
        """
        view = prepared.view
        if self._size not in (None, (view.width, view.height)):
            self._tracker = LaneTracker()
            self._estimate = None
        self._size = (view.width, view.height)
        detections = self._detector.finish(prepared, outputs)
        self._steady_horizon(prepared)
        return self._tracker.update(detections, timestamp, view)

    def _steady_horizon(self, prepared: Prepared) -> None:
        seen = prepared.seen_horizon
        if seen is None:
            return
        share = seen / prepared.view.height
        if self._estimate is None:
            self._estimate = share
            return
        self._estimate += _HORIZON_GAIN * prepared.horizon_weight * (share - self._estimate)
