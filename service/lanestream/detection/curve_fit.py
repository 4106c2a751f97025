"""The joint curve fit: moves all boundaries of a frame onto their paint together, to a fraction of a pixel.

The marking filter finds bright bars row by row on a strip along each curve, and steps between two surfaces along edges
of the road; reweighted least squares pulls the curve onto them. Where paint is missing, two priors apply: the curve
itself, and the road that it shares with the other boundaries. On a flat road all boundaries have one vanishing point,
one horizon and one curvature. So a dashed line keeps its direction, and a far end behind a car follows its neighbors. A
fit on one stripe of a double line is moved to the middle between both stripes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.features import Channels
from lanestream.detection.marking_filter import bar_contrast, step_contrast
from lanestream.road.curve import ANCHORS, Curves, FloatArray
from lanestream.road.view import Image, RoadView, Spans, visible_spans

# hypot(1, slope) of an ego boundary half a lane of 3.6 m beside a camera 1.45 m high. Errors across the image of more
# oblique lines are larger for the same distance on the road, so their strips and tolerances are wider.
USUAL_OBLIQUITY: Final = 1.6

# All widths are shares of the row offset, as everything on the road is. Markings are about as wide as one of these.
_MARKING_WIDTHS: Final = (0.05, 0.1, 0.17)
# The width of each side of a step.
_STEP_WIDTH: Final = 0.08
# Rows of a strip, from the bottom up to this share of the depth.
_ROWS: Final = 48
_TOP_SHARE: Final = 0.06
# The weight of a bar is relative to the contrast of the strip's best rows, this share of them, times this factor.
_BEST_ROWS: Final = 0.1
_BEST_FACTOR: Final = 0.4
# The center of a bar in one row is known to this many pixels, plus this share of the row offset.
_ROW_NOISE: Final = 1.0
_BLUR: Final = 0.012
# Closer to the horizon than this share of the depth, the curvature term is unbounded and paint does not determine it.
_FARTHEST: Final = 0.04
# Errors of neighboring rows are correlated: about four rows carry the information of one.
_CORRELATED_ROWS: Final = 4.0
# A candidate's columns at the anchors are known to about this, in depths.
_CANDIDATE_SIGMA: Final = np.array([0.03, 0.02, 0.1])

# The vanishing point's column and the curvature term of a boundary are those of the road within these deviations, in
# depths; on a curving road also within this share of its curvature, because the inner boundary curves more sharply.
_COMMON_SIGMA: Final = np.array([0.003, 0.0006])
_CURVING_SHARE: Final = 0.1
# A boundary this many sigmas from the common road has half the weight: it belongs to another road, or is not a
# boundary.
_OUTLIER: Final = 3.0
# The sigmas of the road's column, horizon and curvature before the fit, and the most that the horizon may move, in
# depths.
_ROAD_SIGMA: Final = np.array([0.1, 0.03, 0.03])
_MOST_PITCH: Final = 0.04


@dataclass(frozen=True)
class FitSettings:
    """How far from the curve the fit searches for paint, and how strictly.

    Strips extend `reach` to either side, in `cells` cells. Each of the `rounds` is the distance from the curve at which
    a bar has a quarter of its weight in that round. With `move_horizon` the horizon is fitted too.
    """

    reach: float = 0.16
    cells: int = 97
    rounds: tuple[float, ...] = (0.06, 0.035)
    move_horizon: bool = True


@dataclass(frozen=True)
class Fits:
    """Fitted curves, the covariances (N, 3, 3) of their coefficients, and the view with the horizon they agree on.

    `paint` (N,) is the share of each curve's rows in which it lies on a marking, or on a step if it is a road edge.
    """

    curves: Curves
    covariances: FloatArray
    paint: FloatArray
    view: RoadView


def fit_curves(
    channels: Channels,
    curves: Curves,
    spans: Spans,
    view: RoadView,
    settings: FitSettings = FitSettings(),
    sigma: FloatArray | None = None,
    anchors: FloatArray = ANCHORS,
    is_edge: NDArray[np.bool_] | None = None,
) -> Fits:
    """Fits `curves` to a working image, in the rows where they are visible, or else in their `spans`.

    Those that are road edges by the mask `is_edge` (N,) are fitted to steps between surfaces, all others to paint.
    `sigma` (N, 3) are the deviations in pixels of the curves' columns at the `anchors`, if known.
    """
    if not len(curves):
        return Fits(curves, np.empty((0, 3, 3)), np.empty(0), view)
    is_edge = np.zeros(len(curves), bool) if is_edge is None else is_edge
    visible = visible_spans(curves, view, _TOP_SHARE)
    top = np.where(visible.visible, visible.top, spans.top)
    bottom = np.where(visible.visible, visible.bottom, spans.bottom)
    strips = _Strips.along(curves, top, bottom, view, settings.reach, settings.cells, _ROWS)
    bars = strips.bars(channels.paint, _MARKING_WIDTHS)
    if is_edge.any():
        bars[is_edge] = strips.take(is_edge).steps(channels)
    if sigma is None:
        sigma = strips.obliquity[:, None] * _CANDIDATE_SIGMA * view.depth
    fits = _JointFit(strips, bars, curves, view, sigma, anchors).run(settings)
    shifts = np.where(is_edge, 0.0, _stripe_shifts(channels.paint, fits, top, bottom))
    # A shift proportional to the row offset is a constant shift on the ground.
    moved = fits.curves.coefficients + shifts[:, None] * np.array([0.0, 1.0, 0.0])
    return replace(fits, curves=Curves(fits.curves.horizon, moved))


@dataclass(frozen=True)
class _Strips:
    """Strips along N curves on R rows: the rows `y` (N, R), the curves' columns `x` and row offsets `u` there.

    Positions `across` (C,) are in row offsets times the curve's `obliquity` (N,).
    """

    y: FloatArray
    x: FloatArray
    u: FloatArray
    obliquity: FloatArray
    across: NDArray[np.float32]

    @classmethod
    def along(
        cls, curves: Curves, top: FloatArray, bottom: FloatArray, view: RoadView, reach: float, cells: int, rows: int
    ) -> _Strips:
        y = top[:, None] + (bottom - top)[:, None] * np.linspace(0.0, 1.0, rows)
        slope = curves.slope(0.5 * (top + bottom)[:, None])[:, 0]
        obliquity = np.maximum(1.0, np.hypot(1.0, slope) / USUAL_OBLIQUITY)
        across = np.linspace(-reach, reach, cells, dtype=np.float32)
        return cls(y, curves.x(y), y - view.horizon, obliquity, across)

    def take(self, mask: NDArray[np.bool_]) -> _Strips:
        return replace(self, y=self.y[mask], x=self.x[mask], u=self.u[mask], obliquity=self.obliquity[mask])

    def bars(self, gray: Image, widths: Sequence[float]) -> NDArray[np.float32]:
        """Returns the contrast (N, R, C), 0 to 1, of bars of the given widths."""
        return self._relative(self._filtered(gray, widths, bar_contrast))

    def steps(self, channels: Channels) -> NDArray[np.float32]:
        """Returns the contrast (N, R, C), 0 to 1, of steps between two surfaces."""
        contrast = [
            self._filtered(channel, (_STEP_WIDTH,), lambda strip, widths: np.abs(step_contrast(strip, widths[0])))
            for channel in (channels.paint, channels.blue)
        ]
        return self._relative(np.maximum(*contrast))

    def _filtered(
        self,
        gray: Image,
        widths: Sequence[float],
        filtered: Callable[[Image, Sequence[int]], NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        """Applies a filter for objects of the given `widths` to the strips (N, R, C)."""
        cells = len(self.across)
        reach = (self.u * self.obliquity[:, None]).astype(np.float32)
        columns = reach[:, :, None] * self.across
        columns += self.x.astype(np.float32)[:, :, None]
        rows = np.broadcast_to(self.y.astype(np.float32)[:, :, None], columns.shape)
        maps = columns.reshape(-1, cells), rows.reshape(-1, cells)
        warped = cv2.remap(gray, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        strips = np.asarray(warped, np.uint8).reshape(columns.shape)
        per_cell = (cells - 1) / float(self.across[-1] - self.across[0])
        contrast = np.empty(strips.shape, np.float32)
        # A strip that is wider by its obliquity has narrower bars; strips with equal bar widths are filtered together.
        groups: dict[tuple[int, ...], list[int]] = {}
        for index, obliquity in enumerate(self.obliquity.tolist()):
            groups.setdefault(tuple(max(1, round(w / obliquity * per_cell)) | 1 for w in widths), []).append(index)
        for cell_widths, members in groups.items():
            part = filtered(strips[members].reshape(-1, cells), cell_widths)
            contrast[members] = part.reshape(len(members), -1, cells)
        return contrast

    def _relative(self, contrast: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns a contrast in gray levels relative to the texture of its row and the strip's best rows, 0 to 1."""
        # A bar five gray levels above the texture of its row is visible to a person. Weights are squared, so that a few
        # bright dots outweigh a wheel track that is slightly lighter over its whole length.
        texture = np.abs(contrast).mean(axis=2, keepdims=True)
        rank = int((1.0 - _BEST_ROWS) * (self.y.shape[1] - 1))
        best = np.maximum(np.partition(contrast.max(axis=2), rank, axis=1)[:, rank], 0.0)
        relative: NDArray[np.float32] = (contrast - texture) / (texture + (5.0 + _BEST_FACTOR * best)[:, None, None])
        np.clip(relative, 0.0, 1.0, out=relative)
        relative *= relative
        return relative


class _JointFit:
    """Least squares over all boundaries of a frame and the road that they share.

    Boundary n is x(t) = v + b t + c / t with t = u / depth: its `theta` (3,) are v, b and c = k / depth, all in pixels.
    The road is V, H, C: the column of its vanishing point, how many rows its horizon is below the current one, and its
    curvature. Two constraints tie each boundary to it: v + dv/dh H = V and c + dc/dh H = C.
    """

    def __init__(
        self,
        strips: _Strips,
        bars: NDArray[np.float32],
        curves: Curves,
        view: RoadView,
        sigma: FloatArray,
        anchors: FloatArray,
    ) -> None:
        self._strips = strips
        self._bars = bars
        self._view = view
        self._rows = view.horizon + anchors * view.depth
        self._start = curves.x(self._rows)
        self._precision = sigma**-2.0
        self._row_precision = (_ROW_NOISE + _BLUR * strips.u) ** -2.0
        self._scale = strips.u * strips.obliquity[:, None]
        self._sigma_unit = view.depth * strips.obliquity[:, None]
        # Sums over a strip's cells, and sums of their positions, in one product.
        self._moments = np.stack([np.ones_like(strips.across), strips.across], axis=1)
        # The constraints' coefficients (2 N, 3 N + 3) of all shifts, V, H and C; those of H depend on the horizon.
        number = len(curves)
        constraints = np.zeros((number, 2, 3 * number + 3))
        indices = np.arange(number)
        constraints[indices, 0, 3 * indices] = constraints[indices, 1, 3 * indices + 2] = 1.0
        constraints[:, 0, -3] = constraints[:, 1, -1] = -1.0
        self._constraints = constraints
        # The positions of each boundary's block and of the road's diagonal in the flattened normal matrix.
        size = 3 * number + 3
        within = size * np.arange(3)[:, None] + np.arange(3)
        self._blocks = (3 * (size + 1) * indices)[:, None, None] + within
        self._road_diagonal = (size + 1) * np.arange(3 * number, size)

    def run(self, settings: FitSettings) -> Fits:
        depth, expected = self._view.depth, self._view.horizon
        number = len(self._start)
        shifts = slice(0, 3 * number)
        road_sigma = _ROAD_SIGMA if settings.move_horizon else _ROAD_SIGMA * np.array([1.0, 1e-6, 1.0])
        road_precision = (depth * road_sigma) ** -2.0
        most_pitch = _MOST_PITCH * depth if settings.move_horizon else 0.0
        horizon, columns = expected, self._start
        basis = _basis((self._rows - horizon) / depth)
        inverse = _inverse(basis)
        theta = start = self._start @ inverse.T
        road = np.array([_median(start[:, 0]), 0.0, _median(start[:, 2])])
        for reach in settings.rounds:
            row_basis = _basis((self._strips.y - horizon) / depth)
            information, moment, paint = self._paint(row_basis, start, theta, reach, horizon)
            prior = (basis.T * self._precision[:, None, :]) @ basis
            known = np.array([_median(start[:, 0]), expected - horizon, _median(start[:, 2])])
            constraints, weights = self._weighted_constraints(inverse, theta, road, horizon)
            weighted = constraints.T * weights
            normal = weighted @ constraints
            normal.ravel()[self._blocks] += prior + information
            normal.ravel()[self._road_diagonal] += road_precision
            right = -(weighted @ start[:, ::2].ravel())
            right[shifts] += moment.ravel()
            right[-3:] += road_precision * known
            solution = np.linalg.solve(normal, right)
            columns = self._start + solution[shifts].reshape(-1, 3) @ basis.T
            moved = horizon + float(solution[-2]) - expected
            horizon = expected + min(max(moved, -most_pitch), most_pitch)
            road = np.array([solution[-3], 0.0, solution[-1]])
            # The same columns, expressed below the new horizon.
            basis = _basis((self._rows - horizon) / depth)
            inverse = _inverse(basis)
            theta, start = columns @ inverse.T, self._start @ inverse.T
        normal.ravel()[self._blocks] -= (1.0 - 1.0 / _CORRELATED_ROWS) * information
        covariance = _inverse(normal).ravel()[self._blocks]
        # From v, b, c in terms of t to v, b, k in terms of u.
        unit = np.array([1.0, 1.0 / depth, depth])
        fitted = Curves(horizon, theta * unit)
        return Fits(fitted, covariance * np.outer(unit, unit), paint, self._view.with_horizon(horizon))

    def _paint(
        self, row_basis: FloatArray, start: FloatArray, theta: FloatArray, reach: float, horizon: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns normal equations (N, 3, 3) and (N, 3) of the shifts, from the bars near the curves `theta` (N, 3).

        The third value is the share (N,) of rows with a bar.
        """
        strips = self._strips
        both = row_basis @ np.stack([theta, start], axis=2)
        position = ((both[:, :, 0] - strips.x) / self._scale).astype(np.float32)
        distance = strips.across - position[:, :, None]
        distance *= np.float32(1.0 / reach)
        distance *= distance
        distance += np.float32(1.0)
        distance *= distance
        moments = (self._bars / distance) @ self._moments
        total, moment = moments[:, :, 0].astype(np.float64), moments[:, :, 1]
        residual = strips.x + moment / np.maximum(total, 1e-6) * self._scale - both[:, :, 1]
        # A row counts once, however wide its bar; a row without a bar does not count.
        is_near = strips.y - horizon > _FARTHEST * self._view.depth
        presence = np.minimum(0.5 * total, 1.0) * is_near
        paint = presence.sum(axis=1) / np.maximum(is_near.sum(axis=1), 1)
        precision = presence * self._row_precision
        weighted = (row_basis * precision[:, :, None]).swapaxes(1, 2)
        return weighted @ row_basis, (weighted @ residual[:, :, None])[:, :, 0], paint

    def _weighted_constraints(
        self, inverse: FloatArray, theta: FloatArray, road: FloatArray, horizon: float
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the constraints (2 N, 3 N + 3) and their weights (2 N,), lower for boundaries far from the road."""
        depth = self._view.depth
        # How a boundary's parameters change with the horizon if its columns at the anchors stay.
        t = (self._rows - horizon) / depth
        drift = ((theta[:, 1:2] - theta[:, 2:] / t**2) / depth) @ inverse[::2].T
        self._constraints[:, :, -2] = drift
        sigma = self._sigma_unit * (_COMMON_SIGMA + _CURVING_SHARE * abs(float(road[2])) / depth)
        distance = (((theta[:, ::2] - road[::2]) / sigma) ** 2).sum(axis=1, keepdims=True)
        weights = sigma**-2.0 / (1.0 + distance / _OUTLIER**2)
        return self._constraints.reshape(2 * len(theta), -1), weights.ravel()


def _median(values: FloatArray) -> float:
    """Returns the median of a few numbers; NumPy's takes longer than the rest of a round."""
    numbers: list[float] = values.tolist()
    return median(numbers)


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(matrix), np.float64)


def _basis(t: FloatArray) -> FloatArray:
    """Returns d x / d (v, b, c) at `t` (...,) as an array (..., 3)."""
    t = np.maximum(t, 1e-3)
    basis = np.empty((*t.shape, 3))
    basis[..., 0] = 1.0
    basis[..., 1] = t
    basis[..., 2] = 1.0 / t
    return basis


# --- Double lines ---------------------------------------------------------------------------------------------------

# A fit settles on the stripe with more contrast, which may be another one in the next frame. Along the fit both stripes
# are straight, so their contrast adds up over the rows, and each is a peak of the mean row. The strips along a fit have
# this reach, these numbers of cells and rows, this highest row as a share of the depth, and these widths of stripes.
_STRIPE_REACH, _STRIPE_CELLS, _STRIPE_ROWS, _STRIPE_TOP_SHARE = 0.4, 129, 24, 0.2
_STRIPE_WIDTHS: Final = (0.05, 0.09)
# A stripe has at least this contrast in this share of the rows, and is within this distance of the fit. The distance
# between the stripes of a double line is in this range.
_STRIPE_CONTRAST, _STRIPE_SHARE, _STRIPE_FARTHEST = 0.06, 0.3, 0.2
_STRIPE_GAPS: Final = (0.07, 0.25)


def _stripe_shifts(gray: Image, fits: Fits, top: FloatArray, bottom: FloatArray) -> FloatArray:
    """Returns how far (N,) fits on a stripe of a double line are left of the middle between its stripes, else 0.

    The distances are in row offsets.
    """
    view = fits.view
    visible = visible_spans(fits.curves, view, _STRIPE_TOP_SHARE)
    top = np.where(visible.visible, visible.top, top)
    bottom = np.where(visible.visible, visible.bottom, bottom)
    strips = _Strips.along(fits.curves, top, bottom, view, _STRIPE_REACH, _STRIPE_CELLS, _STRIPE_ROWS)
    bars = strips.bars(gray, _STRIPE_WIDTHS)
    mean = bars.mean(axis=1)
    # If the fit is slightly off, the stripe crosses from one cell to the next.
    shown = (bars > _STRIPE_CONTRAST).astype(np.uint8)
    shown = np.asarray(cv2.dilate(shown.reshape(-1, _STRIPE_CELLS), np.ones((1, 3), np.uint8)), np.uint8)
    is_stripe = (mean[:, 1:-1] >= mean[:, :-2]) & (mean[:, 1:-1] > mean[:, 2:])
    is_stripe &= shown.reshape(bars.shape).mean(axis=1)[:, 1:-1] >= _STRIPE_SHARE
    is_stripe &= np.abs(strips.across[1:-1]) <= _STRIPE_FARTHEST
    shift = np.zeros(len(fits.curves))
    for index in np.flatnonzero(is_stripe.sum(axis=1) >= 2).tolist():
        cells = 1 + np.flatnonzero(is_stripe[index])
        # The clearest stripe first.
        stripes = strips.across[cells[np.argsort(-mean[index, cells], kind="stable")]].tolist()
        shift[index] = _middle(stripes) * strips.obliquity[index]
    return shift


def _middle(stripes: Sequence[float]) -> float:
    """Returns the middle between the stripe nearest to the fit and its clearest possible partner, or 0 without one."""
    nearest = min(stripes, key=abs)
    closest, farthest = _STRIPE_GAPS
    others = [stripe for stripe in stripes if closest <= abs(stripe - nearest) <= farthest]
    return 0.5 * (nearest + others[0]) if others else 0.0
