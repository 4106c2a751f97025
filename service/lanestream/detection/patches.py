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

from lanestream.detection.features import resized
from lanestream.road.curve import curve_columns, curve_slopes
from lanestream.road.results import Candidate
from lanestream.road.view import Image, RoadView, Scaling

FloatMaps = NDArray[np.float32]


@dataclass(frozen=True)
class PatchGeometry:
    """How a strip along a candidate is cut: `size` x `size` network pixels, wide in proportion to the road's scale.

    At a row y the strip reaches `half_width` (y - horizon) to either side of its candidate, a constant width on a flat
    road, and never less than `min_half_width` pixels of a 640 pixel wide image. A candidate that leans by `slope`
    columns a row has a strip wider by hypot(1, lean slope): with a `lean` of 1 strips are equally wide across their
    candidates, as errors are counted across them; with 0 they are equally wide on the ground.
    """

    size: int = 112
    half_width: float = 0.33
    min_half_width: float = 4.0
    lean: float = 1.0

    @property
    def detail_width(self) -> int:
        """How wide an image may be before the near rows of its strips alias: that of 640 pixels for patches of 112."""
        return self.size * 40 // 7

    def grids(self, candidates: Sequence[Candidate], view: RoadView) -> tuple[FloatMaps, FloatMaps]:
        """Image columns and rows, each (N, size, size), that the pixels of the candidates' patches are sampled at."""
        top, bottom = np.array([(candidate.top, candidate.bottom) for candidate in candidates]).T[:, :, None]
        rows = top + (bottom - top) * np.linspace(0.0, 1.0, self.size)
        curves = [candidate.curve for candidate in candidates]
        slope = curve_slopes(curves, 0.5 * (top + bottom))
        least = self.min_half_width * view.width / 640.0
        half_widths = np.hypot(1.0, self.lean * slope) * np.maximum(self.half_width * (rows - view.horizon), least)
        across = np.linspace(-1.0, 1.0, self.size, dtype=np.float32)
        columns = half_widths.astype(np.float32)[:, :, None] * across
        columns += curve_columns(curves, rows).astype(np.float32)[:, :, None]
        return columns, np.broadcast_to(rows.astype(np.float32)[:, :, None], columns.shape)


@dataclass(frozen=True)
class PatchCutter:
    """Cuts patches, `at_once` of them at a time.

    Images wider than the geometry's `detail_width` are reduced to it first, or their near rows would alias.
    """

    geometry: PatchGeometry = PatchGeometry()
    at_once: int = 16

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
        if not candidates:
            return np.empty((0, size, size, 3), np.uint8)
        columns, rows = self.geometry.grids([_scaled(each, scaling) for each in candidates], detail_view)
        # One below the other they are one image to OpenCV. The border is mirrored: black would tell the network where
        # the image ends, which no road does.
        maps = columns.reshape(-1, size), rows.reshape(-1, size)
        strips = cv2.remap(detail, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        patches = cv2.cvtColor(strips, cv2.COLOR_BGR2RGB)
        return np.asarray(patches, np.uint8).reshape(-1, size, size, 3)


def _scaled(candidate: Candidate, scaling: Scaling) -> Candidate:
    """The candidate in working pixels."""
    top, bottom = scaling.to_working(candidate.top), scaling.to_working(candidate.bottom)
    return Candidate(scaling.curve_to_working(candidate.curve), top, bottom, candidate.strength)
