"""Labeled frames in memory, whichever file they came from, and the checks on their points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.images.resizing import working_image
from lanestream.road.appearance import MARKING_TYPES, BoundaryKind
from lanestream.road.curve import Curve, FloatArray, curve_basis
from lanestream.road.view import WORKING_WIDTH, Image, RoadView, Scaling

# How far, in pixels, a labeler's point may lie outside the image or go back down the boundary by mistake.
POINT_TOLERANCE: Final = 1.0

# A kerb is labeled at its foot, an edge where the asphalt meets grass, sand or gravel.
ROAD_EDGE_TYPES: Final = ("kerb", "edge")
LANE_TYPES: Final = (*MARKING_TYPES, *ROAD_EDGE_TYPES)


@dataclass(frozen=True)
class LabeledLane:
    """One lane boundary as a labeler or the renderer drew it.

    `points` is an (N, 2) float array of image pixels (x right, y down, pixel centers at integers), from the lowest
    visible row upwards, on the center of the marking. `lane_id` stays with the physical boundary through a clip.
    `position` is -1 for ego left, +1 for ego right, -2 and +2 for the next ones out, or None if the labels don't say.
    `type` is one of LANE_TYPES and `color` that of the paint; None if unknown. `default_kind` is the kind of a boundary
    whose type and color are both unknown.
    """

    points: NDArray[np.float64]
    lane_id: int | None = None
    position: int | None = None
    type: str | None = None
    color: str | None = None
    default_kind: BoundaryKind | None = None

    @property
    def kind(self) -> BoundaryKind | None:
        """Whether it is a marking or an edge of the road; None if unknown."""
        if self.type in ROAD_EDGE_TYPES:
            return "road_edge"
        return "marking" if self.type or self.color else self.default_kind


@dataclass(frozen=True)
class Coverage:
    """What the labels of a frame cover, and so whether an unlabeled boundary is absent or unknown.

    `ego`: both boundaries of the ego lane are labeled if visible, so one without a label is absent.
    `open_sides`: the sides (-1 left, 1 right) on which unlabeled boundaries may lie beyond the outermost label.
    `edges`: edges of the road are labeled as markings are; if not, one beyond the outermost label is unknown.
    `markings`: the frame may show markings; if not, nothing in it is one.
    """

    ego: bool = False
    open_sides: tuple[int, ...] = (-1, 1)
    edges: bool = False
    markings: bool = True


PARTIAL = Coverage()
EGO_LANE = Coverage(ego=True)
WHOLE = Coverage(ego=True, open_sides=(), edges=True)


@dataclass(frozen=True)
class LabeledFrame:
    """The labels of one frame: its size in pixels, its lane boundaries, and what they cover.

    `group` names the drive or clip that the frame belongs to; `source` names the frame within its data set.
    `dataset` is that set's name in the manifest, empty without one. `horizon` is the image row of the horizon if the
    labels give it, negative above the image. `conditions` says how and where the frame was taken ("light": "dusk"), for
    figures by condition.
    """

    width: int
    height: int
    lanes: tuple[LabeledLane, ...]
    group: str
    source: str
    coverage: Coverage = PARTIAL
    dataset: str = ""
    horizon: float | None = None
    conditions: Mapping[str, str] = field(default_factory=dict)

    @property
    def at_working_width(self) -> LabeledFrame:
        """The same labels in pixels of the working image, which detectors see."""
        scaling = Scaling.to_working_width(self.width)
        lanes = tuple(replace(lane, points=scaling.to_working(lane.points)) for lane in self.lanes)
        horizon = None if self.horizon is None else scaling.to_working(self.horizon)
        height = max(1, round(scaling.factor * self.height))
        return replace(self, width=WORKING_WIDTH, height=height, lanes=lanes, horizon=horizon)

    def open_to(self, side: int) -> bool:
        """Whether a boundary beyond the outermost label on `side` (-1 left, 1 right) is unknown rather than absent.

        If the ego lane's boundary on that side is known to be absent, so are those farther out.
        """
        labeled = any((lane.position or 0) * side > 0 for lane in self.lanes)
        return side in self.coverage.open_sides and (labeled or not self.coverage.ego)


# Labeled frames with their BGR images (H, W, 3) uint8.
LabeledImages = Iterator[tuple[LabeledFrame, Image]]


def to_working(frame: LabeledFrame, image: Image) -> tuple[LabeledFrame, Image]:
    """Returns a labeled frame and its BGR image (H, W, 3) uint8 at the working width."""
    return frame.at_working_width, working_image(image)[0]


def points_of(value: object) -> FloatArray:
    """Returns `value`, pairs of x and y, as (N, 2) floats. Raises ValueError if it is anything else."""
    try:
        points: FloatArray = np.asarray(value, dtype=float)
    except (ValueError, TypeError, OverflowError):
        raise ValueError("its points are not pairs of numbers") from None
    if points.size == 0:
        return np.empty((0, 2))
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError("its points are not pairs of numbers")
    return points


def points_inside(points: FloatArray, width: int, height: int) -> FloatArray:
    """Returns the points inside an image, for formats whose boundaries extend beyond it.

    Points that are not numbers are kept, so that `checked_points` reports them.
    """
    x, y = points.T
    inside: FloatArray = points[~((x < 0) | (x > width - 1) | (y < 0) | (y > height - 1))]
    return inside


def checked_points(points: FloatArray, width: int, height: int) -> FloatArray:
    """Returns `points` (N, 2), in pixels of an image of this size, from the lowest row upwards, each row once.

    Points that go back down by up to `POINT_TOLERANCE` are dropped. Raises ValueError that says what is wrong: fewer
    than two points, values that are not numbers, points outside the image, rows that go back down.
    """
    if len(points) < 2:
        raise ValueError("it has one point; at least two are needed" if len(points) else "it has no points")
    if not np.isfinite(points).all():
        raise ValueError("one of its points is not a number")
    slack = POINT_TOLERANCE
    outside = ((points < -slack) | (points > (width - 1 + slack, height - 1 + slack))).any(axis=1)
    if outside.any():
        raise ValueError(f"{_coordinates(points[outside][0])} is outside the image of {width} x {height}")
    if points[0, 1] < points[-1, 1]:
        points = points[::-1].copy()
    reached = np.minimum.accumulate(points[:, 1])
    back = points[:, 1] - reached
    if back.max() > slack:
        first = points[back > slack][0]
        raise ValueError(f"its rows go back down at {_coordinates(first)}; a lane boundary crosses each row once")
    climbs = np.concatenate([[True], points[1:, 1] < reached[:-1]])
    if climbs.sum() < 2:
        raise ValueError(f"its points all lie on row {points[0, 1]:g}")
    kept: FloatArray = points[climbs]
    return kept


def fitted_curve(points: FloatArray, view: RoadView) -> Curve:
    """Returns the least-squares curve, in columns, through three or more `points` (N, 2) below the view's horizon."""
    scale = np.array([1.0, view.depth, 1.0 / view.depth])
    basis = curve_basis(view.horizon, points[:, 1]) / scale
    v, b, k = (np.linalg.lstsq(basis, points[:, 0], rcond=None)[0] / scale).tolist()
    return Curve(view.horizon, (v, b, k))


def _coordinates(point: FloatArray) -> str:
    return f"({point[0]:g}, {point[1]:g})"
