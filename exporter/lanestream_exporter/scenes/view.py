"""The road as the camera sees it: road coordinates (s, u) to image pixels and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from lanestream_exporter.scenes.camera import Camera, FloatArray
    from lanestream_exporter.scenes.road import Course, Pose

Layer = NDArray[np.float32]

REACH = 260.0  # metres of road ahead that are drawn
BEHIND = 12.0  # metres of road behind the camera that the centreline starts from
STEEPEST = math.radians(60.0)  # no road is drawn as turning away further than this, so that x grows with s


@dataclass(frozen=True)
class Band:
    """The pixels of a stripe of road: flat indices into the grid, and where each of them lies. All (N,)."""

    index: NDArray[np.int64]
    u: Layer  # metres to the left of the reference line
    s: Layer  # metres along the road
    across: Layer  # what the pixel covers across the road, metres
    along: Layer  # what the pixel covers along the road, metres
    distance: Layer  # forward distance, metres

    def between(self, low: float, high: float) -> Band:
        """The pixels of this band from s = low to s = high."""
        inside = (self.s >= low) & (self.s <= high)
        return Band(*(values[inside] for values in vars(self).values()))


@dataclass(frozen=True)
class RoadView:
    """The centreline ahead of the vehicle, sampled every metre of road, in the vehicle frame."""

    camera: Camera
    bend: float
    s: FloatArray
    x: FloatArray
    y: FloatArray
    direction: FloatArray  # radians, anticlockwise from the vehicle's x axis
    bearing: float  # of the camera, radians, anticlockwise from the road's direction at s = 0

    @classmethod
    def ahead(cls, camera: Camera, course: Course, pose: Pose) -> RoadView:
        """The view from `pose`: integrates the course into the vehicle frame."""
        s = pose.s + np.arange(-BEHIND, REACH + 1.0)
        here = round(BEHIND)
        turned = _cumulative(course.curvature(s))
        direction = np.clip(turned - turned[here] - pose.heading, -STEEPEST, STEEPEST)
        x, y = _cumulative(np.cos(direction)), _cumulative(np.sin(direction))
        # The reference line passes the vehicle at -u along the road's normal.
        x += pose.u * math.sin(-pose.heading) - x[here]
        y += -pose.u * math.cos(pose.heading) - y[here]
        bearing = course.bearing(pose.s) + pose.heading
        return cls(camera, course.bend, s, x, y, direction, bearing)

    @cached_property
    def reach(self) -> float:
        """Farthest forward distance of visible road, metres."""
        return self.camera.road_reach(self.bend, float(self.x[-1]))

    @property
    def here(self) -> float:
        """Road position s of the vehicle, metres."""
        return float(self.s[0]) + BEHIND

    def spans(self, low: float, high: float) -> bool:
        """Whether any road from s = low to high is in reach."""
        return low < float(self.s[-1]) and high > float(self.s[0])

    def place(self, s: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Vehicle-frame x and y in metres of road points."""
        x, y, direction = (np.interp(s, self.s, values) for values in (self.x, self.y, self.direction))
        return x - u * np.sin(direction), y + u * np.cos(direction)

    def project(self, s: FloatArray, u: FloatArray, z: FloatArray) -> FloatArray:
        """Image points (N, 2) of road points at height z in metres. Points behind the lens come out at 0.1 m."""
        x, y = self.place(s, u)
        return self.image(x, y, z)

    def image(self, x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
        """Image points (N, 2) of vehicle-frame points at height z above the road."""
        x = np.maximum(x, 0.1)
        ground = self.bend * x**2 / 2.0
        return np.stack([self.camera.columns(x, y), self.camera.rows(x, z + ground)], axis=-1)

    def boundary(self, rows: FloatArray, u: float) -> FloatArray:
        """Image columns at which the line u = constant crosses the rows: the exact inverse of `Grid.u`."""
        x = self.camera.road_distance(rows, self.bend)
        y, direction = (np.interp(x, self.x, values) for values in (self.y, self.direction))
        return self.camera.columns(x, y + u / np.cos(direction))


@dataclass(frozen=True)
class Grid:
    """Road coordinates of every pixel that sees the ground, from image row `top` to the last row."""

    view: RoadView
    top: int
    x: Layer  # (rows,) forward distance, metres
    along: Layer  # (rows,) what a pixel covers along the road, metres
    y: Layer  # (rows,) the reference line
    direction: Layer  # (rows,) of the road, radians
    u: Layer  # (rows, width)
    s: Layer  # (rows, width)

    @classmethod
    def of(cls, view: RoadView) -> Grid:
        """The ground of a view: one pass over the rows below the horizon or the crest."""
        camera = view.camera
        rows = np.arange(camera.height, dtype=np.float64)
        distance = camera.road_distance(rows, view.bend)
        top = int(np.argmax(np.append(distance <= camera.road_reach(view.bend, REACH), True)))
        exact = distance[top:]
        footprint = 1.0 / (camera.focal * np.maximum(camera.mount / exact**2 + view.bend / 2.0, 1e-9))
        y, direction, s = (
            np.interp(exact, view.x, values).astype(np.float32) for values in (view.y, view.direction, view.s)
        )
        x = exact.astype(np.float32)
        ray = ((camera.centre - np.arange(camera.width)) / camera.focal).astype(np.float32)
        side = x[:, None] * ray - y[:, None]
        u = side * np.cos(direction)[:, None]
        side *= np.sin(direction)[:, None]
        side += s[:, None]
        return cls(view, top, x=x, along=footprint.astype(np.float32), y=y, direction=direction, u=u, s=side)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the ground."""
        return self.u.shape[0], self.u.shape[1]

    def band(self, low: float, high: float) -> Band:
        """The pixels with low <= u <= high, one more on either side included."""
        camera, (rows, width) = self.view.camera, self.shape
        secant = 1.0 / np.cos(self.direction)
        left, right = (camera.centre - camera.focal * (self.y + u * secant) / self.x for u in (high, low))
        first = np.clip(np.floor(left) - 1, 0, width).astype(np.int64)
        last = np.clip(np.ceil(right) + 2, 0, width).astype(np.int64)
        counts = np.maximum(last - first, 0)
        start = np.cumsum(counts) - counts
        row = np.repeat(np.arange(rows), counts)
        index = np.arange(counts.sum()) + (first + width * np.arange(rows) - start)[row]
        x, along = self.x[row], self.along[row]
        # A line far to the side runs nearly along the image rows: the row's footprint then counts across it too.
        ray = (camera.centre - (index - row * width)).astype(np.float32) / np.float32(camera.focal)
        sideways = along * np.abs(ray - np.tan(self.direction)[row])
        across = np.hypot(x / np.float32(camera.focal), sideways) * np.cos(self.direction)[row]
        return Band(index, self.u.ravel()[index], self.s.ravel()[index], across, along, x)


def _cumulative(values: FloatArray) -> FloatArray:
    """Trapezoidal integral of samples one metre apart, starting at zero."""
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2.0)])


def coverage(offset: Layer, width: float | Layer, footprint: Layer) -> Layer:
    """Share of a pixel that a stripe covers: the pixel a box of `footprint` metres, `offset` from its middle."""
    half, reach = footprint / 2.0, np.float32(0.5) * width
    overlap = np.minimum(offset + half, reach) - np.maximum(offset - half, -reach)
    return np.asarray(np.maximum(overlap, 0.0) / footprint, dtype=np.float32)


def pulse(s: Layer, period: float, length: float, footprint: Layer) -> Layer:
    """Share of a pixel covered by marks of `length` repeating every `period` metres, the first starting at s = 0."""

    def filled(position: Layer) -> Layer:
        whole = np.floor(position / period)
        return np.asarray(whole * length + np.minimum(position - whole * period, length), dtype=np.float32)

    box = np.maximum(footprint, np.float32(0.02))
    half = box * np.float32(0.5)
    return np.asarray((filled(s + half) - filled(s - half)) / box, dtype=np.float32)
