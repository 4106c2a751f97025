"""Candidates: the possible boundaries of one frame, from edges to a short list."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.edges import WORKING_WIDTH, find_edges, paint_grey, resized
from lanestream.detection.fan import Fan
from lanestream.detection.hough import ExtendedHough, HoughLines
from lanestream.detection.lattice import Lattice
from lanestream.detection.perspective import Perspective, PerspectiveSearch, find_ridges
from lanestream.detection.prior import RoadPrior
from lanestream.detection.vanishing import VanishingPointSearch
from lanestream.geometry import RoadView, Scaling, visible_rows
from lanestream.lanes import Candidate, Curve, Image

# Candidates reach from the bottom up to this share of the depth below the horizon. Nearer to the horizon a lane is a
# few pixels wide and every line looks like every other.
TOP_SHARE = 0.1

# Below this share of the height a horizon leaves no road to look at.
LOWEST_HORIZON = 0.9

# The two rows, as shares of the depth, at which lines are told, compared and suppressed.
_NEAR, _FAR = 1.0, 0.45


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
class _Line:
    """A line of the working image by its columns at the near and the far row.

    `curve` is its curve in image pixels where that is known better than by the two columns.
    """

    near: float
    far: float
    strength: float
    curve: Curve | None = None


@dataclass(frozen=True)
class CandidateSearch:
    """How candidates are found: Hough lines and their pairs, lines of the fan, then suppression.

    Lines come from `sources`: pairs of Hough edges that bound a marking, single ones, and rays of the fan.
    `perspective` looks for the road's perspective around a guess, `near_prior` around what a prior says of it. `limit`
    is the most candidates of a frame. Two edges are one marking where their distance is `least_width` to `most_width`
    times the rows below the horizon (markings of 0.10 to 0.30 m seen from 1.2 to 2.2 m, with room for double lines).
    Candidates nearer than `separation` times the rows below the horizon, at two rows, are the same. Where there is a
    prior but no known horizon, lines found without the prior count `unguided` times their strength.
    """

    hough: ExtendedHough = ExtendedHough()
    vanishing: VanishingPointSearch = VanishingPointSearch()
    perspective: PerspectiveSearch = PerspectiveSearch()
    sources: tuple[Source, ...] = ("pairs", "singles", "rays")
    near_prior: PerspectiveSearch = PerspectiveSearch(spread_x=0.03, nod=0.01, spread_bend=0.015)
    fan: Fan = Fan()
    limit: int = 16
    least_width: float = 0.03
    most_width: float = 0.4
    separation: float = 0.05
    unguided: float = 0.6

    def propose(
        self,
        image: Image,
        horizon: float | None = None,
        expected: Sequence[Curve] = (),
        prior: RoadPrior | None = None,
    ) -> Proposals:
        """The candidates of a BGR image (H, W, 3) uint8; `horizon` is about its row, where that is known.

        `expected` are boundaries that the last frames had. They are candidates before all others: what is still there
        need not be found anew. A `prior` that saw a boundary gives the perspective, candidates of its own, those of
        the next lanes, and an order for the rest; one that saw none is as good as none. Of a frame whose horizon is
        unknown the prior is trusted less: what is found without it is proposed too.
        """
        height, width = image.shape[:2]
        scaling = Scaling(WORKING_WIDTH / width)
        grey = resized(paint_grey(image), scaling)
        guide = prior if prior is not None and prior.curves else None
        if guide is None:
            point, lines = self._road(grey, None if horizon is None else scaling.to_working(horizon))
        else:
            point, lines = self._seen_road(grey, guide, scaling)
        view = RoadView(grey.shape[1], grey.shape[0], point.y)
        image_view = RoadView(width, height, scaling.to_image(point.y))
        ranked = self._ranked(grey, view, point, lines)
        known = self._suppress([_known(curve, scaling, view) for curve in expected], [], view)
        if guide is not None:
            lattice = _lattice(guide, scaling, view, point)
            ranked = [_trusted(line, lattice, view, point) for line in ranked]
            if horizon is None:
                ranked += self._unguided(grey, scaling, view)
            ranked.sort(key=lambda line: -line.strength)
            seen = [_known(curve, scaling, view) for curve in guide.curves]
            known += self._suppress([*seen, *_neighbours(lattice, view, point)], known, view)
        new = self._suppress(ranked, known, view)
        found = [
            _candidate(line, line.curve or scaling.curve_to_image(_curve(line, view, point)), image_view)
            for line in [*known, *new]
        ]
        candidates = [candidate for candidate in found if candidate is not None]
        return Proposals(tuple(candidates[: self.limit]), image_view, point.weight)

    def _seen_road(self, grey: Image, prior: RoadPrior, scaling: Scaling) -> tuple[Perspective, HoughLines]:
        """The perspective of a prior, moved to where ridges gather, and the Hough lines below its horizon."""
        height, width = grey.shape
        guess = _perspective(prior, scaling, height)
        point = self.near_prior.refine(guess, find_ridges(grey, guess.y), width, height - 1.0, known=True)
        return point, self._edges_and_lines(grey, point.y)

    def _road(self, grey: Image, horizon: float | None) -> tuple[Perspective, HoughLines]:
        """The perspective of the working image and the Hough lines of its road."""
        height, width = grey.shape
        lowest = LOWEST_HORIZON * height
        horizon = None if horizon is None else min(horizon, lowest)
        top = int(horizon) if horizon is not None else int(0.42 * height)
        lines = self._edges_and_lines(grey, top)
        first = self.vanishing.find(lines, width, height, horizon)
        guess = Perspective(first.x, first.y, 0.0, first.weight)
        ridges = find_ridges(grey, guess.y)
        point = self.perspective.refine(guess, ridges, width, height - 1.0, horizon is not None)
        return replace(point, y=min(point.y, lowest)), lines

    def _edges_and_lines(self, grey: Image, top: float) -> HoughLines:
        """The Hough lines of the rows from `top` down."""
        height, width = grey.shape
        return self.hough.lines(find_edges(grey, int(np.clip(top, 0, height - 16))), width, height - 1.0)

    def _ranked(self, grey: Image, view: RoadView, point: Perspective, lines: HoughLines) -> list[_Line]:
        """Lines of both searches in one order: each list's strengths count against its own strongest."""
        hough = [
            *(self._pairs(lines, view, point) if "pairs" in self.sources else ()),
            *(self._singles(lines, view, point) if "singles" in self.sources else ()),
        ]
        rays = self._rays(grey, view, point) if "rays" in self.sources else []
        return sorted(_normalised(hough) + _normalised(rays), key=lambda line: -line.strength)

    def _unguided(self, grey: Image, scaling: Scaling, view: RoadView) -> list[_Line]:
        """What the search finds without its prior, which of a frame of which nothing is known may be wrong.

        The lines keep their own perspective, and count for less than guided ones.
        """
        point, lines = self._road(grey, None)
        own = RoadView(view.width, view.height, point.y)
        return [
            replace(
                _known(scaling.curve_to_image(_curve(line, own, point)), scaling, view),
                strength=self.unguided * line.strength,
            )
            for line in self._ranked(grey, own, point, lines)
        ]

    def _rays(self, grey: Image, view: RoadView, point: Perspective) -> list[_Line]:
        found = self.fan.lines(grey, point)
        rows = np.array([view.row_at(_NEAR), view.row_at(_FAR)])
        near, far = point.columns(found.slope, rows, view.bottom)
        return [_Line(float(n), float(f), float(s)) for n, f, s in zip(near, far, found.strength, strict=True)]

    def _pairs(self, lines: HoughLines, view: RoadView, point: Perspective) -> list[_Line]:
        """Rising and falling edges that bound one bright marking; the line handed on runs between them."""
        near, far = _columns(lines, view)
        rising, falling = np.flatnonzero(lines.rising), np.flatnonzero(~lines.rising)
        width = (near[None, falling] - near[rising, None]) / view.depth
        width_far = (far[None, falling] - far[rising, None]) / (_FAR * view.depth)
        fits = (width >= self.least_width) & (width <= self.most_width) & (np.abs(width - width_far) <= 0.12)
        i, j = np.nonzero(fits)
        a, b = rising[i], falling[j]
        between = 0.5 * (near[a] + near[b]), 0.5 * (far[a] + far[b])
        # Paint is narrow: pairs wider than a single marking count less, down to a half for a double line.
        narrow = np.clip(1.3 - 2.0 * width[i, j], 0.5, 1.0)
        strength = 2.0 * np.sqrt(lines.votes[a] * lines.votes[b]) * narrow * _aimed(*between, view, point)
        return [_Line(float(n), float(f), float(s)) for n, f, s in zip(*between, strength, strict=True)]

    def _singles(self, lines: HoughLines, view: RoadView, point: Perspective) -> list[_Line]:
        """Unpaired edges, second class: a worn marking, a road edge, one side of a wide band."""
        near, far = _columns(lines, view)
        strength = 0.6 * lines.votes * _aimed(near, far, view, point)
        return [_Line(float(n), float(f), float(s)) for n, f, s in zip(near, far, strength, strict=True)]

    def _suppress(self, ranked: list[_Line], known: list[_Line], view: RoadView) -> list[_Line]:
        """The strongest lines of which no two are nearer than `separation` at both rows, nor near a known one.

        Flat lines lie closer to each other than their columns tell, so the distance is measured across them.
        """
        kept: list[_Line] = []
        for line in ranked:
            slope = (line.near - line.far) / ((_NEAR - _FAR) * view.depth)
            least = self.separation * view.depth * math.hypot(1.0, slope)
            if not any(
                abs(line.near - other.near) < _NEAR * least and abs(line.far - other.far) < _FAR * least
                for other in (*known, *kept)
            ):
                kept.append(line)
        return kept


def _columns(lines: HoughLines, view: RoadView) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Columns of Hough lines at the near and the far row."""
    return lines.x_bottom, lines.x_bottom - (_NEAR - _FAR) * view.depth * lines.slope


def _aimed(
    near: NDArray[np.float64], far: NDArray[np.float64], view: RoadView, point: Perspective
) -> NDArray[np.float64]:
    """How well lines keep to the shared perspective, from 1 down to 0.2: boundaries of one road share it."""
    rows = np.array([view.row_at(_NEAR), view.row_at(_FAR)])
    k = point.k(view.bottom)
    slope = (near - point.x - k / view.depth) / view.depth
    expected = point.columns(slope, rows, view.bottom)[1]
    miss = np.abs(far - expected) / np.hypot(1.0, slope)
    aimed: NDArray[np.float64] = 0.2 + 0.8 / (1.0 + (miss / (0.02 * view.width)) ** 2)
    return aimed


def _normalised(lines: list[_Line]) -> list[_Line]:
    strongest = max((line.strength for line in lines), default=1.0)
    return [replace(line, strength=line.strength / strongest) for line in lines]


def _known(curve: Curve, scaling: Scaling, view: RoadView) -> _Line:
    """A curve of the image as a line of the working image."""
    near, far = scaling.curve_to_working(curve).x(np.array([view.row_at(_NEAR), view.row_at(_FAR)]))
    return _Line(float(near), float(far), 1.0, curve)


def _perspective(prior: RoadPrior, scaling: Scaling, height: int) -> Perspective:
    """What the boundaries of a prior share, in the working image, which is `height` rows high."""
    curves = [scaling.curve_to_working(curve) for curve in prior.curves]
    horizon = curves[0].horizon
    v, k = (float(np.mean([curve.coefficients[i] for curve in curves])) for i in (0, 2))
    return Perspective(v, horizon, k / (height - 1.0 - horizon) ** 2, 1.0)


def _lattice(prior: RoadPrior, scaling: Scaling, view: RoadView, point: Perspective) -> Lattice:
    sides = (None if c is None else _known(c, scaling, view) for c in (prior.left, prior.right))
    left, right = (None if line is None else _slope(line, view, point) for line in sides)
    return Lattice.of(left, right)


def _slope(line: _Line, view: RoadView, point: Perspective) -> float:
    """Where a line crosses the bottom row, from the vanishing point, in depths."""
    return (line.near - point.x) / view.depth


def _trusted(line: _Line, lattice: Lattice, view: RoadView, point: Perspective) -> _Line:
    return replace(line, strength=line.strength * lattice.trust(_slope(line, view, point)))


def _neighbours(lattice: Lattice, view: RoadView, point: Perspective) -> list[_Line]:
    """Lines where the boundaries of the next lanes should be."""
    slopes = np.array(lattice.neighbours) - point.bend
    rows = np.array([view.row_at(_NEAR), view.row_at(_FAR)])
    near, far = point.columns(slopes, rows, view.bottom)
    return [_Line(float(n), float(f), 1.0) for n, f in zip(near, far, strict=True)]


def _curve(line: _Line, view: RoadView, point: Perspective) -> Curve:
    """The boundary through a line's two columns, with the bend that all boundaries of the road share."""
    k = point.k(view.bottom)
    u_near, u_far = _NEAR * view.depth, _FAR * view.depth
    b = ((line.near - k / u_near) - (line.far - k / u_far)) / (u_near - u_far)
    return Curve(view.horizon, (line.near - k / u_near - b * u_near, b, k))


def _candidate(line: _Line, curve: Curve, view: RoadView) -> Candidate | None:
    rows = visible_rows(curve, view, TOP_SHARE)
    if rows is None or rows[1] - rows[0] < 0.15 * view.depth:
        return None
    return Candidate(curve, rows[0], rows[1], line.strength)
