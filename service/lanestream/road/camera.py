"""A camera over a flat road: its lens and where it is mounted.

Camera frame: x right, y down, z forward. Vehicle frame: meters, X forward, Y left, Z up, origin on the road under the
vehicle's middle, at the camera's place along the vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal

import cv2
import numpy as np

from lanestream.road.curve import FloatArray

Auto = Literal["auto"]
Distortion = tuple[float, float, float, float, float]

_NO_DISTORTION: Final[Distortion] = (0.0, 0.0, 0.0, 0.0, 0.0)
# Undistortion is iterative: it ends after so many steps, or at an error of so many focal lengths.
_UNDISTORT: Final = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
# Detectors place no horizon outside these shares of the image height.
_HORIZONS: Final = (-1.0, 0.95)


@dataclass(frozen=True)
class Lens:
    """The projection of a lens in the pixels of one image size.

    `fx` and `fy` are focal lengths, (`cx`, `cy`) is the principal point, and `distortion` holds k1, k2, p1, p2 and k3
    of OpenCV's model.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = _NO_DISTORTION

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Returns the rays (..., 2) of `pixels` (..., 2): x / z and y / z in the camera frame, without distortion."""
        if self.distortion == _NO_DISTORTION:
            rays: FloatArray = (pixels - (self.cx, self.cy)) / (self.fx, self.fy)
            return rays
        flat = np.ascontiguousarray(pixels, dtype=float).reshape(-1, 1, 2)
        # In OpenCV 5 `undistortPoints` takes the criteria itself.
        undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
        found = undistort(flat, self._matrix, np.array(self.distortion), R=np.eye(3), P=np.eye(3), criteria=_UNDISTORT)
        return np.asarray(found, dtype=float).reshape(pixels.shape)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """Returns the pixels (..., 2) at which the lens shows `rays` (..., 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        seen_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        seen_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([self.cx + self.fx * seen_x, self.cy + self.fy * seen_y], axis=-1)

    @property
    def _matrix(self) -> FloatArray:
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Camera:
    """A camera on a vehicle.

    Lens, in pixels of an image of `image_size` (width, height), or of the camera's frames if that is None: either the
    horizontal `field_of_view` of the whole image in degrees (without distortion) or the `focal_length` (fx, fy); the
    `principal_point` (cx, cy), by default the middle of the image; and OpenCV's `distortion` (k1, k2, p1, p2, k3).

    Mount: `height` above the road in meters. The camera looks `pitch` degrees down, `yaw` degrees to the left of the
    vehicle's direction, and is turned `roll` degrees clockwise, as the driver sees it. It is `lateral` meters left of
    the vehicle's middle. "auto" estimates pitch or yaw while driving. With a pitch of None or "auto", that of each
    frame follows from its horizon; otherwise it fixes the horizon's row.
    """

    height: float
    field_of_view: float | None = None
    focal_length: tuple[float, float] | None = None
    principal_point: tuple[float, float] | None = None
    image_size: tuple[int, int] | None = None
    distortion: Distortion = _NO_DISTORTION
    pitch: float | Auto | None = None
    yaw: float | Auto = 0.0
    roll: float = 0.0
    lateral: float = 0.0

    @property
    def calibrates(self) -> bool:
        """Whether its direction is to be estimated."""
        return "auto" in (self.pitch, self.yaw)

    @property
    def fixed_pitch(self) -> float | None:
        """The configured pitch in degrees; None if it follows from each frame's horizon."""
        return None if self.pitch == "auto" else self.pitch

    @property
    def fixed_yaw(self) -> float | None:
        """The configured yaw in degrees; None if it is to be estimated."""
        return None if self.yaw == "auto" else self.yaw

    def lens(self, frame: tuple[int, int], size: tuple[int, int]) -> Lens:
        """Returns the lens in pixels of a frame that is resized from the size `frame` to `size` (width, height).

        Raises ValueError if the camera has neither a field of view nor focal lengths.
        """
        width, height = self.image_size or frame
        if self.focal_length is not None:
            fx, fy = self.focal_length
        elif self.field_of_view is not None:
            fx = fy = width / (2.0 * math.tan(math.radians(self.field_of_view) / 2.0))
        else:
            raise ValueError("a camera needs its field of view or its focal lengths")
        cx, cy = self.principal_point or ((width - 1) / 2.0, (height - 1) / 2.0)
        by_x, by_y = size[0] / width, size[1] / height
        # Pixel centers are at integers.
        center = (cx + 0.5) * by_x - 0.5, (cy + 0.5) * by_y - 0.5
        return Lens(fx * by_x, fy * by_y, *center, self.distortion)

    def pitch_at(self, lens: Lens, column: float, row: float) -> float:
        """Returns the pitch in radians, down, of a frame whose parallel lines meet at a pixel of the horizon."""
        x, y = lens.rays(np.array([column, row])).tolist()
        roll = math.radians(self.roll)
        return -math.atan(x * math.sin(roll) + y * math.cos(roll))

    def horizon(self, lens: Lens, height: int) -> float:
        """Returns the horizon's row in an image `height` pixels high that the configured pitch implies; 0 if none is.

        It is the row of the point straight ahead of the vehicle, or the nearest row that detectors accept.
        """
        pitch, yaw = math.radians(self.fixed_pitch or 0.0), math.radians(self.fixed_yaw or 0.0)
        x, y, z = camera_from_vehicle(pitch, yaw, math.radians(self.roll))[:, 0]
        row = float(lens.pixels(np.array([x / z, y / z]))[1])
        return min(max(row, _HORIZONS[0] * height), _HORIZONS[1] * height)

    def middle(self, lens: Lens) -> float:
        """Returns the slope b of the vehicle's middle line in the image, see `Curve`; 0 for a level camera in it.

        This neglects pitch and yaw: the line runs through the vanishing point, and in a level camera the line at the
        lateral position Y has the slope -Y / height.
        """
        level = self.lateral / self.height
        cos, sin = math.cos(math.radians(self.roll)), math.sin(math.radians(self.roll))
        return (level * cos + sin) / (cos - level * sin) * lens.fx / lens.fy


def camera_from_vehicle(pitch: float, yaw: float, roll: float) -> FloatArray:
    """Returns the rotation (3, 3) from the vehicle frame to the camera frame, for angles in radians as of `Camera`."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    # To a level camera at the yaw: x right, y down, z forward.
    turn = np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])
    cos, sin = math.cos(pitch), math.sin(pitch)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    cos, sin = math.cos(roll), math.sin(roll)
    bank = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    rotation: FloatArray = bank @ tilt @ turn
    return rotation
