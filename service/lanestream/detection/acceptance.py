"""Acceptance: which of the boundaries that were found in a frame are reported, and how probable they are.

A classifier is more certain of the best of many candidates than it should be. How often its decisions are right is
another function of their odds for the boundaries of the ego lane than for those beyond it. Both are fitted by logistic
regression (J. Platt, "Probabilistic outputs for support vector machines", 1999).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from lanestream.road.results import Detection
from lanestream.road.view import RoadView

# The road ends at its edge: what lies beyond one has this share of its odds. It is usually the far side of a sidewalk,
# a fence or a row of parked vehicles.
_BEYOND_EDGE: Final = 0.03


@dataclass(frozen=True)
class Reliability:
    """How often decisions are right: their log odds times `slope` plus `offset` are those of being right.

    A boundary is reported from the probability `least` on.
    """

    slope: float = 1.0
    offset: float = 0.0
    least: float = 0.0

    def probability(self, decided: float) -> float:
        """Returns how probable it is that a boundary of which the probability was `decided` is one."""
        if not 0.0 < decided < 1.0:
            return decided
        return 1.0 / (1.0 + math.exp(-self.slope * math.log(decided / (1.0 - decided)) - self.offset))


@dataclass(frozen=True)
class Acceptance:
    """Accepts detections of the ego lane's boundaries and of `outer` ones, those beyond them."""

    ego: Reliability = Reliability()
    outer: Reliability = Reliability()

    def accepted(
        self, detections: Sequence[Detection], tracked: Sequence[bool], view: RoadView, threshold: float
    ) -> tuple[Detection, ...]:
        """Returns the boundaries among `detections` with the probabilities of being right, from left to right.

        The probability that was decided on for each must reach `threshold`, even if edges of the road lie between it
        and the camera. That suffices for those that are `tracked`: what was there a frame ago is likely still there.
        """
        places = [float(each.curve.x(view.bottom)) - view.middle for each in detections]
        outwards = sorted(range(len(detections)), key=lambda i: abs(places[i]))
        kept: dict[int, Detection] = {}
        for side in ([i for i in outwards if places[i] < 0.0], [i for i in outwards if places[i] >= 0.0]):
            reached, reliability = 1.0, self.ego
            for i in side:
                decided = _with_odds(detections[i].probability, reached + (1.0 - reached) * _BEYOND_EDGE)
                probability = reliability.probability(decided)
                if decided >= threshold and (tracked[i] or probability >= reliability.least):
                    kept[i] = replace(detections[i], probability=probability)
                    reliability = self.outer
                reached *= 1.0 - decided * detections[i].appearance.road_edge
        return tuple(kept[i] for i in sorted(kept, key=places.__getitem__))


# Of the shipped networks, and close for others that are trained like them. tools/reliability.py prints slopes and
# offsets. An invented outer boundary is worse than a missing one, so these must be more probable.
SHIPPED: Final = Acceptance(ego=Reliability(0.84, -1.4, least=0.4), outer=Reliability(0.88, -1.1, least=0.65))


def _with_odds(probability: float, factor: float) -> float:
    """Returns the probability after its odds change by `factor`; one that does not change remains exact."""
    return probability if factor == 1.0 else probability * factor / (1.0 - probability + probability * factor)
