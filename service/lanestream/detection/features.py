"""What boundaries are searched in: gray images of a frame, and its edge pixels with their gradient directions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.view import Image


@dataclass(frozen=True)
class Edges:
    """Edge pixels of a working image, one array entry per pixel.

    `x` and `y` are columns and rows, `angle` is the gradient's direction in degrees [0, 360), from dark to bright with
    y down, and `weight` (0 to 1) its strength relative to its surroundings.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    angle: NDArray[np.float32]
    weight: NDArray[np.float32]


@dataclass(frozen=True)
class Channels:
    """Two gray images (H, W) uint8 of a frame.

    In `paint`, the mean of green and red, white and yellow paint are both bright: yellow differs from concrete in blue,
    which luminance includes. In `blue`, grass and earth are darker than any asphalt.
    """

    paint: Image
    blue: Image

    @classmethod
    def of(cls, image: Image) -> Channels:
        """Returns the channels of a BGR image (H, W, 3)."""
        blue, green, red = (cv2.extractChannel(image, channel) for channel in range(3))
        paint = np.asarray(cv2.addWeighted(green, 0.5, red, 0.5, 0.0), dtype=np.uint8)
        return cls(paint, np.asarray(blue, dtype=np.uint8))


def find_edges(gray: Image, top: int) -> Edges:
    """Returns the Canny edges of the rows from `top` down, with their Sobel directions.

    Gradients are divided by their local mean first, so that one pair of thresholds works on a road half in shadow, in
    the sun and at night. A floor keeps sensor noise from counting as edges.
    """
    region = cv2.GaussianBlur(gray[top:], (3, 3), 0.8)
    dx = cv2.Sobel(region, cv2.CV_32F, 1, 0, ksize=3)
    dy = cv2.Sobel(region, cv2.CV_32F, 0, 1, ksize=3)
    magnitude = cv2.magnitude(dx, dy)
    # 24 gray levels of a 3 x 3 Sobel are a step of six levels: about the noise of a dark dash-cam frame.
    gain = 128.0 / (cv2.blur(magnitude, (63, 31)) + 24.0)
    edges = cv2.Canny((dx * gain).astype(np.int16), (dy * gain).astype(np.int16), 120, 280, L2gradient=True)
    points = cv2.findNonZero(edges)
    # OpenCV 4 returns (N, 1, 2), OpenCV 5 returns (N, 2).
    columns, rows = np.empty((2, 0), np.int32) if points is None else points.reshape(-1, 2).T
    at = rows * edges.shape[1] + columns
    angle = np.degrees(np.arctan2(dy.take(at), dx.take(at))) % 360.0
    weight = np.minimum(magnitude.take(at) * gain.take(at) / 640.0, 1.0)
    return Edges(
        columns.astype(np.float32), (rows + top).astype(np.float32), angle.astype(np.float32), weight.astype(np.float32)
    )
