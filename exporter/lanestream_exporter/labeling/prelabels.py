"""The lanes of a frame as polylines of a few points, which are easy to correct by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from lanestream.road.curve import FloatArray
from lanestream.road.results import FrameResult, LaneBoundary
from lanestream_exporter.datasets.labels import LabeledLane, points_inside
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.labeling.difficulty import Difficulty

_TOLERANCE: Final = 0.5  # pixels that the polyline may be off the curve
_DECIMALS: Final = 2  # of a pixel


@dataclass(frozen=True)
class PrelabeledFrame:
    """A frame with its pre-labels: the image file at `path`, its size in pixels, and its lanes.

    `source` names the frame in what was labeled, `stem` is what its image file is to be named after.
    """

    path: Path
    source: str
    stem: str
    width: int
    height: int
    lanes: tuple[LabeledLane, ...]
    difficulty: Difficulty


def prelabels(result: FrameResult, width: int, height: int, *, with_ids: bool) -> tuple[LabeledLane, ...]:
    """Returns the boundaries of a frame of this size in pixels as labels, with their track ids if `with_ids`.

    An edge of the road has the type `edge`. A marking that the network doesn't classify has no type.
    """
    return tuple(_lanes(result, width, height, with_ids))


def _lanes(result: FrameResult, width: int, height: int, with_ids: bool) -> Iterator[LabeledLane]:
    for boundary in result.lanes:
        points = points_inside(polyline(boundary), width, height)
        if len(points) < 2:
            continue
        report = ReportedBoundary.from_lane(boundary)
        lane_id = boundary.track_id if with_ids else None
        is_edge = report.kind == "road_edge"
        yield LabeledLane(
            points, lane_id, boundary.position, "edge" if is_edge else report.type, report.color, report.kind
        )


def polyline(boundary: LaneBoundary) -> FloatArray:
    """Returns points (N, 2) in pixels along a boundary, from its lowest row upwards, no more than its shape needs.

    Method: D. Douglas and T. Peucker, Algorithms for the reduction of the number of points, 1973.
    """
    count = max(2, round(boundary.bottom - boundary.top) + 1)
    rows = np.linspace(boundary.bottom, boundary.top, count)
    dense = np.stack([boundary.curve.x(rows), rows], axis=1).astype(np.float32)
    thinned = cv2.approxPolyDP(dense[:, None], _TOLERANCE, closed=False)
    return np.asarray(thinned[:, 0], dtype=float).round(_DECIMALS)
