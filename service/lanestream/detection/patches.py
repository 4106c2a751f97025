"""Patches: the image strip along each candidate, warped to the classifier's input, with the boundary upright in it.

Training and serving both cut their patches here, so the network sees the same kind of input in both.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curves
from lanestream.road.view import Image, RoadView, Spans


def cut_patches(
    image: Image, curves: Curves, spans: Spans, view: RoadView, geometry: PatchGeometry
) -> NDArray[np.uint8]:
    """Returns RGB patches (N, size, size, 3) uint8 of a BGR working image along `curves` within their `spans`."""
    size = geometry.size
    if not len(curves):
        return np.empty((0, size, size, 3), np.uint8)
    columns, rows = geometry.grids(curves, spans, view)
    # Stacked vertically they are one image to OpenCV. The border is mirrored: a black one would show the network where
    # the image ends, which is not a property of the road.
    maps = columns.reshape(-1, size), rows.reshape(-1, size)
    strips = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    patches = cv2.cvtColor(strips, cv2.COLOR_BGR2RGB)
    return np.asarray(patches, np.uint8).reshape(-1, size, size, 3)
