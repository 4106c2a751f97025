"""Labelled frames in memory, whatever file they came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class LabelledLane:
    """One lane boundary as a labeller (or the renderer) drew it.

    `points` is an (N, 2) float array of image pixels (x right, y down, pixel centres at integers), from the lowest
    visible row upwards, on the centre of the marking. `lane_id` stays with the physical boundary through a clip.
    `position` is -1 for ego left, +1 for ego right, -2 and +2 for the next ones out, or None where nobody said.
    """

    points: NDArray[np.float64]
    lane_id: int | None = None
    position: int | None = None
    kind: str | None = None
    color: str | None = None


@dataclass(frozen=True)
class Coverage:
    """What labels may have left out.

    `ego`: the ego lane's boundaries are labelled wherever they can be told, so that one without a label is absent.
    `open_sides`: the sides, -1 left and 1 right, on which there may be more boundaries beyond the outermost label.
    """

    ego: bool = False
    open_sides: tuple[int, ...] = (-1, 1)


PARTIAL = Coverage()
EGO_LANE = Coverage(ego=True)
WHOLE = Coverage(ego=True, open_sides=())


@dataclass(frozen=True)
class LabelledFrame:
    """The labels of one frame: its size in pixels, its lane boundaries, and what they cover.

    `group` names the drive or clip, the unit that a split may not divide.
    """

    width: int
    height: int
    lanes: tuple[LabelledLane, ...]
    group: str
    source: str
    coverage: Coverage = PARTIAL

    def open_to(self, side: int) -> bool:
        """Whether a boundary beyond the outermost label on that side, -1 left or 1 right, is unknown, not absent.

        Where the ego lane's boundary of the side is known to be absent, those farther out can't be seen either.
        """
        labelled = any((lane.position or 0) * side > 0 for lane in self.lanes)
        return side in self.coverage.open_sides and (labelled or not self.coverage.ego)
