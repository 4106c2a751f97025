"""Proposals: the candidates of a frame, from lines through the vanishing point, the ego-lane prior and the tracker."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.ego_prior import EgoPrior
from lanestream.detection.features import Channels, find_edges
from lanestream.detection.hough import HoughLines, hough_curves, hough_lines
from lanestream.detection.interface import FrameContext
from lanestream.detection.marking_filter import Ridges, find_ridges, find_steps
from lanestream.detection.vanishing_point import (
    KNOWN_HORIZON,
    NEAR_PRIOR,
    WIDE,
    find_lines,
    find_step_lines,
    refine,
    vote_of_lines,
)
from lanestream.road.curve import Curves, FloatArray, VanishingPoint
from lanestream.road.view import RoadView, Spans, visible_spans

# The most candidates of a frame, and of one in which boundaries are tracked: those come early, so fewer are needed.
MOST_CANDIDATES: Final = 16
MOST_WITH_TRACKS: Final = 12
# Some of them are lines along steps between surfaces, with at least this strength: one in so many, and at most this
# number in a frame in which boundaries are tracked.
_LEAST_STEPS: Final = 0.1
_PER_STEP: Final = 4
_MOST_STEPS_WITH_TRACKS: Final = 2

# Candidates closer than this, in row offsets, at both rows of _COMPARED (shares of the depth) are duplicates.
_SEPARATION: Final = 0.05
_COMPARED: Final = np.array([1.0, 0.45])
# A step this close to a bright line, in row offsets, is the side of a marking.
_SIDE: Final = 0.12
# Lines weaker than this, relative to the strongest one, are hardly ever boundaries.
_LEAST_STRENGTH: Final = 0.06
# Lines far from the positions of the lane-spacing model keep this share of their strength.
_UNSPACED_SHARE: Final = 0.3
# A candidate is visible over at least this share of the depth. The far edge of a wide road is nearly level in the
# image, so the length of such a line counts, whatever number of rows it crosses.
_SHORTEST: Final = 0.15
# A horizon below the first share of the height leaves no road to search. If the horizon is unknown, edges are used from
# the second share down.
_LOWEST_HORIZON: Final = 0.9
_HIGHEST_ROAD: Final = 0.42


@dataclass(frozen=True)
class Proposals:
    """The candidates of a frame, best first, in pixels of the working image with these `channels`.

    All `curves` (N) share the horizon of `view` and are visible within `spans`. `horizon_weight` (0 to 1) is how much
    the frame reveals about its horizon; `prior` is the ego-lane prior that guided the search, and `tracked` are the
    boundaries of the last frame, if any.
    """

    channels: Channels
    curves: Curves
    spans: Spans
    view: RoadView
    horizon_weight: float
    prior: EgoPrior | None
    tracked: Curves | None = None


def propose(
    channels: Channels,
    context: FrameContext,
    prior: EgoPrior | None,
    fitted: Curves | None,
    limit: int = MOST_CANDIDATES,
) -> Proposals:
    """Returns the candidates of a working image (H, 640).

    The boundaries of the `prior` and the next lanes beside them come first, then tracked boundaries, the prior's
    boundaries after a fit to the image (`fitted`), and the bright lines found in the image, strongest first; then lines
    along steps between surfaces.
    """
    height, width = channels.paint.shape
    road = _search_road(channels, context, prior)
    point = road.point
    view = RoadView(width, height, point.y)
    lines = find_lines(road.ridges, point, width)
    found, strength = point.curves(lines.positions), _normalized(lines.strength)
    tracked = (context.tracked or Curves.none(point.y)).below(point.y, view.bottom)
    leading = []
    if prior is not None and prior.sides:
        own = prior.curves.below(point.y, view.bottom)
        bottom = np.array([view.bottom])
        spacing = prior.spacing(point.positions(own.x(bottom)[:, 0], bottom), _UNSPACED_SHARE)
        strength = strength * spacing.weight(lines.positions)
        leading = [own, point.curves(spacing.neighbors)]
    # A tracked boundary is where it was a frame ago, so it comes after what this frame shows.
    leading.append(tracked)
    if road.hough is not None:
        curves, votes = hough_curves(road.hough, point, view)
        found = Curves.concatenate([found, curves])
        strength = np.concatenate([strength, _normalized(votes)])
    order = np.argsort(-strength, kind="stable")
    found = found.take(order[strength[order] >= _LEAST_STRENGTH])
    ranked = Curves.concatenate([*leading, found])
    chosen = non_maximum_suppression(are_duplicates(ranked, ranked, view))
    first = chosen < sum(len(curves) for curves in leading)
    fitted = (fitted or Curves.none(point.y)).below(point.y, view.bottom)
    fitted = fitted.take(np.flatnonzero(~are_duplicates(fitted, tracked, view).any(axis=1)))
    bright = Curves.concatenate([ranked.take(chosen[first]), fitted, ranked.take(chosen[~first])])
    steps, most_steps = Curves.none(point.y), 0
    if road.steps is not None:
        step_lines = find_step_lines(road.steps, point, width)
        steps = point.curves(step_lines.positions[step_lines.strength >= _LEAST_STEPS])
        most_steps = _MOST_STEPS_WITH_TRACKS if len(tracked) else limit // _PER_STEP
    every = Curves.concatenate([bright, steps])
    spans = visible_spans(every, view)
    is_tall = spans.visible & (spans.bottom - spans.top >= _SHORTEST * view.depth)
    was_tracked = np.zeros(len(every), bool)
    was_tracked[: len(chosen[first])] = chosen[first] >= sum(len(curves) for curves in leading) - len(tracked)
    usable = np.flatnonzero((is_tall | (was_tracked & is_long(every, spans, view)))[: len(bright)])
    limit = MOST_WITH_TRACKS if len(tracked) else limit
    strongest, others = usable[: limit - most_steps], usable[limit - most_steps :]
    along = len(bright) + np.flatnonzero(is_long(steps, spans.take(slice(len(bright), None)), view))
    steps, lines_before = every.take(along), every.take(strongest)
    is_known = are_duplicates(steps, lines_before, view) | _are_sides(steps, lines_before, view)
    along = along[np.flatnonzero(~is_known.any(axis=1))[:most_steps]]
    kept = np.concatenate([strongest, along, others[: most_steps - len(along)]])
    return Proposals(channels, every.take(kept), spans.take(kept), view, point.weight, prior, context.tracked)


def is_long(curves: Curves, spans: Spans, view: RoadView) -> NDArray[np.bool_]:
    """Returns which curves (N,) are long enough, within their visible `spans`, for the edge of a road."""
    ends = curves.x(np.stack([spans.top, spans.bottom], axis=1))
    length = np.hypot(spans.bottom - spans.top, ends[:, 1] - ends[:, 0])
    return np.asarray(spans.visible & (length >= _SHORTEST * view.depth))


@dataclass(frozen=True)
class _Road:
    """The vanishing point of a frame, its ridges, its steps if it may have an edge that the ridges do not show, and its
    Hough lines if no prior led to that point.
    """

    point: VanishingPoint
    ridges: Ridges
    steps: Ridges | None = None
    hough: HoughLines | None = None


def _search_road(channels: Channels, context: FrameContext, prior: EgoPrior | None) -> _Road:
    """Returns the vanishing point, near that of the prior, or else where the lines of the edges meet."""
    height, width = channels.paint.shape
    if prior is not None and prior.sides:
        guess = prior.vanishing_point
        ridges, is_edge = find_ridges(channels.paint, guess), prior.road_edge > 0.5
        if len(prior.sides) == 2 and not is_edge.any():
            # Beyond the two markings of a lane, lines along steps show no edge that the other lines miss.
            return _Road(refine(guess, ridges, width, height - 1.0, NEAR_PRIOR), ridges)
        steps = find_steps(channels, guess)
        # Between two edges of a road without markings, ridges are noise.
        evidence = replace(steps, weight=np.abs(steps.weight)) if is_edge.all() else ridges
        return _Road(refine(guess, evidence, width, height - 1.0, NEAR_PRIOR), ridges, steps)
    horizon = context.horizon
    if horizon is not None:
        # A prior without boundaries, in the dark or in a sharp curve, still gives the horizon.
        horizon = min(horizon if prior is None else prior.view.horizon, _LOWEST_HORIZON * height)
    top = _HIGHEST_ROAD * height if horizon is None else horizon
    lines = hough_lines(find_edges(channels.paint, int(np.clip(top, 0, height - 16))), width, height - 1.0)
    guess = vote_of_lines(lines, width, height, horizon)
    ridges = find_ridges(channels.paint, guess)
    point = refine(guess, ridges, width, height - 1.0, WIDE if horizon is None else KNOWN_HORIZON)
    point = replace(point, y=min(point.y, _LOWEST_HORIZON * height))
    return _Road(point, ridges, find_steps(channels, point), lines)


def _normalized(strength: FloatArray) -> FloatArray:
    """Returns strengths relative to the strongest."""
    return strength / max(float(strength.max(initial=0.0)), 1e-9)


def are_duplicates(
    curves: Curves, others: Curves, view: RoadView, separation: float = _SEPARATION
) -> NDArray[np.bool_]:
    """Returns a mask (N, M): which of the `others` are closer to each curve than `separation` at both rows.

    `separation` is in row offsets; curves within the default follow the same marking. Oblique lines are closer to each
    other than their columns are, so distances are measured across the other line.
    """
    below = _COMPARED * view.depth
    rows = view.horizon + below
    columns = others.x(rows)
    slope = (columns[:, 0] - columns[:, 1]) / (below[0] - below[1])
    limit = separation * below * np.hypot(1.0, slope)[:, None]
    return np.asarray((np.abs(curves.x(rows)[:, None] - columns) < limit).all(axis=2))


def _are_sides(steps: Curves, bright: Curves, view: RoadView) -> NDArray[np.bool_]:
    """Returns a mask (N, M): which of the steps are the sides of the markings along the bright lines."""
    below = _COMPARED * view.depth
    rows = view.horizon + below
    return np.asarray((np.abs(steps.x(rows)[:, None] - bright.x(rows)) < _SIDE * below).all(axis=2))


def non_maximum_suppression(conflicts: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Returns the indices of the items that no better accepted item conflicts with, best first.

    `conflicts` (N, N) marks pairs that exclude each other; items are sorted from best to worst.
    """
    free = np.ones(len(conflicts), bool)
    kept = []
    for index in range(len(conflicts)):
        if free[index]:
            kept.append(index)
            free &= ~conflicts[index]
    return np.array(kept, np.intp)
