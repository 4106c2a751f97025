"""The camera, and the mapping between road coordinates (s, u) and image pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lanestream.road.curve import FloatArray
    from lanestream_exporter.scenes.road import Course, Pose

Float32Array = NDArray[np.float32]

REACH = 260.0  # meters of road drawn ahead of the vehicle
BEHIND = 12.0  # meters of centerline behind the camera
MAX_DIRECTION = math.radians(60.0)  # the road direction is clipped to this, so that x always grows with s


@dataclass(frozen=True)
class PinholeCamera:
    """A level pinhole camera above the road, in the vehicle frame (meters, x forward, y left, z up from the road).

    The image plane stays upright and pitch only moves the horizon, as in a shift lens. Every image row then sees the
    road at a single distance x, so the inverse mapping needs one value per row. For the few degrees of pitch of a dash
    camera, the difference from a tilted image plane is smaller than the spread of real lenses.
    """

    width: int  # pixels
    height: int  # pixels
    field_of_view: float  # horizontal, degrees
    mount_height: float  # of the lens above the road, meters
    horizon: float  # image row of the road plane's vanishing line, pixels

    @property
    def focal(self) -> float:
        """Returns the focal length in pixels."""
        return self.width / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))

    @property
    def center(self) -> float:
        """Returns the image column of the optical axis, pixels."""
        return (self.width - 1) / 2.0

    def columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Returns the image columns of points at forward distance x and lateral position y, meters."""
        return self.center - self.focal * y / x

    def rows(self, x: FloatArray, z: FloatArray) -> FloatArray:
        """Returns the image rows of points at forward distance x and height z, meters."""
        return self.horizon + self.focal * (self.mount_height - z) / x

    def road_distance(self, rows: FloatArray, vertical_curvature: float) -> FloatArray:
        """Returns the forward distance x in meters of the road seen at each image row; infinity if no road is seen.

        With the vertical curvature c the road surface is z = c x^2 / 2, so x solves
        c x^2 / 2 + (row - horizon) x / focal - mount_height = 0.
        """
        slope = (rows - self.horizon) / self.focal
        root = slope**2 + 2.0 * vertical_curvature * self.mount_height
        denominator = slope + np.sqrt(np.maximum(root, 0.0))
        seen = (root >= 0.0) & (denominator > 1e-6)
        return np.where(seen, 2.0 * self.mount_height / np.where(seen, denominator, 1.0), np.inf)

    def road_reach(self, vertical_curvature: float, limit: float) -> float:
        """Returns the farthest visible forward distance x in meters: the crest if the road has one, else `limit`."""
        if vertical_curvature >= 0.0:
            return limit
        return min(limit, math.sqrt(2.0 * self.mount_height / -vertical_curvature))


@dataclass(frozen=True)
class GroundBand:
    """The pixels of a band of road at constant u: flat indices into the grid and their road coordinates. All (N,)."""

    index: NDArray[np.int64]
    u: Float32Array  # meters to the left of the reference line
    s: Float32Array  # meters along the road
    across: Float32Array  # footprint of the pixel across the road, meters
    along: Float32Array  # footprint of the pixel along the road, meters
    distance: Float32Array  # forward distance, meters

    def within(self, low: float, high: float) -> GroundBand:
        """Returns the pixels of this band from s = low to s = high."""
        inside = (self.s >= low) & (self.s <= high)
        return GroundBand(*(values[inside] for values in vars(self).values()))


@dataclass(frozen=True)
class RoadProjection:
    """The centerline ahead of the vehicle, sampled every meter of road, in the vehicle frame."""

    camera: PinholeCamera
    vertical_curvature: float
    s: FloatArray
    x: FloatArray
    y: FloatArray
    direction: FloatArray  # radians, counterclockwise from the vehicle's x axis
    bearing: float  # of the camera, radians, counterclockwise from the road's direction at s = 0

    @classmethod
    def from_pose(cls, camera: PinholeCamera, course: Course, pose: Pose) -> RoadProjection:
        """Integrates the course into the vehicle frame of `pose`."""
        s = pose.s + np.arange(-BEHIND, REACH + 1.0)
        vehicle = round(BEHIND)
        heading_change = _cumulative(course.curvature(s))
        direction = np.clip(heading_change - heading_change[vehicle] - pose.heading, -MAX_DIRECTION, MAX_DIRECTION)
        x, y = _cumulative(np.cos(direction)), _cumulative(np.sin(direction))
        # The reference line passes the vehicle at -u along the road's normal.
        x += pose.u * math.sin(-pose.heading) - x[vehicle]
        y += -pose.u * math.cos(pose.heading) - y[vehicle]
        bearing = course.bearing(pose.s) + pose.heading
        return cls(camera, course.vertical_curvature, s, x, y, direction, bearing)

    @cached_property
    def reach(self) -> float:
        """Returns the farthest forward distance of visible road, meters."""
        return self.camera.road_reach(self.vertical_curvature, float(self.x[-1]))

    @property
    def vehicle_s(self) -> float:
        """Returns the road position s of the vehicle, meters."""
        return float(self.s[0]) + BEHIND

    def overlaps(self, low: float, high: float) -> bool:
        """Returns whether any of the road from s = low to s = high is within reach."""
        return low < float(self.s[-1]) and high > float(self.s[0])

    def to_vehicle(self, s: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns vehicle-frame x and y in meters of road points."""
        x, y, direction = (np.interp(s, self.s, values) for values in (self.x, self.y, self.direction))
        return x - u * np.sin(direction), y + u * np.cos(direction)

    def project(self, s: FloatArray, u: FloatArray, z: FloatArray) -> FloatArray:
        """Returns image points (N, 2) of road points at height z in meters; x is clipped to at least 0.1 m."""
        x, y = self.to_vehicle(s, u)
        return self.project_vehicle(x, y, z)

    def project_vehicle(self, x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        """Returns image points (N, 2) of vehicle-frame points at height z above the road; x is clipped to 0.1 m."""
        x = np.maximum(x, 0.1)
        ground = self.vertical_curvature * x**2 / 2.0
        return np.stack([self.camera.columns(x, y), self.camera.rows(x, z + ground)], axis=-1)

    def boundary_columns(self, rows: FloatArray, u: float | FloatArray) -> FloatArray:
        """Returns the image columns of the line u = constant at the rows: the exact inverse of `GroundGrid.u`."""
        x = self.camera.road_distance(rows, self.vertical_curvature)
        y, direction = (np.interp(x, self.x, values) for values in (self.y, self.direction))
        return self.camera.columns(x, y + u / np.cos(direction))

    def road_positions(self, rows: FloatArray, u: float | FloatArray) -> FloatArray:
        """Returns the road positions s of the line u = constant at the rows: the exact inverse of `GroundGrid.s`."""
        x = self.camera.road_distance(rows, self.vertical_curvature)
        s, direction = (np.interp(x, self.x, values) for values in (self.s, self.direction))
        return np.asarray(s + u * np.tan(direction))


@dataclass(frozen=True)
class GroundGrid:
    """The road coordinates of every pixel that sees the ground, from image row `top` to the last row."""

    projection: RoadProjection
    top: int
    x: Float32Array  # (rows,) forward distance, meters
    along: Float32Array  # (rows,) footprint of a pixel along the road, meters
    y: Float32Array  # (rows,) the reference line
    direction: Float32Array  # (rows,) of the road, radians
    u: Float32Array  # (rows, width)
    s: Float32Array  # (rows, width)

    @classmethod
    def from_projection(cls, projection: RoadProjection) -> GroundGrid:
        """Computes the grid for all rows below the horizon or the crest."""
        camera = projection.camera
        rows = np.arange(camera.height, dtype=np.float64)
        distance = camera.road_distance(rows, projection.vertical_curvature)
        top = int(np.argmax(np.append(distance <= camera.road_reach(projection.vertical_curvature, REACH), True)))
        exact = distance[top:]
        footprint = 1.0 / (
            camera.focal * np.maximum(camera.mount_height / exact**2 + projection.vertical_curvature / 2.0, 1e-9)
        )
        y, direction, s = (
            np.interp(exact, projection.x, values).astype(np.float32)
            for values in (projection.y, projection.direction, projection.s)
        )
        x = exact.astype(np.float32)
        ray = ((camera.center - np.arange(camera.width)) / camera.focal).astype(np.float32)
        side = x[:, None] * ray - y[:, None]
        u = side * np.cos(direction)[:, None]
        side *= np.sin(direction)[:, None]
        side += s[:, None]
        return cls(projection, top, x=x, along=footprint.astype(np.float32), y=y, direction=direction, u=u, s=side)

    @property
    def shape(self) -> tuple[int, int]:
        """Returns the number of rows and columns of the ground."""
        return self.u.shape[0], self.u.shape[1]

    def band(self, low: float, high: float) -> GroundBand:
        """Returns the pixels with low <= u <= high, plus one more on either side of each row."""
        camera, (rows, width) = self.projection.camera, self.shape
        secant = 1.0 / np.cos(self.direction)
        left, right = (camera.center - camera.focal * (self.y + u * secant) / self.x for u in (high, low))
        first = np.clip(np.floor(left) - 1, 0, width).astype(np.int64)
        last = np.clip(np.ceil(right) + 2, 0, width).astype(np.int64)
        counts = np.maximum(last - first, 0)
        start = np.cumsum(counts) - counts
        row = np.repeat(np.arange(rows), counts)
        index = np.arange(counts.sum()) + (first + width * np.arange(rows) - start)[row]
        x, along = self.x[row], self.along[row]
        # A line far to the side runs nearly parallel to the image rows, so the row's footprint also extends across it.
        ray = (camera.center - (index - row * width)).astype(np.float32) / np.float32(camera.focal)
        sideways = along * np.abs(ray - np.tan(self.direction)[row])
        across = np.hypot(x / np.float32(camera.focal), sideways) * np.cos(self.direction)[row]
        return GroundBand(index, self.u.ravel()[index], self.s.ravel()[index], across, along, x)


def _cumulative(values: FloatArray) -> FloatArray:
    """Returns the trapezoidal integral of samples one meter apart, starting at zero."""
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2.0)])


def coverage(offset: Float32Array, width: float | Float32Array, footprint: Float32Array) -> Float32Array:
    """Returns the share of each pixel that a stripe covers; a pixel is a box of `footprint` meters at `offset`."""
    half, reach = footprint / 2.0, np.float32(0.5) * width
    overlap = np.minimum(offset + half, reach) - np.maximum(offset - half, -reach)
    return np.asarray(np.maximum(overlap, 0.0) / footprint, dtype=np.float32)


def pulse(s: Float32Array, period: float, length: float, footprint: Float32Array) -> Float32Array:
    """Returns the share of each pixel covered by marks of `length` every `period` meters, the first at s = 0."""

    def filled(position: Float32Array) -> Float32Array:
        periods = np.floor(position / period)
        return np.asarray(periods * length + np.minimum(position - periods * period, length), dtype=np.float32)

    box = np.maximum(footprint, np.float32(0.02))
    half = box * np.float32(0.5)
    return np.asarray((filled(s + half) - filled(s - half)) / box, dtype=np.float32)
