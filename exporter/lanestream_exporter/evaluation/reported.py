"""What a user would hand in to the field's benchmarks: the lanes beside the camera, as far as they can be told."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.boundaries import Found

# The benchmarks ask for the camera's lane and the next one on either side.
OUTERMOST: Final = 2

# How near to the horizon a boundary is reported, as a share of the depth below it: beyond its `top` the curve goes on.
# Chosen on the training split.
NEAREST: Final = 0.05


def reported_columns(found: Sequence[Found], rows: FloatArray, frame: LabelledFrame) -> list[FloatArray]:
    """Columns (R,) of each boundary of the camera's and the next lanes at `rows`, NaN where it is not reported.

    Each reaches from the border of the image, which may lie below its own `bottom`, up to its `farthest` row or almost
    its horizon. Pixels of the image; boundaries in view nowhere are left out.
    """
    lanes = []
    for boundary in found:
        if abs(boundary.position) > OUTERMOST:
            continue
        horizon = boundary.curve.horizon
        almost = horizon + NEAREST * (frame.height - 1.0 - horizon)
        highest = almost if boundary.farthest is None else boundary.farthest
        x = boundary.curve.x(rows)
        there = (rows >= highest) & (x >= 0.0) & (x <= frame.width - 1.0)
        if there.sum() >= 2:
            lanes.append(np.where(there, x, np.nan))
    return lanes
