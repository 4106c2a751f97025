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
class LabelledFrame:
    """The labels of one frame: its size in pixels and its lane boundaries.

    `exhaustive` says that every visible boundary is labelled; where it is False, what lies outside the outermost
    label is unknown rather than absent. `group` names the drive or clip, the unit that a split may not divide.
    """

    width: int
    height: int
    lanes: tuple[LabelledLane, ...]
    group: str
    source: str
    exhaustive: bool = False
