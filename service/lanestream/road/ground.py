"""Boundaries in meters: curves of the image, intersected with the road plane.

Points on the curves are undistorted, not pictures: eight per boundary instead of a million pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lanestream.road.camera import Camera, Lens, camera_from_vehicle
from lanestream.road.curve import Curves, FloatArray, curve_basis
from lanestream.road.results import EgoMeters, Estimate, FrameResult, RoadEstimate

# Each boundary is sampled at this many rows, from its lowest visible row to its highest, but over at least this ratio
# of distances, and not nearer to the horizon than this many rows.
_SHARES: Final = np.linspace(0.0, 1.0, 8)
_LEAST_RATIO: Final = 2.5
_NEAREST_ROWS: Final = 2.0
# The step of numerical derivatives by the columns, in pixels.
_COLUMN_STEP: Final = 0.5
# The determinant of the normal equations of a parabola: above 1e-3 for usual cameras, and up to this by rounding alone.
_LEAST_DETERMINANT: Final = 1e-9


@dataclass(frozen=True)
class GroundCurves:
    """N parabolas Y = a X^2 + b X + c in the vehicle frame, `coefficients` (N, 3) with their `covariances` (N, 3, 3).

    The covariances do not include errors of the pitch. Such an error turns a boundary at Y by Y / height times itself,
    but changes neither its Y at the vehicle nor the direction of the road.
    """

    coefficients: FloatArray
    covariances: FloatArray

    def estimate(self, coefficient: int, weights: Mapping[int, float]) -> Estimate:
        """Returns the sum of one coefficient of the curves in `weights`, whose errors are independent."""
        value = sum(weight * float(self.coefficients[i, coefficient]) for i, weight in weights.items())
        variance = sum(
            weight**2 * float(self.covariances[i, coefficient, coefficient]) for i, weight in weights.items()
        )
        return Estimate(value, math.sqrt(max(variance, 0.0)))


@dataclass(frozen=True)
class RoadPlane:
    """The road as a camera sees it: `pitch` and `yaw` in radians, down and left, in the pixels of `lens`."""

    camera: Camera
    lens: Lens
    pitch: float
    yaw: float

    def points(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns X and Y (...,) of the road at `pixels` (..., 2), undistorted.

        A ray (X, Y, Z) in the vehicle frame meets the road at -height / Z times itself. Rays above the horizon would
        meet it behind the camera.
        """
        rotation = camera_from_vehicle(self.pitch, self.yaw, math.radians(self.camera.roll))
        rays = self.lens.rays(pixels) @ rotation[:2] + rotation[2]
        distance = -self.camera.height / rays[..., 2]
        return rays[..., 0] * distance, rays[..., 1] * distance + self.camera.lateral

    def parabolas(self, curves: Curves, covariances: FloatArray, tops: FloatArray, bottoms: FloatArray) -> GroundCurves:
        """Returns N `curves` with `covariances` (N, 3, 3), visible from the rows `tops` (N,) to `bottoms` (N,).

        Each becomes the least-squares parabola through its points on the road. Without distortion, yaw and roll it is
        exact: X = f h / u and Y = -(v - cx + b u + k / u) h / u for a level camera of the focal length f and the height
        h give Y = -k / (f^2 h) X^2 - (v - cx) / f X - b h. Covariances are propagated to first order.
        """
        far = np.maximum(np.minimum(tops - curves.horizon, (bottoms - curves.horizon) / _LEAST_RATIO), _NEAREST_ROWS)
        near = np.maximum(bottoms - curves.horizon, _LEAST_RATIO * far)
        rows = curves.horizon + near[:, None] + np.outer(far - near, _SHARES)
        columns = curves.x(rows)
        # The same points again, one step to the right, for the derivatives by the columns.
        pixels = np.empty((2, *rows.shape, 2))
        pixels[0, ..., 0], pixels[1, ..., 0], pixels[..., 1] = columns, columns + _COLUMN_STEP, rows
        (x, shifted_x), (y, shifted_y) = self.points(pixels)
        # Distances in units of the farthest one keep the normal equations well conditioned.
        unit = np.abs(x).max(axis=1, keepdims=True)
        powers = np.ones((len(rows), 3, rows.shape[1]))
        powers[:, 1] = x / unit
        powers[:, 0] = powers[:, 1] ** 2
        normal = powers @ powers.transpose(0, 2, 1)
        # A lens that shows all points at one distance determines no parabola.
        normal[np.linalg.det(normal) < _LEAST_DETERMINANT] = np.nan
        solve = np.linalg.solve(normal, powers)
        solve[:, 0] /= unit**2
        solve[:, 1] /= unit
        coefficients = (solve @ y[:, :, None])[:, :, 0]
        # A point that moves along its parabola does not change it.
        slope = 2.0 * coefficients[:, :1] * x + coefficients[:, 1:2]
        by_column = ((shifted_y - y) - slope * (shifted_x - x)) / _COLUMN_STEP
        jacobian = solve @ (by_column[:, :, None] * curve_basis(curves.horizon, rows))
        return GroundCurves(coefficients, jacobian @ covariances @ jacobian.transpose(0, 2, 1))


def with_meters(result: FrameResult, camera: Camera, lens: Lens, yaw: Estimate, bottom: float) -> FrameResult:
    """Returns a `result` in pixels of `lens` with its boundaries and ego lane in meters too.

    `yaw` is the camera's in degrees, and `bottom` the lowest row of the image. The pitch follows from the horizon. If a
    value is not finite, because the distortion folds the image, meters are left out.
    """
    road, lanes = result.road, result.lanes
    if road is None or not lanes:
        return result
    column, curvature = road.vanishing_column, road.curvature
    # The last curve runs under the vehicle's middle in the road's direction, with the road's curvature.
    curves = Curves.concatenate(
        [
            Curves.of([lane.curve for lane in lanes]).below(result.horizon, bottom),
            Curves(result.horizon, np.array([[column.value, camera.middle(lens), curvature.value]])),
        ]
    )
    of_road = np.diag([column.sigma**2, 0.0, curvature.sigma**2])
    covariances = np.array([*(lane.covariance for lane in lanes), of_road])
    tops = [lane.top for lane in lanes]
    spans = np.array([[*tops, min(tops)], [*(lane.bottom for lane in lanes), bottom]])
    pitch = camera.pitch_at(lens, column.value, result.horizon)
    with np.errstate(all="ignore"):
        grounds = RoadPlane(camera, lens, pitch, math.radians(yaw.value)).parabolas(curves, covariances, *spans)
    if not (np.isfinite(grounds.coefficients).all() and np.isfinite(grounds.covariances).all()):
        return result
    return replace(
        result,
        lanes=tuple(
            replace(lane, ground=(a, b, c), ground_covariance=covariance)
            for lane, (a, b, c), covariance in zip(
                lanes, grounds.coefficients[:-1].tolist(), grounds.covariances[:-1], strict=True
            )
        ),
        ego=replace(result.ego, meters=_ego_meters(grounds, result, road, camera, yaw)),
    )


def _ego_meters(
    grounds: GroundCurves, result: FrameResult, road: RoadEstimate, camera: Camera, yaw: Estimate
) -> EgoMeters:
    """Returns the ego lane of a `result` whose boundaries, and then the road's direction, are `grounds`."""
    slope = grounds.estimate(1, {len(result.lanes): 1.0})
    meters = EgoMeters(
        # Headings are so small that their tangents have the same sigma.
        heading=Estimate(math.atan(slope.value), math.hypot(slope.sigma, math.radians(yaw.sigma))),
        curvature=grounds.estimate(0, {len(result.lanes): 2.0}),
        # All b fall with the lateral rate, and a boundary at Y has b = -Y / height.
        lateral_speed=Estimate(road.lateral_rate.value * camera.height, road.lateral_rate.sigma * camera.height),
    )
    index = {lane.track_id: i for i, lane in enumerate(result.lanes)}
    left, right = index.get(result.ego.left or 0), index.get(result.ego.right or 0)
    if left is not None:
        meters = replace(meters, left=grounds.estimate(2, {left: 1.0}))
    if right is not None:
        meters = replace(meters, right=grounds.estimate(2, {right: -1.0}))
    if left is None or right is None:
        return meters
    return replace(
        meters,
        # Y points left: a lane center at +Y means that the vehicle is that far to the right of it.
        offset=grounds.estimate(2, {left: 0.5, right: 0.5}),
        lane_width=grounds.estimate(2, {left: 1.0, right: -1.0}),
    )
