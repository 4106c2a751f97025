"""Images at another size, above all the working image that detectors see."""

from __future__ import annotations

import cv2
import numpy as np

from lanestream.road.view import Image, Scaling


def working_image(image: Image) -> tuple[Image, Scaling]:
    """Returns a BGR image (H, W, 3) uint8 at the working width, and the scaling between the two."""
    scaling = Scaling.to_working_width(image.shape[1])
    return resized(image, scaling.factor), scaling


def resized(image: Image, factor: float) -> Image:
    """Returns the image with its sides multiplied by `factor`."""
    if factor == 1.0:
        return image
    width, height = (max(1, round(side * factor)) for side in image.shape[1::-1])
    # Halving is cheap, and the rest of the way then needs no area interpolation, which is slow.
    while image.shape[1] >= 2 * width and image.shape[0] >= 2 * height and not (image.shape[1] | image.shape[0]) & 1:
        halves = image.shape[1] // 2, image.shape[0] // 2
        image = np.asarray(cv2.resize(image, halves, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if image.shape[1::-1] == (width, height):
        return image
    interpolation = cv2.INTER_AREA if image.shape[1] >= 2 * width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, (width, height), interpolation=interpolation), dtype=np.uint8)
