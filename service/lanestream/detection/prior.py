"""A glance at the whole road before lines are looked for: where the regressor sees the ego lane."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from lanestream.detection import Network, Question, Steps
from lanestream.detection.regression import RegressionDetector, RoadReading
from lanestream.geometry import RoadView
from lanestream.lanes import Curve, Image

# A boundary whose place is known no better than this, in image widths, leads nowhere: a network that says so has seen
# a road unlike those it knows.
_MOST_DOUBT: Final = 0.1

# A horizon farther than this from where it was taken to be, in depths, is worth a second look at the right place.
_SECOND_LOOK: Final = 0.03


@dataclass(frozen=True)
class RoadPrior:
    """What was seen at a glance: the road view with its horizon, and the ego boundaries, None where there is none.

    All in image pixels; the curves share the view's horizon.
    """

    view: RoadView
    left: Curve | None
    right: Curve | None

    @property
    def curves(self) -> tuple[Curve, ...]:
        """The boundaries that were seen, left to right."""
        return tuple(curve for curve in (self.left, self.right) if curve is not None)


@dataclass(frozen=True)
class RoadGlance:
    """The regressor as a source of priors: `detector` makes its input, `network` answers."""

    detector: RegressionDetector
    network: Network

    def look(self, image: Image, horizon: float | None = None) -> Steps[RoadPrior]:
        """The prior for a BGR image (H, W, 3); `horizon` is about its row, where known."""
        reading, seen = yield from self._reading(image, horizon)
        if abs(reading.horizon) > _SECOND_LOOK:
            reading, seen = yield from self._reading(image, seen.horizon)
        left, right = (reading.curve(side, seen) if self._is_known(reading, side) else None for side in (0, 1))
        return RoadPrior(seen, left, right)

    def _is_known(self, reading: RoadReading, side: int) -> bool:
        is_there = reading.presence[side] >= self.detector.threshold
        return bool(is_there and reading.deviations[side].mean() <= _MOST_DOUBT)

    def _reading(self, image: Image, horizon: float | None) -> Steps[tuple[RoadReading, RoadView]]:
        prepared = self.detector.prepare(image, horizon)
        return self.detector.read(prepared, (yield Question(self.network, prepared.inputs)))
