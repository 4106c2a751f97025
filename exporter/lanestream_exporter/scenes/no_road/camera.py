"""A pinhole camera that can be turned any way, and the flat things and boxes that it draws.

World: x right, y down, z ahead, meters; the camera is at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.view import Image
from lanestream_exporter.scenes.no_road.colors import BgrColor, shaded, with_gain
from lanestream_exporter.scenes.random_sampler import RandomSampler

Vector = NDArray[np.float64]

SUBPIXELS: Final = 4  # binary digits after the point of the corners of polygons
_NEAREST: Final = 0.05  # distance in front of the camera from which things are drawn, meters
_FARTHEST_CORNER: Final = 2.0**28  # OpenCV overflows beyond, fixed-point pixels


@dataclass(frozen=True)
class TurnedCamera:
    """A pinhole camera at the origin and the image that it draws on."""

    image: Image
    projection: Vector  # (3, 3), from world points to homogeneous pixels

    @classmethod
    def looking(cls, image: Image, field_of_view: float, turns: tuple[float, float, float]) -> TurnedCamera:
        """Returns a camera turned right, down and about its axis by three angles in degrees."""
        height, width = image.shape[:2]
        focal = max(width, height) / (2.0 * np.tan(np.radians(field_of_view) / 2.0))
        inner = np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])
        right, down, roll = np.radians(turns)
        about_y = [[np.cos(right), 0.0, -np.sin(right)], [0.0, 1.0, 0.0], [np.sin(right), 0.0, np.cos(right)]]
        about_x = [[1.0, 0.0, 0.0], [0.0, np.cos(down), -np.sin(down)], [0.0, np.sin(down), np.cos(down)]]
        about_z = [[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]]
        return cls(image, inner @ about_z @ about_x @ about_y)

    def outline(self, corners: Vector) -> NDArray[np.int32]:
        """Returns the part of a flat polygon (N, 3) in front of the camera, as (M, 2) fixed-point pixels."""
        points = corners @ self.projection.T
        kept = []
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            if start[2] >= _NEAREST:
                kept.append(start)
            if (start[2] >= _NEAREST) != (end[2] >= _NEAREST):
                kept.append(start + (end - start) * (_NEAREST - start[2]) / (end[2] - start[2]))
        if not kept:
            return np.zeros((0, 2), np.int32)
        visible = np.array(kept)
        pixels = visible[:, :2] / visible[:, 2:] * 2**SUBPIXELS
        return np.asarray(np.clip(pixels, -_FARTHEST_CORNER, _FARTHEST_CORNER).round(), dtype=np.int32)

    def show(self, texture: Image, corner: Vector, across: Vector, down: Vector) -> None:
        """Draws a texture on a parallelogram: its top left corner, and the vectors along its top and its left side."""
        outline = self.outline(np.stack([corner, corner + across, corner + across + down, corner + down]))
        height, width = self.image.shape[:2]
        to_pixels = self.projection @ np.stack([across / texture.shape[1], down / texture.shape[0], corner], axis=1)
        if len(outline) < 3 or abs(np.linalg.det(to_pixels)) < 1e-9:
            return
        pixels = outline >> SUBPIXELS
        left, top = np.maximum(pixels.min(axis=0), 0).tolist()
        right, bottom = np.minimum(pixels.max(axis=0) + 2, (width, height)).tolist()
        if left >= right or top >= bottom:
            return
        region = self.image[top:bottom, left:right]
        moved = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ to_pixels
        size = right - left, bottom - top
        seen = cv2.warpPerspective(texture, moved, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        mask = np.zeros(region.shape[:2], np.uint8)
        shift = np.array([left, top]) << SUBPIXELS
        cv2.fillPoly(mask, [(outline - shift).astype(np.int32)], 255, cv2.LINE_8, SUBPIXELS)
        cv2.copyTo(seen, mask, region)

    def fill(self, corners: Vector, color: BgrColor) -> None:
        """Draws a flat polygon (N, 3) of one color."""
        outline = self.outline(corners)
        if len(outline) >= 3:
            cv2.fillPoly(self.image, [outline], color, cv2.LINE_AA, SUBPIXELS)

    def bar(self, start: Vector, end: Vector, thickness: float, color: BgrColor) -> None:
        """Draws a straight bar that is about `thickness` meters thick."""
        side = np.cross(end - start, (start + end) / 2.0)
        side *= thickness / (2.0 * np.linalg.norm(side) + 1e-9)
        self.fill(np.stack([start - side, start + side, end + side, end - side]), color)

    def box(self, low: Vector, high: Vector, texture: Image, color: BgrColor) -> None:
        """Draws an upright box between two corners: the texture on its top and front, one color on its sides."""
        size = high - low
        x, y, z = np.diag(size)
        for sideways, seen in ((low[0], low[0] > 0.0), (high[0], high[0] < 0.0)):
            if seen:
                corner = np.array([sideways, low[1], low[2]])
                self.fill(np.stack([corner, corner + z, corner + z + y, corner + y]), shaded(color, 0.6))
        if low[1] > 0.0:
            self.show(texture, low + z, x, -z)
        self.show(with_gain(texture, 0.75), low, x, y)


def vector(x: float, y: float, z: float) -> Vector:
    """Returns a point or a direction in the world."""
    return np.array([x, y, z])


def sample_turns(
    sampler: RandomSampler, right: float, down: tuple[float, float], roll: float = 2.0
) -> tuple[float, float, float]:
    """Returns random turns to the right, down and about the axis, in degrees.

    `right` and `roll` are standard deviations around 0, and `down` is a range.
    """
    return sampler.normal(right), sampler.uniform(*down), sampler.normal(roll)
