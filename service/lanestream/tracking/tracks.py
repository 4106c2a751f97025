"""The life of one tracked boundary: tentative, confirmed, coasting, gone."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from filterpy.kalman import KalmanFilter

from lanestream.road.curve import FloatArray
from lanestream.road.results import Detection
from lanestream.tracking.kalman import Rows


@dataclass
class Track:
    """A boundary with a past. Times are seconds on the tracker's own clock.

    `hits` remembers for the last frames whether a detection backed it. `side` is -1 left and +1 right of the camera;
    `crossing` counts the frames in which it has been clearly on the other one. `turned` tells how much the road has
    turned beneath it since it was last seen. `previous_columns` are those of the frame before.
    """

    kalman: KalmanFilter
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
    turned: float = 0.0
    previous_columns: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.previous_columns = self.kalman.x[:3].copy()

    @property
    def confirmed(self) -> bool:
        """Whether it has been given an identity."""
        return self.track_id is not None

    @property
    def seen_twice(self) -> bool:
        """Whether a detection backed it in this frame and in the last one, so that it moved as its boundary did."""
        return len(self.hits) > 1 and self.hits[-1] and self.hits[-2]

    @property
    def columns(self) -> FloatArray:
        """Columns (3,) at the tracker's rows."""
        columns: FloatArray = self.kalman.x[:3]
        return columns

    def hit(self, detection: Detection, columns: FloatArray, noise: FloatArray, now: float) -> None:
        """Takes in a detection whose columns (3,) have the covariance `noise` (3, 3)."""
        self.kalman.update(columns, R=noise)
        self.hits.append(True)
        self.detected = True
        self.turned = 0.0
        self.last_hit = now
        self.probability += 0.4 * (detection.probability - self.probability)
        self.top += 0.3 * (detection.top - self.top)
        self.bottom += 0.3 * (detection.bottom - self.bottom)

    def restart(self, kalman: KalmanFilter) -> None:
        """Forgets the filter's past for a fresh `kalman`; the boundary stays who it is."""
        self.kalman = kalman

    def miss(self) -> None:
        """Notes a frame without a detection."""
        self.hits.append(False)
        self.detected = False

    def carried(self, below: FloatArray) -> None:
        """Notes that it was moved unseen since the frame before; its rows are `below` (3,) the horizon."""
        near, middle, _ = (self.columns - self.previous_columns) / below
        self.turned += abs(float(middle - near))

    def move_rows(self, old: Rows, new: Rows) -> None:
        """Tells the state at other rows."""
        matrix = old.mapped_to(new)
        state, covariance = self.kalman.x, self.kalman.P
        for i in (0, 3):
            state[i : i + 3] = matrix @ state[i : i + 3]
            for j in (0, 3):
                covariance[i : i + 3, j : j + 3] = matrix @ covariance[i : i + 3, j : j + 3] @ matrix.T
