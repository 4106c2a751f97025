"""A glance at the whole road before lines are looked for: where the regressor sees the ego lane, and how surely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.detection import Network, Question, Steps
from lanestream.detection.curve_fit import Fit
from lanestream.detection.lattice import USUAL_WIDTH, LaneSpacing
from lanestream.detection.regression_detector import ANCHORS, RegressionDetector, RegressorOutput
from lanestream.road.curve import Curve, FloatArray, curve_columns
from lanestream.road.view import Image, RoadView

# A boundary whose place is known no better than this, in image widths, leads nowhere: a network that says so has seen
# a road unlike those it knows.
_MOST_DOUBT: Final = 0.1

# A horizon farther than this from where it was taken to be, in depths, is worth a second look at the right place.
_SECOND_LOOK: Final = 0.03

# The shares of the depth at which places are compared: farther away all lines of a road are near one another.
_COMPARED: Final = np.array(ANCHORS[:2])

# No line is told more exactly than this, in rows below the horizon.
_EXACT: Final = 0.02

# What is nearer than this to a boundary that is followed, across it, in rows below the horizon, is that boundary.
_FOLLOWED: Final = 0.05

# How many times likelier a line is a boundary where it is a whole lane beside the ego lane, and the share of that where
# it is far from such places: the feet of walls and the edges of the pavement run there, and hardly a boundary.
_REPEATED: Final = 1.5
_OFF_LATTICE: Final = 0.05


@dataclass(frozen=True)
class PriorBoundary:
    """An ego boundary that was seen at a glance.

    `curve` is in image pixels; `spread` (2,) are its standard deviations at the compared rows, in rows below the
    horizon; `presence` is the chance that it is there at all. `painted` is the curve moved onto the paint beneath
    it, where that was looked for.
    """

    curve: Curve
    spread: FloatArray
    presence: float
    painted: Curve | None = None


@dataclass(frozen=True)
class EgoPrior:
    """What was seen at a glance: the road view with its horizon, and the ego boundaries, None where there is none.

    All in image pixels; the curves share the view's horizon.
    """

    view: RoadView
    left: PriorBoundary | None
    right: PriorBoundary | None

    @property
    def seen(self) -> tuple[PriorBoundary, ...]:
        """The boundaries that were seen, left to right."""
        return tuple(boundary for boundary in (self.left, self.right) if boundary is not None)

    @property
    def curves(self) -> tuple[Curve, ...]:
        """Their curves."""
        return tuple(boundary.curve for boundary in self.seen)

    @property
    def painted(self) -> tuple[Curve, ...]:
        """Their curves on the paint, of those for which it was looked for."""
        return tuple(boundary.painted for boundary in self.seen if boundary.painted is not None)

    def odds(self, curves: Sequence[Curve]) -> FloatArray:
        """How many times likelier (N,) `curves` are boundaries because of where they run: 1 where that tells nothing.

        Elsewhere on a road there is a boundary every lane width, rather whole lanes away than between. The ego lane has
        one where each of its own was seen, give or take the spread with the heavy tail of Student's t of three degrees,
        and none between them.
        """
        below = _COMPARED * self.view.depth
        rows = self.view.horizon + below
        places = curve_columns(curves, rows) / below
        away = [(places - boundary.curve.x(rows) / below) / boundary.spread for boundary in self.seen]
        odds = np.ones(len(curves))
        if len(away) == 2:
            within = np.minimum(away[0].mean(axis=1), -away[1].mean(axis=1))
            left, right = (float((boundary.curve.x(rows) / below).mean()) for boundary in self.seen)
            lattice = LaneSpacing(left, right, least=_OFF_LATTICE)
            odds = _REPEATED * lattice.trust(places.mean(axis=1)) / (1.0 + np.exp(within.clip(-30.0, 30.0)))
        for boundary, off in zip(self.seen, away, strict=True):
            density = 2.0 / (np.pi * np.sqrt(3.0)) / (1.0 + (off**2).mean(axis=1) / 3.0) ** 2 / boundary.spread.mean()
            odds += boundary.presence * USUAL_WIDTH * density
        return odds


@dataclass(frozen=True)
class EgoPriorEstimator:
    """The regressor as a source of priors: `detector` makes its input, `network` answers."""

    detector: RegressionDetector
    network: Network

    def look(self, image: Image, horizon: float | None = None, followed: Sequence[Curve] = ()) -> Steps[EgoPrior]:
        """The prior for a BGR image (H, W, 3); `horizon` is about its row, where known.

        Beneath boundaries that are `followed` already, curves in image pixels, no paint is looked for.
        """
        reading, seen = yield from self._reading(image, horizon)
        if abs(reading.horizon) > _SECOND_LOOK:
            reading, seen = yield from self._reading(image, seen.horizon)
        new = [side for side in (0, 1) if not _is_followed(reading.curve(side, seen), followed, seen)]
        fits, _ = self.detector.fitted(image, reading, seen, new)
        left, right = (self._seen(reading, side, seen, fits.get(side)) for side in (0, 1))
        return EgoPrior(seen, left, right)

    def _seen(self, reading: RegressorOutput, side: int, view: RoadView, fit: Fit | None) -> PriorBoundary | None:
        presence = float(reading.presence[side])
        if presence < self.detector.threshold or reading.deviations[side].mean() > _MOST_DOUBT:
            return None
        curve = reading.curve(side, view)
        spread = np.hypot(reading.deviations[side, : len(_COMPARED)] * view.width / (_COMPARED * view.depth), _EXACT)
        return PriorBoundary(curve, spread, presence, None if fit is None else fit.curve)

    def _reading(self, image: Image, horizon: float | None) -> Steps[tuple[RegressorOutput, RoadView]]:
        prepared = self.detector.prepare(image, horizon)
        return self.detector.read(prepared, (yield Question(self.network, prepared.inputs)))


def _is_followed(curve: Curve, followed: Sequence[Curve], view: RoadView) -> bool:
    """Whether it runs where one of the `followed` curves does."""
    below = _COMPARED * view.depth
    rows = view.horizon + below
    near = _FOLLOWED * below * np.hypot(1.0, curve.slope(rows))
    return any(bool((np.abs(other.x(rows) - curve.x(rows)) < near).all()) for other in followed)
