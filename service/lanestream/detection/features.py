"""Edge pixels with their gradient directions: what votes in the extended Hough transform."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.view import Image, Scaling

WORKING_WIDTH = 640


@dataclass(frozen=True)
class Edges:
    """Edge pixels of a working image, one entry a pixel.

    `x` and `y` are columns and rows, `angle` is the gradient's direction in degrees [0, 360), pointing from dark to
    bright with y down, and `weight` (0 to 1) its strength against its surroundings.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    angle: NDArray[np.float32]
    weight: NDArray[np.float32]


def paint_grey(image: Image) -> Image:
    """A BGR image (H, W, 3) as grey levels (H, W) in which white and yellow paint are both bright.

    It is the mean of green and red: yellow differs from concrete in blue, which luminance would take into account.
    """
    green, red = cv2.extractChannel(image, 1), cv2.extractChannel(image, 2)
    return np.asarray(cv2.addWeighted(green, 0.5, red, 0.5, 0.0), dtype=np.uint8)


def resized(image: Image, scaling: Scaling) -> Image:
    """`image` at the working size of `scaling`."""
    if scaling.factor == 1.0:
        return image
    width, height = (max(1, round(side * scaling.factor)) for side in image.shape[1::-1])
    # Halving is cheap, and what is left of the way then needs no averages over areas, which are not.
    while image.shape[1] >= 2 * width and image.shape[0] >= 2 * height and not (image.shape[1] | image.shape[0]) & 1:
        halves = image.shape[1] // 2, image.shape[0] // 2
        image = np.asarray(cv2.resize(image, halves, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if image.shape[1::-1] == (width, height):
        return image
    how = cv2.INTER_AREA if image.shape[1] >= 2 * width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), dtype=np.uint8)


def find_edges(grey: Image, top: int) -> Edges:
    """Canny edges of the rows from `top` down, with their Sobel directions.

    Gradients are divided by their local mean first, so that one pair of thresholds serves a road half in the shadow, a
    sunlit one and one at night; a floor keeps sensor noise from being lifted to an edge.
    """
    region = cv2.GaussianBlur(grey[top:], (3, 3), 0.8)
    dx = cv2.Sobel(region, cv2.CV_32F, 1, 0, ksize=3)
    dy = cv2.Sobel(region, cv2.CV_32F, 0, 1, ksize=3)
    magnitude = cv2.magnitude(dx, dy)
    # 24 grey levels of a 3 x 3 Sobel are a step of six levels: about the noise of a dark dash-cam frame.
    gain = 128.0 / (cv2.blur(magnitude, (63, 31)) + 24.0)
    edges = cv2.Canny((dx * gain).astype(np.int16), (dy * gain).astype(np.int16), 120, 280, L2gradient=True)
    found = cv2.findNonZero(edges)
    columns, rows = np.empty((2, 0), np.int32) if found is None else found[:, 0].T
    at = rows * edges.shape[1] + columns
    angle = np.degrees(np.arctan2(dy.take(at), dx.take(at))) % 360.0
    weight = np.minimum(magnitude.take(at) * gain.take(at) / 640.0, 1.0)
    return Edges(
        columns.astype(np.float32),
        (rows + top).astype(np.float32),
        angle.astype(np.float32),
        weight.astype(np.float32),
    )
