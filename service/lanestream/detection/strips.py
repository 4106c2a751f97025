"""Strips along candidates, warped to the network's input: a candidate's marking stands upright in its patch.

Training and serving cut their patches here, so that the network sees in service what it saw in training.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from lanestream.detection.edges import resized
from lanestream.geometry import RoadView, Scaling, StripGeometry
from lanestream.lanes import Candidate, Image


@dataclass(frozen=True)
class StripCutter:
    """Cuts patches, `at_once` of them at a time.

    Images wider than the geometry's `detail_width` are reduced to it first, or their near rows would alias.
    """

    geometry: StripGeometry = StripGeometry()
    at_once: int = 6

    def cut(self, image: Image, candidates: Sequence[Candidate], view: RoadView) -> NDArray[np.uint8]:
        """RGB patches (N, size, size, 3) uint8 of a BGR image (H, W, 3), in the order of `candidates`."""
        return np.concatenate([part() for part in self.parts(image, candidates, view)])

    def parts(
        self, image: Image, candidates: Sequence[Candidate], view: RoadView
    ) -> tuple[Callable[[], NDArray[np.uint8]], ...]:
        """What cuts the patches, up to `at_once` of them each, in the order of `candidates`; at least one, of none."""
        scaling = Scaling(min(1.0, self.geometry.detail_width / view.width))
        detail = resized(image, scaling)
        detail_view = view.scaled(scaling, detail.shape[1], detail.shape[0])
        starts = range(0, max(len(candidates), 1), self.at_once)
        return tuple(
            partial(self._cut, detail, candidates[start : start + self.at_once], detail_view, scaling)
            for start in starts
        )

    def _cut(
        self, detail: Image, candidates: Sequence[Candidate], detail_view: RoadView, scaling: Scaling
    ) -> NDArray[np.uint8]:
        size = self.geometry.size
        patches = np.empty((len(candidates), size, size, 3), np.uint8)
        grid, warped = np.empty((2, size, size), np.float32), np.empty((size, size, 3), np.uint8)
        for candidate, patch in zip(candidates, patches, strict=True):
            curve = scaling.curve_to_working(candidate.curve)
            top, bottom = scaling.to_working(candidate.top), scaling.to_working(candidate.bottom)
            columns, rows = self.geometry.grid(curve, top, bottom, detail_view, out=grid)
            # The border is mirrored: black would tell the network where the image ends, which no road does.
            cv2.remap(detail, columns, rows, cv2.INTER_LINEAR, dst=warped, borderMode=cv2.BORDER_REFLECT_101)
            cv2.cvtColor(warped, cv2.COLOR_BGR2RGB, dst=patch)
        return patches
