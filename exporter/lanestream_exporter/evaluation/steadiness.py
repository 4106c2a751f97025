"""How steady a method is on a clip: frames with both ego boundaries, jitter, and changes of identity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.boundaries import Found, match_ego
from lanestream_exporter.evaluation.outcomes import Outcome

# The rows, as shares of the height, at which jitter is measured: on the road whatever the camera.
_ROWS = np.array([0.7, 0.8, 0.9])


def steadiness(
    reported: Sequence[tuple[Found, ...]], labelled: Sequence[Outcome], size: tuple[int, int]
) -> dict[str, Any]:
    """Figures of a clip of `size` (width, height): what was reported for each frame, and the outcomes of labelled ones.

    Jitter is the standard deviation of the second difference of the ego boundaries' columns over three frames in a row
    that report the same boundary at a row, in pixels at 640 wide: what moves evenly has none.
    """
    both = sum({-1, 1} <= {f.position for f in found} for found in reported)
    second: list[FloatArray] = [d for side in (-1, 1) for d in _second_differences(reported, side, size)]
    values = np.concatenate([np.zeros(0), *second])
    return {
        "frames": len(reported),
        "both_ego_frames": both,
        "both_ego": round(both / len(reported), 4) if reported else None,
        "jitter_px_640": round(float(np.std(values)), 4) if len(values) else None,
        "jitter_samples": len(values),
        "id_switches": _id_switches(labelled),
    }


def _second_differences(reported: Sequence[tuple[Found, ...]], side: int, size: tuple[int, int]) -> list[FloatArray]:
    width, height = size
    mine = [next((f for f in found if f.position == side), None) for found in reported]
    result = []
    for three in zip(mine, mine[1:], mine[2:], strict=False):
        a, b, c = three
        if a is None or b is None or c is None or not a.track_id == b.track_id == c.track_id:
            continue
        rows = _ROWS * height
        rows = rows[(rows >= max(f.top for f in (a, b, c))) & (rows <= min(f.bottom for f in (a, b, c)))]
        x = [f.curve.x(rows) * 640.0 / width for f in (a, b, c)]
        result.append(np.asarray(x[0] - 2.0 * x[1] + x[2]))
    return result


def _id_switches(labelled: Sequence[Outcome]) -> int | None:
    """How often a labelled ego boundary, by its own identity, is next found under another one; None without any."""
    last: dict[int, int] = {}
    switches, told = 0, False
    for outcome in labelled:
        for pair in match_ego(outcome.found, outcome.frame).pairs:
            mine, theirs = outcome.found[pair.found].track_id, pair.label.lane_id
            if mine is None or theirs is None:
                continue
            told = True
            switches += last.get(theirs, mine) != mine
            last[theirs] = mine
    return switches if told else None
