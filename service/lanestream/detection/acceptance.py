"""Acceptance: which of the boundaries that were found in a frame are reported, and how probable they are.

A classifier is more certain of the best of many candidates than it should be. How often its decisions are right is
another function of their odds for the boundaries of the ego lane than for those beyond it, and again another one for
those beside a lane with two certain markings, where more lanes are usual. All are fitted by logistic regression
(J. Platt, "Probabilistic outputs for support vector machines", 1999).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from lanestream.road.appearance import BoundaryKind
from lanestream.road.results import Detection
from lanestream.road.view import RoadView

# The road ends at its edge: what lies beyond one has this share of its odds. It is usually the far side of a sidewalk,
# a fence or a row of parked vehicles.
_BEYOND_EDGE: Final = 0.03
# A lane between two markings with at least this probability is certain.
_CERTAIN: Final = 0.98
_SIDES: Final = 2


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
    """Accepts detections of the ego lane's boundaries and of `outer` ones, those beyond them.

    `beside_lane` are outer boundaries beside a certain lane, see `is_certain_lane`: such a road has more lanes.
    """

    ego: Reliability = Reliability()
    outer: Reliability = Reliability()
    beside_lane: Reliability = Reliability()

    def accepted(
        self, detections: Sequence[Detection], tracked: Sequence[bool], view: RoadView, threshold: float
    ) -> tuple[Detection, ...]:
        """Returns the boundaries among `detections` with the probabilities of being right, from left to right.

        The probability that was decided on for each must reach `threshold`, even if edges of the road lie between it
        and the camera. That suffices for those that are `tracked`: what was there a frame ago is likely still there.
        """
        places = [float(each.curve.x(view.bottom)) - view.middle for each in detections]
        outwards = sorted(range(len(detections)), key=lambda i: abs(places[i]))
        sides = [i for i in outwards if places[i] < 0.0], [i for i in outwards if places[i] >= 0.0]
        decided = {i: probability for side in sides for i, probability in _decided(detections, side)}
        kept: dict[int, Detection] = {}

        def keep(i: int, reliability: Reliability) -> bool:
            probability = reliability.probability(decided[i])
            if decided[i] < threshold or not (tracked[i] or probability >= reliability.least):
                return False
            kept[i] = replace(detections[i], probability=probability)
            return True

        ego = [next((i for i in side if keep(i, self.ego)), None) for side in sides]
        certain = is_certain_lane([(detections[i].appearance.kind, decided[i]) for i in ego if i is not None])
        for side, nearest in zip(sides, ego, strict=True):
            beyond = [] if nearest is None else side[side.index(nearest) + 1 :]
            for i in beyond:
                keep(i, self.beside_lane if certain else self.outer)
        return tuple(kept[i] for i in sorted(kept, key=places.__getitem__))


# Of the shipped networks, and close for others that are trained like them. tools/reliability.py prints slopes and
# offsets. An invented outer boundary is worse than a missing one, so these must be more probable.
SHIPPED: Final = Acceptance(
    ego=Reliability(0.84, -1.4, least=0.4),
    outer=Reliability(0.88, -1.35, least=0.65),
    beside_lane=Reliability(0.79, -0.56, least=0.5),
)


def is_certain_lane(ego: Sequence[tuple[BoundaryKind, float]]) -> bool:
    """Whether the kinds and the decided probabilities of the ego boundaries are those of two certain markings."""
    return len(ego) == _SIDES and all(kind == "marking" and decided >= _CERTAIN for kind, decided in ego)


def _decided(detections: Sequence[Detection], side: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Yields the indices of a `side`, outwards, with their probabilities after the edges of the road before them."""
    reached = 1.0
    for i in side:
        decided = _with_odds(detections[i].probability, reached + (1.0 - reached) * _BEYOND_EDGE)
        yield i, decided
        reached *= 1.0 - decided * detections[i].appearance.road_edge


def _with_odds(probability: float, factor: float) -> float:
    """Returns the probability after its odds change by `factor`; one that does not change remains exact."""
    return probability if factor == 1.0 else probability * factor / (1.0 - probability + probability * factor)
