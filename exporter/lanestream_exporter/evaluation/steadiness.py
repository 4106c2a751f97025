"""Steadiness of a method on a clip: frames with both ego boundaries, jitter, and identity switches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, match_ego
from lanestream_exporter.evaluation.outcomes import FrameEvaluation

# The rows, as shares of the height, at which jitter is measured; they show road with any typical camera.
_ROWS = np.array([0.7, 0.8, 0.9])


def steadiness(
    reported: Sequence[tuple[ReportedBoundary, ...]], labeled: Sequence[FrameEvaluation], size: tuple[int, int]
) -> dict[str, Any]:
    """Returns the figures of a clip of `size` (width, height).

    `reported` are the reports of all frames, `labeled` the outcomes of the labeled frames. Jitter is the standard
    deviation of the second difference of the ego boundaries' columns, in pixels at 640 wide, over three consecutive
    frames that report the same boundary at a row; uniform motion has no jitter.
    """
    both = sum({-1, 1} <= {report.position for report in reports} for reports in reported)
    differences: list[FloatArray] = [d for side in (-1, 1) for d in _second_differences(reported, side, size)]
    values = np.concatenate([np.zeros(0), *differences])
    return {
        "frames": len(reported),
        "both_ego_frames": both,
        "both_ego": round(both / len(reported), 4) if reported else None,
        "jitter_px_640": round(float(np.std(values)), 4) if len(values) else None,
        "jitter_samples": len(values),
        "id_switches": _id_switches(labeled),
    }


def _second_differences(
    reported: Sequence[tuple[ReportedBoundary, ...]], side: int, size: tuple[int, int]
) -> list[FloatArray]:
    width, height = size
    boundaries = [next((report for report in reports if report.position == side), None) for reports in reported]
    result = []
    for a, b, c in zip(boundaries, boundaries[1:], boundaries[2:], strict=False):
        if a is None or b is None or c is None or not a.track_id == b.track_id == c.track_id:
            continue
        rows = _ROWS * height
        rows = rows[(rows >= max(r.top for r in (a, b, c))) & (rows <= min(r.bottom for r in (a, b, c)))]
        x = [r.curve.x(rows) * 640.0 / width for r in (a, b, c)]
        result.append(np.asarray(x[0] - 2.0 * x[1] + x[2]))
    return result


def _id_switches(labeled: Sequence[FrameEvaluation]) -> int | None:
    """Returns how often the track id matched to a labeled ego boundary changes; None without ids.

    A boundary is identified by the lane id of its label.
    """
    last: dict[int, int] = {}
    switches, has_ids = 0, False
    for outcome in labeled:
        for match in match_ego(outcome.reports, outcome.frame).matches:
            track_id, lane_id = outcome.reports[match.index].track_id, match.label.lane_id
            if track_id is None or lane_id is None:
                continue
            has_ids = True
            switches += last.get(lane_id, track_id) != track_id
            last[lane_id] = track_id
    return switches if has_ids else None
