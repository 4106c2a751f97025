"""The ego-lane prior: where the regressor sees the two boundaries of the ego lane, and how certain it is.

The regressor's input is the crop of the whole road, in which the horizon always has the same row. It returns where both
boundaries run, their standard deviations, whether each exists, and where the horizon really is. The regression
detector reports these boundaries; the candidate detector searches around them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Infer
from lanestream.images.resizing import resized
from lanestream.road.crops import RoadCropGeometry
from lanestream.road.curve import Curves, FloatArray, VanishingPoint
from lanestream.road.view import LANE_WIDTHS, USUAL_LANE_WIDTH, Image, RoadView, Scaling

# The regressor gives columns at these shares of the depth below the horizon.
REGRESSOR_ANCHORS: Final[FloatArray] = np.array([1.0, 0.4, 0.15])

# Where the horizon of an unknown camera may be, as shares of the height; the regressor tries each. Neighbors differ by
# about a sixth of the depth. A camera that looks down has its horizon above the picture.
UNKNOWN_HORIZONS: Final = (-0.36, -0.16, 0.02, 0.17, 0.29, 0.39, 0.48, 0.57)
# The network sees the row better the nearer its crop assumed it. So a row that was found is refined, at most so often,
# until it moves by less than this, in depths, or the uncertainty is more than this factor of the first one.
_REFINEMENTS: Final = 3
_SETTLED: Final = 0.01
_WORSE: Final = 1.1
# How far a given horizon moves with the vehicle's pitch, in depths.
_MOST_PITCH: Final = 0.05
# A doubtful horizon is given up for one with less than this share of its uncertainty.
_CLEARER: Final = 0.75
# The limits of the horizon, as shares of the height.
_HIGHEST_HORIZON, _LOWEST_HORIZON = -0.6, 0.9

# If the mean sigma, in image widths, is above the first limit, the network also runs on the mirrored crop. A boundary
# whose sigma is above the second limit is not used for the search: the network does not know such roads.
_UNCERTAIN: Final = 0.022
_MOST_UNCERTAIN: Final = 0.1
# A frame shows no road if the presence of both boundaries is less than the first: more likely than not, neither exists.
# After a frame with boundaries that is less likely: the odds are a third.
_LEAST_ROAD: Final = (0.5, 0.25)
# Lateral positions are compared at these anchors: farther away all lines of a road are close together.
_COMPARED: Final = REGRESSOR_ANCHORS[:2]
# A curve within the second distance, in row offsets, of a boundary with at least the first presence is that boundary.
_LIKELY: Final = 0.5
_EXPECTED: Final = 0.16
# The smallest sigma of a boundary, in row offsets.
_LEAST_SIGMA: Final = 0.02
# The odds factor of a line a whole number of lane widths from the ego lane, and the share of it for a line far from
# such a position: the feet of walls and the edges of pavements run there, but hardly any boundary.
_SPACED_ODDS: Final = 1.5
_UNSPACED_SHARE: Final = 0.05


@dataclass(frozen=True)
class RegressorOutput:
    """The regressor's output for one frame, relative to its road crop.

    `columns` (2, 3) and `sigma` (2, 3) of the left and the right boundary at the anchors are in image widths from the
    middle; `presence` (2,) is the probability of each; `horizon` is in depths below where the crop assumed it.
    `road_edge` (2,) is the probability of a boundary being an edge of the road rather than a marking; older networks
    don't return it, and know only markings.
    """

    columns: FloatArray
    sigma: FloatArray
    presence: FloatArray
    horizon: float
    road_edge: FloatArray

    @classmethod
    def of(cls, output: NDArray[np.float32]) -> RegressorOutput:
        """Reads one row (17,) of the network's outputs, or (15,) of an older network's."""
        values = np.asarray(output, dtype=np.float64)
        columns, sigma, presence = values[:6].reshape(2, 3), values[6:12].reshape(2, 3), values[12:14]
        road_edge = values[15:17] if len(values) > 15 else np.zeros(2)
        return cls(columns, sigma, presence, float(values[14]), road_edge)

    @property
    def uncertainty(self) -> float:
        """The mean standard deviation, plus a little for a horizon that is not where the crop assumed it."""
        return float(self.sigma.mean() + 0.05 * abs(self.horizon))

    def is_clearer_than(self, other: RegressorOutput) -> bool:
        """Whether it shows a road, and with much less uncertainty than `other`."""
        return self.shows_road and self.uncertainty < _CLEARER * other.uncertainty

    @property
    def shows_road(self) -> bool:
        """Whether at least one boundary is likely to exist."""
        return bool(self.presence.max() >= _LIKELY)

    @property
    def mirrored(self) -> RegressorOutput:
        """The output of a mirrored crop, mirrored back."""
        return RegressorOutput(
            -self.columns[::-1], self.sigma[::-1], self.presence[::-1], self.horizon, self.road_edge[::-1]
        )

    def mean(self, other: RegressorOutput) -> RegressorOutput:
        """Returns the mean of two outputs for one crop."""
        return RegressorOutput(
            0.5 * (self.columns + other.columns),
            0.5 * (self.sigma + other.sigma),
            0.5 * (self.presence + other.presence),
            0.5 * (self.horizon + other.horizon),
            0.5 * (self.road_edge + other.road_edge),
        )

    def view(self, assumed: RoadView) -> RoadView:
        """Returns the view with the horizon where the network sees it."""
        horizon = assumed.horizon + self.horizon * assumed.depth
        limits = _HIGHEST_HORIZON * assumed.height, _LOWEST_HORIZON * assumed.height
        return assumed.with_horizon(float(np.clip(horizon, *limits)))

    def curves(self, view: RoadView) -> Curves:
        """Returns both boundaries, left and right, in pixels of `view`, which has the network's horizon."""
        rows = view.horizon + REGRESSOR_ANCHORS * view.depth
        return Curves.through(view.horizon, rows, view.middle + self.columns * view.width)


@dataclass(frozen=True)
class EgoPrior:
    """The ego boundaries that the regressor sees well enough, from left to right; none, one or two.

    `sides` are -1 (left) and +1 (right). `curves` are in pixels of the working image below the horizon of `view`, and
    `sigma` (M, 2) in row offsets. `presence` (M,) is the probability that the boundary exists at all, and `road_edge`
    (M,) that it is an edge of the road if it does. If not `shows_road`, neither boundary is likely enough to exist,
    seen well or not. `uncertainty` is that of the network's output.
    """

    view: RoadView
    sides: tuple[int, ...]
    curves: Curves
    sigma: FloatArray
    presence: FloatArray
    road_edge: FloatArray
    shows_road: bool = True
    uncertainty: float = 0.0

    @property
    def vanishing_point(self) -> VanishingPoint:
        """The mean vanishing point of the boundaries, of which there must be at least one."""
        v, _, k = self.curves.coefficients.mean(axis=0).tolist()
        return VanishingPoint(v, self.view.horizon, k, 1.0)

    def spacing(self, positions: FloatArray, least: float) -> LaneSpacing:
        """Returns the lane-spacing model of an ego lane whose boundaries (M,), at least one, are at `positions`."""
        at = dict(zip(self.sides, positions.tolist(), strict=True))
        left = at[-1] if -1 in at else at[1] - USUAL_LANE_WIDTH
        right = at[1] if 1 in at else at[-1] + USUAL_LANE_WIDTH
        return LaneSpacing(left, right, least)

    def expects(self, curves: Curves) -> NDArray[np.bool_]:
        """Returns for each of the `curves` (N,) whether it is one of the prior's boundaries."""
        below = _COMPARED * self.view.depth
        rows = self.view.horizon + below
        apart = np.abs(curves.x(rows)[:, None] - self.curves.x(rows)) / below
        likely = self.presence >= _LIKELY
        return np.asarray((apart[:, likely].mean(axis=2) <= _EXPECTED).any(axis=1))

    def odds(self, curves: Curves) -> FloatArray:
        """Returns the factors (N, 2) by which their positions change the odds of `curves` to be markings or road edges.

        Roads have a marking every lane width, and edges anywhere outside the ego lane. The ego lane has its boundaries
        where the prior saw them, within their sigma (with the heavy tail of Student's t with three degrees of freedom),
        and none between them. A frame without a road has no boundaries: all factors are zero.
        """
        if not self.shows_road:
            return np.zeros((len(curves), 2))
        below = _COMPARED * self.view.depth
        rows = self.view.horizon + below
        positions = curves.x(rows) / below
        mine = self.curves.x(rows) / below
        distance = (positions[:, None] - mine) / self.sigma
        odds = np.ones((len(curves), 2))
        if len(mine) == 2:
            inside = np.minimum(distance[:, 0].mean(axis=1), -distance[:, 1].mean(axis=1))
            left, right = mine.mean(axis=1).tolist()
            spacing = LaneSpacing(left, right, _UNSPACED_SHARE)
            odds[:, 0] = _SPACED_ODDS * spacing.weight(positions.mean(axis=1))
            odds /= (1.0 + np.exp(inside.clip(-30.0, 30.0)))[:, None]
        density = 2.0 / (np.pi * np.sqrt(3.0)) / (1.0 + (distance**2).mean(axis=2) / 3.0) ** 2 / self.sigma.mean(axis=1)
        kinds = self.presence[:, None] * np.stack([1.0 - self.road_edge, self.road_edge], axis=1)
        return np.asarray(odds + USUAL_LANE_WIDTH * density @ kinds)


@dataclass(frozen=True)
class LaneSpacing:
    """The lane-spacing model: boundaries repeat every lane width outwards from the ego lane's `left` and `right`.

    Lateral positions are in columns per row offset. A line far from all repeated positions has the weight `least`.
    """

    left: float
    right: float
    least: float

    # Standard deviation of a boundary's position in lane widths. Positions beyond the adjacent lanes weigh less,
    # because lanes begin and end there.
    _TOLERANCE = 0.12
    _OUTER_WEIGHT = 0.6

    @property
    def width(self) -> float:
        """The lane width, within plausible limits."""
        narrowest, widest = LANE_WIDTHS
        return min(max(self.right - self.left, narrowest), widest)

    @property
    def neighbors(self) -> FloatArray:
        """The next boundaries outside the ego lane, left and right (2,)."""
        return np.array([self.left - self.width, self.right + self.width])

    def weight(self, positions: FloatArray) -> FloatArray:
        """Returns how likely lines are boundaries, 0 to 1 (N,), judged by their lateral `positions` (N,) alone."""
        is_left = positions < 0.5 * (self.left + self.right)
        outside = np.where(is_left, self.left - positions, positions - self.right) / self.width
        lanes = np.maximum(0.0, np.rint(outside))
        near = np.exp(-0.5 * ((outside - lanes) / self._TOLERANCE) ** 2)
        weight: FloatArray = (self.least + (1.0 - self.least) * near) * np.where(lanes <= 1.0, 1.0, self._OUTER_WEIGHT)
        return weight


@dataclass(frozen=True)
class RoadRegressor:
    """Prepares the regressor's inputs and reads its outputs.

    A boundary is used if its presence reaches `threshold`.
    """

    threshold: float
    geometry: RoadCropGeometry = RoadCropGeometry()

    def predict(
        self, image: Image, horizon: float | None, infer: Infer, *, is_given: bool = False, is_doubtful: bool = False
    ) -> tuple[RegressorOutput, RoadView]:
        """Returns the output for a BGR working image, and the view with the horizon that the network sees.

        `horizon` is its approximate row. If it is None, the network runs once for each of several rows, and again near
        the one with the least uncertainty. If it `is_doubtful`, it has to compete with these rows. If it `is_given`, it
        is wrong only by the vehicle's pitch.
        """
        height, width = image.shape[:2]
        detail = resized(image, self.geometry.detail_width / width)
        if horizon is None or (is_doubtful and not is_given):
            horizon = self._search(detail, RoadView(width, height, 0.0), horizon, infer)
        view = RoadView(width, height, float(np.clip(horizon, _HIGHEST_HORIZON * height, 0.85 * height)))
        crop = self.crop(detail, view)
        output = RegressorOutput.of(infer("regressor", crop[None])[0])
        if output.sigma.mean() > _UNCERTAIN:
            # The network's errors differ between a crop and its mirror image, so their mean is the better estimate.
            mirrored = RegressorOutput.of(infer("regressor", np.ascontiguousarray(crop[None, :, ::-1]))[0]).mirrored
            output = output.mean(mirrored)
        if is_given:
            output = replace(output, horizon=float(np.clip(output.horizon, -_MOST_PITCH, _MOST_PITCH)))
        return output, output.view(view)

    def _search(self, detail: Image, view: RoadView, expected: float | None, infer: Infer) -> float:
        """Returns the row of the horizon that the network sees with the least uncertainty.

        That is the `expected` row unless it is clearly another one.
        """
        rows = [share * view.height for share in UNKNOWN_HORIZONS]
        views = [view.with_horizon(row) for row in (rows if expected is None else [expected, *rows])]
        crops = np.stack([self.crop(detail, each) for each in views])
        outputs = [RegressorOutput.of(row) for row in infer("regressor", crops)]
        best = min(range(len(views)), key=lambda i: outputs[i].uncertainty)
        if expected is not None and not outputs[best].is_clearer_than(outputs[0]):
            return expected
        seen, found = outputs[best], outputs[best].view(views[best])
        # Where it sees no road at first, closer looks would sometimes invent one.
        for _ in range(_REFINEMENTS if seen.shows_road else 0):
            closer = RegressorOutput.of(infer("regressor", self.crop(detail, found)[None])[0])
            if closer.uncertainty > _WORSE * seen.uncertainty:
                break
            before, found = found, closer.view(found)
            if abs(found.horizon - before.horizon) < _SETTLED * found.depth:
                break
        return found.horizon

    def crop(self, detail: Image, view: RoadView) -> NDArray[np.uint8]:
        """Returns the road crop (size, size, 3) in RGB of `detail`, a working image at the detail width."""
        columns, rows = self.geometry.grid(view, Scaling(detail.shape[1] / view.width))
        crop = cv2.remap(detail, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(cv2.cvtColor(crop, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def prior(self, output: RegressorOutput, view: RoadView, *, is_tracking: bool = False) -> EgoPrior:
        """Returns the boundaries of an output that are present and certain enough to guide the search.

        If boundaries were tracked to this frame (`is_tracking`), it still shows a road as long as that is possible.
        """
        seen = (output.presence >= self.threshold) & (output.sigma.mean(axis=1) <= _MOST_UNCERTAIN)
        sigma = output.sigma[seen, : len(_COMPARED)] * view.width / (_COMPARED * view.depth)
        sides = _sides(seen.tolist())
        return EgoPrior(
            view,
            sides,
            output.curves(view).take(seen),
            np.hypot(sigma, _LEAST_SIGMA),
            output.presence[seen],
            output.road_edge[seen],
            float(output.presence.max()) >= _LEAST_ROAD[is_tracking],
            output.uncertainty,
        )


def _sides(seen: Sequence[bool]) -> tuple[int, ...]:
    return tuple(side for side, is_seen in zip((-1, 1), seen, strict=True) if is_seen)
