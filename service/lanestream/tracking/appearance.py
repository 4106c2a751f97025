"""What a boundary is and how it is painted, accumulated over the frames of a track.

Each of kind, type and color is a hidden state that may change: a Markov chain in continuous time, filtered as in L. R.
Rabiner, "A tutorial on hidden Markov models and selected applications in speech recognition" (1989), section III.
At a constant rate the state is drawn anew, all values being equally likely. So a boundary that is not seen is slowly
forgotten, and one that changes is followed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from lanestream.road.appearance import MARKING_COLORS, MARKING_TYPES, Appearance

# How often each is drawn anew, per second. Types change every few hundred meters of a road, kinds rarely.
_KIND_RATE, _TYPE_RATE, _COLOR_RATE = 0.03, 0.15, 0.05
# What misleads a network in one frame, such as a worn stripe or a shadow, misleads it in the next ones, too. So a frame
# soon after another one brings little that is new, and its probabilities are raised to a power below 1. That is
# 1 - exp(-t / _CORRELATED_S) after t seconds: 0.12 at 25 frames per second, and 1 if the last frame was long ago.
_CORRELATED_S: Final = 0.3
# However sure a network is, it is wrong in about so many of its answers.
_LEAST: Final = 0.01


def accumulated(past: Appearance, seen: Appearance, seconds: float, paint: float) -> Appearance:
    """Returns what a boundary is after a detection that looks like `seen`, `seconds` after the last one.

    Of a new boundary that is infinity. `paint`, 0 to 1, is how much of a marking the detection showed. Without paint it
    says nothing of type and color, and little if it looks like a road edge. One without types changes only the kind.
    """
    known = forgotten(past, seconds)
    power = -math.expm1(-seconds / _CORRELATED_S)
    road_edge, _ = _updated((known.road_edge, 1.0 - known.road_edge), (seen.road_edge, 1.0 - seen.road_edge), power)
    if seen.types is None or seen.colors is None:
        return replace(known, road_edge=road_edge)
    power *= paint * (1.0 - seen.road_edge)
    types = _updated(known.types or _equal(len(MARKING_TYPES)), seen.types, power)
    colors = _updated(known.colors or _equal(len(MARKING_COLORS)), seen.colors, power)
    return Appearance(road_edge, types, colors)


def forgotten(past: Appearance, seconds: float) -> Appearance:
    """Returns what is still known of a boundary that was last detected `seconds` ago."""
    if seconds == 0.0:
        return past
    road_edge, _ = _redrawn((past.road_edge, 1.0 - past.road_edge), _KIND_RATE * seconds)
    types = None if past.types is None else _redrawn(past.types, _TYPE_RATE * seconds)
    colors = None if past.colors is None else _redrawn(past.colors, _COLOR_RATE * seconds)
    return Appearance(road_edge, types, colors)


def as_saved(appearance: Appearance) -> Appearance:
    """Returns the appearance rounded as it is saved: types and colors in half precision, the kind in single."""
    types, colors = appearance.types, appearance.colors
    return Appearance(
        float(np.float32(appearance.road_edge)),
        None if types is None else tuple(np.array(types, np.float16).tolist()),
        None if colors is None else tuple(np.array(colors, np.float16).tolist()),
    )


def _updated(prior: Sequence[float], seen: Sequence[float], power: float) -> tuple[float, ...]:
    """Bayes' rule: the values of the `prior` times those `seen`, which are raised to a power, with the sum 1."""
    products = [p * max(q, _LEAST) ** power for p, q in zip(prior, seen, strict=True)]
    total = sum(products)
    return tuple(product / total for product in products)


def _redrawn(probabilities: Sequence[float], expected: float) -> tuple[float, ...]:
    """Returns the probabilities after a time in which the state is drawn anew `expected` times on average."""
    kept = math.exp(-expected)
    return tuple(kept * p + (1.0 - kept) / len(probabilities) for p in probabilities)


def _equal(number: int) -> tuple[float, ...]:
    return (1.0 / number,) * number
