"""The life of one tracked boundary: tentative, confirmed, coasting, deleted."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from lanestream.road.curve import FloatArray
from lanestream.road.results import Detection
from lanestream.tracking.kalman import MEASURED, TrackedRows


@dataclass
class Track:
    """A tracked boundary. Times are seconds on the tracker's own clock.

    `state` (6,) and `covariance` (6, 6) are the filter's. `hits` records for the last frames whether a detection
    supported it. `side` is -1 left and +1 right of the camera; `crossing` counts consecutive frames in which it was
    clearly on the other side. `drift` is how much the road has turned since it was last detected.
    `previous_columns` are those of the last frame.
    """

    state: FloatArray
    covariance: FloatArray
    born: float
    last_hit: float
    probability: float
    top: float
    bottom: float
    hits: deque[bool]
    side: int
    track_id: int | None = None
    crossing: int = 0
    detected: bool = True
    drift: float = 0.0
    previous_columns: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.previous_columns = self.columns

    @property
    def confirmed(self) -> bool:
        """Whether it has an identity."""
        return self.track_id is not None

    @property
    def detected_twice(self) -> bool:
        """Whether detections supported it in this frame and in the last one, so that its motion was measured."""
        return len(self.hits) > 1 and self.hits[-1] and self.hits[-2]

    @property
    def columns(self) -> FloatArray:
        """The columns (3,) at the tracker's rows."""
        return self.state[:MEASURED]

    def hit(self, detection: Detection, now: float) -> None:
        """Records the detection that the filter was updated with."""
        self.hits.append(True)
        self.detected = True
        self.drift = 0.0
        self.last_hit = now
        self.probability += 0.4 * (detection.probability - self.probability)
        self.top += 0.3 * (detection.top - self.top)
        self.bottom += 0.3 * (detection.bottom - self.bottom)

    def miss(self) -> None:
        """Records a frame without a detection."""
        self.hits.append(False)
        self.detected = False

    def coast(self, below: FloatArray) -> None:
        """Records a move without a detection; the tracked rows are `below` (3,) the horizon."""
        near, middle, _ = (self.columns - self.previous_columns) / below
        self.drift += abs(float(middle - near))

    def change_rows(self, old: TrackedRows, new: TrackedRows) -> None:
        """Expresses the state at other rows."""
        matrix = old.mapping_to(new)
        state, covariance = self.state.copy(), self.covariance.copy()
        for i in (0, MEASURED):
            state[i : i + MEASURED] = matrix @ state[i : i + MEASURED]
            for j in (0, MEASURED):
                block = covariance[i : i + MEASURED, j : j + MEASURED]
                covariance[i : i + MEASURED, j : j + MEASURED] = matrix @ block @ matrix.T
        self.state, self.covariance = state, covariance
