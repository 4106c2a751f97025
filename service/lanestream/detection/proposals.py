"""Candidates: the possible boundaries of one frame, from edges to a short list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lanestream.detection.ego_prior import EgoPrior
from lanestream.detection.fan import Fan
from lanestream.detection.features import WORKING_WIDTH, find_edges, paint_grey, resized
from lanestream.detection.hough import ExtendedHough, HoughLines
from lanestream.detection.lattice import LaneSpacing
from lanestream.detection.lines import FAR, NEAR, Lines, told_rows
from lanestream.detection.marking_filter import Ridges, RidgeSearch
from lanestream.detection.perspective import Perspective, PerspectiveSearch
from lanestream.detection.vanishing_point import VanishingPointSearch
from lanestream.road.curve import Curve, FloatArray
from lanestream.road.results import Candidate
from lanestream.road.view import Image, RoadView, Scaling, visible_spans

# Candidates reach from the bottom up to this share of the depth below the horizon. Nearer to the horizon a lane is a
# few pixels wide and every line looks like every other.
TOP_SHARE = 0.1

# Below this share of the height a horizon leaves no road to look at.
LOWEST_HORIZON = 0.9

Source = Literal["pairs", "singles", "rays"]


@dataclass(frozen=True)
class Proposals:
    """The candidates of a frame in image pixels, best first, the road view they were found in, and its evidence.

    `weight` (0 to 1) tells how much the frame had to say about where its horizon is.
    """

    candidates: tuple[Candidate, ...]
    view: RoadView
    weight: float


@dataclass(frozen=True)
class Survey:
    """What a frame shows before anything is known of its road: the working image, and where a horizon is known, lines.

    `grey` (H, W) is the image at the working size of `scaling`; `lines` are the Hough lines below the horizon.
    """

    grey: Image
    scaling: Scaling
    lines: HoughLines | None


@dataclass(frozen=True)
class Evidence:
    """What a frame shows of its road: Hough lines and ridges of the working image."""

    lines: HoughLines
    ridges: Ridges


@dataclass(frozen=True)
class CandidateSearch:
    """How candidates are found: Hough lines and their pairs, lines of the fan, then suppression.

    Lines come from `sources`: pairs of Hough edges that bound a marking, single ones, and rays of the fan.
    `perspective` looks for the road's perspective around a guess, `near_prior` around what a prior says of it. `limit`
    is the most candidates of a frame, `followed` of one in which boundaries are expected: those come first, so that
    fewer are needed. Two edges are one marking where their distance is `least_width` to `most_width` times the rows
    below the horizon (markings of 0.10 to 0.30 m seen from 1.2 to 2.2 m, with room for double lines). Candidates nearer
    than `separation` times the rows below the horizon, at two rows, are the same. Where there is a prior but no known
    horizon, lines found without the prior count `unguided` times their strength. Lines fainter than `faintest`, where
    the strongest of their kind has 1, are hardly ever boundaries, and are no candidates. Where no boundaries are
    expected, a line that follows one of the prior's, but not as near as `twin`, is a candidate beside it: either may be
    the more exact one.
    """

    hough: ExtendedHough = ExtendedHough()
    vanishing: VanishingPointSearch = VanishingPointSearch()
    ridges: RidgeSearch = RidgeSearch()
    perspective: PerspectiveSearch = PerspectiveSearch()
    sources: tuple[Source, ...] = ("pairs", "singles", "rays")
    near_prior: PerspectiveSearch = PerspectiveSearch(
        spread_x=0.03, nod=0.01, spread_bend=0.015, ridges=300, rounds=((3, 0.7), (3, 0.35), (3, 0.12))
    )
    fan: Fan = Fan()
    limit: int = 16
    followed: int = 12
    least_width: float = 0.03
    most_width: float = 0.4
    separation: float = 0.05
    unguided: float = 0.6
    faintest: float = 0.06
    twin: float = 0.02

    def survey(self, image: Image, horizon: float | None = None) -> Survey:
        """What can be seen of a BGR image (H, W, 3) uint8 before there is a prior; `horizon` as for `propose`."""
        scaling = Scaling(WORKING_WIDTH / image.shape[1])
        grey = paint_grey(resized(image, scaling))
        if horizon is None:
            return Survey(grey, scaling, None)
        top = min(scaling.to_working(horizon), LOWEST_HORIZON * len(grey))
        return Survey(grey, scaling, self._edges_and_lines(grey, top))

    def propose(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        prior: EgoPrior | None = None,
        survey: Survey | None = None,
    ) -> Proposals:
        """The candidates of a BGR image (H, W, 3) uint8; `horizon` is about its row, where that is known.

        `survey` is the image's, with the same horizon, where that was made before. `expected` are boundaries that the
        last frames had. They are candidates before all others: what is still there need not be found anew. A `prior`
        that saw a boundary gives the perspective, candidates of its own, as it saw them and on the paint, those of the
        next lanes, and an order for the rest; one that saw none tells the horizon at most. Of a frame whose horizon is
        unknown the prior is trusted less: what is found without it is proposed too.
        """
        height, width = image.shape[:2]
        survey = survey or self.survey(image, horizon)
        grey, scaling = survey.grey, survey.scaling
        guide = prior if prior is not None and prior.curves else None
        if guide is None:
            # A glance that sees no boundary in the dark, or in a sharp bend, still sees where the road ends.
            row = horizon if prior is None or horizon is None else prior.view.horizon
            point, seen = self._road(grey, None if row is None else scaling.to_working(row), survey.lines)
        else:
            point, seen = self._seen_road(survey, guide)
        view = RoadView(grey.shape[1], grey.shape[0], point.y)
        known = Lines.along(expected, scaling, view)
        found = [self._found(seen, view, point)]
        guides, painted, neighbours = Lines.joined([]), Lines.joined([]), Lines.joined([])
        if guide is not None:
            lattice = _lattice(guide, scaling, view, point)
            found = [found[0].weighed(lattice.trust(_slopes(found[0], view, point)))]
            if horizon is None:
                found.append(self._unguided(grey, scaling, view))
            guides, painted = (Lines.along(curves, scaling, view) for curves in (guide.curves, guide.painted))
            neighbours = _neighbours(lattice, view, point)
        strong = Lines.joined(found).strong(self.faintest).ranked
        kept = self._kept(known, [guides, neighbours], painted, strong, view)
        image_view = RoadView(width, height, scaling.to_image(point.y))
        candidates = _candidates(kept, _curves(kept, scaling, view, point), image_view)
        limit = min(self.limit, self.followed) if expected else self.limit
        return Proposals(tuple(candidates[:limit]), image_view, point.weight)

    def _seen_road(self, survey: Survey, prior: EgoPrior) -> tuple[Perspective, Evidence]:
        """The perspective of a prior, moved to where ridges gather, and what is seen of the road below its horizon."""
        height, width = survey.grey.shape
        guess = _perspective(prior, survey.scaling, height)
        ridges = self.ridges.find(survey.grey, guess)
        point = self.near_prior.refine(guess, ridges, width, height - 1.0, known=True)
        return point, Evidence(survey.lines or self._edges_and_lines(survey.grey, point.y), ridges)

    def _road(
        self, grey: Image, horizon: float | None, lines: HoughLines | None = None
    ) -> tuple[Perspective, Evidence]:
        """The perspective of the working image and what is seen of its road; its Hough lines may be known already."""
        height, width = grey.shape
        lowest = LOWEST_HORIZON * height
        horizon = None if horizon is None else min(horizon, lowest)
        lines = lines or self._edges_and_lines(grey, 0.42 * height if horizon is None else horizon)
        first = self.vanishing.find(lines, width, height, horizon)
        guess = Perspective(first.x, first.y, 0.0, first.weight)
        ridges = self.ridges.find(grey, guess)
        point = self.perspective.refine(guess, ridges, width, height - 1.0, horizon is not None)
        return replace(point, y=min(point.y, lowest)), Evidence(lines, ridges)

    def _edges_and_lines(self, grey: Image, top: float) -> HoughLines:
        """The Hough lines of the rows from `top` down."""
        height, width = grey.shape
        return self.hough.lines(find_edges(grey, int(np.clip(top, 0, height - 16))), width, height - 1.0)

    def _found(self, seen: Evidence, view: RoadView, point: Perspective) -> Lines:
        """Lines of both searches: each one's strengths count against its own strongest."""
        hough = [
            *([self._pairs(seen.lines, view, point)] if "pairs" in self.sources else ()),
            *([self._singles(seen.lines, view, point)] if "singles" in self.sources else ()),
        ]
        rays = [self._rays(seen.ridges, view, point).normalised] if "rays" in self.sources else []
        return Lines.joined([Lines.joined(hough).normalised, *rays])

    def _unguided(self, grey: Image, scaling: Scaling, view: RoadView) -> Lines:
        """What the search finds without its prior, which of a frame of which nothing is known may be wrong.

        The lines keep their own perspective, and count for less than guided ones.
        """
        point, seen = self._road(grey, None)
        own = RoadView(view.width, view.height, point.y)
        found = self._found(seen, own, point)
        weights = self.unguided * found.strength
        return Lines.along(_curves(found, scaling, own, point), scaling, view).weighed(weights)

    def _kept(self, known: Lines, led: Sequence[Lines], painted: Lines, found: Lines, view: RoadView) -> Lines:
        """All lines that keep their distance from those before them, and beside the guides what may be more exact.

        Those that a prior `led` to are the guides, its own boundaries, and others. Beside the guides are themselves as
        `painted`, unless that is where a `known` one runs, and, where none are known, their twins: the first of the
        `found` lines that is beside a guide, as `twin` says.
        """
        ranked = Lines.joined([known, *led, found])
        places = ranked.apart(self.separation, view)
        beside = [painted.taken(np.flatnonzero(~painted.follow(known, self.separation, view).any(axis=1)))]
        if not len(known.near) and len(found.near):
            near = led[0].follow(found, self.separation, view) & ~led[0].follow(found, self.twin, view)
            beside.append(found.taken(np.unique(near.argmax(axis=1)[near.any(axis=1)])))
        first = places < sum(len(lines.near) for lines in (known, *led))
        return Lines.joined([ranked.taken(places[first]), *beside, ranked.taken(places[~first])])

    def _rays(self, ridges: Ridges, view: RoadView, point: Perspective) -> Lines:
        """Lines through the vanishing point along which ridges gather."""
        found = self.fan.lines(ridges, point, view.width, view.bottom)
        near, far = point.columns(found.slope, told_rows(view), view.bottom)
        return Lines.told(near, far, found.strength)

    def _pairs(self, lines: HoughLines, view: RoadView, point: Perspective) -> Lines:
        """Rising and falling edges that bound one bright marking; the line handed on runs between them."""
        near, far = _columns(lines, view)
        rising, falling = np.flatnonzero(lines.rising), np.flatnonzero(~lines.rising)
        width = (near[None, falling] - near[rising, None]) / view.depth
        width_far = (far[None, falling] - far[rising, None]) / (FAR * view.depth)
        fits = (width >= self.least_width) & (width <= self.most_width) & (np.abs(width - width_far) <= 0.12)
        i, j = np.nonzero(fits)
        a, b = rising[i], falling[j]
        between = 0.5 * (near[a] + near[b]), 0.5 * (far[a] + far[b])
        # Paint is narrow: pairs wider than a single marking count less, down to a half for a double line.
        narrow = np.clip(1.3 - 2.0 * width[i, j], 0.5, 1.0)
        strength = 2.0 * np.sqrt(lines.votes[a] * lines.votes[b]) * narrow * _aimed(*between, view, point)
        return Lines.told(*between, strength)

    def _singles(self, lines: HoughLines, view: RoadView, point: Perspective) -> Lines:
        """Unpaired edges, second class: a worn marking, a road edge, one side of a wide band."""
        near, far = _columns(lines, view)
        return Lines.told(near, far, 0.6 * lines.votes * _aimed(near, far, view, point))


def _columns(lines: HoughLines, view: RoadView) -> tuple[FloatArray, FloatArray]:
    """Columns of Hough lines at the near and the far row."""
    return lines.x_bottom, lines.x_bottom - (NEAR - FAR) * view.depth * lines.slope


def _aimed(near: FloatArray, far: FloatArray, view: RoadView, point: Perspective) -> FloatArray:
    """How well lines keep to the shared perspective, from 1 down to 0.2: boundaries of one road share it."""
    k = point.k(view.bottom)
    slope = (near - point.x - k / view.depth) / view.depth
    expected = point.columns(slope, told_rows(view), view.bottom)[1]
    miss = np.abs(far - expected) / np.hypot(1.0, slope)
    aimed: FloatArray = 0.2 + 0.8 / (1.0 + (miss / (0.02 * view.width)) ** 2)
    return aimed


def _perspective(prior: EgoPrior, scaling: Scaling, height: int) -> Perspective:
    """What the boundaries of a prior share, in the working image, which is `height` rows high."""
    curves = [scaling.curve_to_working(curve) for curve in prior.curves]
    horizon = curves[0].horizon
    v, k = (float(np.mean([curve.coefficients[i] for curve in curves])) for i in (0, 2))
    return Perspective(v, horizon, k / (height - 1.0 - horizon) ** 2, 1.0)


def _lattice(prior: EgoPrior, scaling: Scaling, view: RoadView, point: Perspective) -> LaneSpacing:
    slopes = iter(_slopes(Lines.along(prior.curves, scaling, view), view, point).tolist())
    left, right = (None if boundary is None else next(slopes) for boundary in (prior.left, prior.right))
    return LaneSpacing.of(left, right)


def _slopes(lines: Lines, view: RoadView, point: Perspective) -> FloatArray:
    """Where lines cross the bottom row, from the vanishing point, in depths."""
    return (lines.near - point.x) / view.depth


def _neighbours(lattice: LaneSpacing, view: RoadView, point: Perspective) -> Lines:
    """Lines where the boundaries of the next lanes should be."""
    near, far = point.columns(np.array(lattice.neighbours) - point.bend, told_rows(view), view.bottom)
    return Lines.told(near, far, np.ones(len(near)))


def _curves(lines: Lines, scaling: Scaling, view: RoadView, point: Perspective) -> list[Curve]:
    """The lines' curves in image pixels; those known by two columns have the bend that all boundaries share."""
    k = point.k(view.bottom)
    u_near, u_far = NEAR * view.depth, FAR * view.depth
    b = ((lines.near - k / u_near) - (lines.far - k / u_far)) / (u_near - u_far)
    v = lines.near - k / u_near - b * u_near
    return [
        curve or scaling.curve_to_image(Curve(view.horizon, (v, b, k)))
        for curve, v, b in zip(lines.curves, v.tolist(), b.tolist(), strict=True)
    ]


def _candidates(lines: Lines, curves: Sequence[Curve], view: RoadView) -> list[Candidate]:
    """Candidates of the lines that are in view for long enough."""
    spans = visible_spans(curves, view, TOP_SHARE)
    return [
        Candidate(curve, *span, strength)
        for curve, span, strength in zip(curves, spans, lines.strength.tolist(), strict=True)
        if span is not None and span[1] - span[0] >= 0.15 * view.depth
    ]
