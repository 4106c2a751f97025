"""What all detectors share: a detector takes one working image and returns the lane boundaries in it.

It gets network outputs through a callable and does not depend on runtimes, batching or threads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curves
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView

ModelRole = Literal["classifier", "regressor"]

# Returns the outputs (N, outputs) float32 of the model with that role for its inputs (N, size, size, 3) uint8 RGB.
Infer = Callable[[ModelRole, NDArray[np.uint8]], NDArray[np.float32]]


@dataclass(frozen=True)
class FrameContext:
    """What is known about a frame before detection, in pixels of the working image.

    `horizon` is its row, `tracked` are the boundaries of the last frame, `confirmed` those of them that several frames
    have shown, and `prior_horizon` is the row that the ego-lane prior of the last frame gave; each is None if unknown.
    The prior's row is steadier, because it does not depend on which boundaries are found. If `is_given`, the horizon is
    known from outside, except for pitch. If it `is_doubtful`, the prior has been uncertain for a while, and the horizon
    is searched for again.
    """

    horizon: float | None = None
    tracked: Curves | None = None
    prior_horizon: float | None = None
    is_given: bool = False
    is_doubtful: bool = False
    confirmed: Curves | None = None

    @property
    def expected_horizon(self) -> float | None:
        """The row at which the ego-lane prior is looked for; None if unknown."""
        return self.horizon if self.is_given or self.prior_horizon is None else self.prior_horizon


@dataclass(frozen=True)
class Detections:
    """The boundaries of one frame from left to right, in pixels of the working image.

    `view` has the horizon that fits them best, `horizon_weight` (0 to 1) is how much the frame reveals about its
    horizon, `prior_horizon` is the row for the next frame's context, and `fit_s` the seconds spent on fitting curves.
    `uncertainty` is that of the ego-lane prior (`RegressorOutput.uncertainty`).
    """

    boundaries: tuple[Detection, ...]
    view: RoadView
    horizon_weight: float
    prior_horizon: float | None = None
    fit_s: float = 0.0
    uncertainty: float = 0.0


class Detector(Protocol):
    """Finds lane boundaries. Detectors are immutable, and threads may share them."""

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        """Returns the boundaries in a BGR working image (H, 640, 3) uint8."""
        ...
