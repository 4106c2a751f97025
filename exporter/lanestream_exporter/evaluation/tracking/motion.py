"""Jitter and lag, always together: smoothing harder lowers the one and raises the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from scipy.signal import savgol_filter

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.tracking.comparison import ClipRun, rounded

# The first two of a frame's steady rows are the bottom row and the far row, the others those of jitter.
LAG_ROWS: Final = {"bottom": 0, "far": 1}
_JITTER: Final = slice(2, None)
# Scales the median absolute deviation to the standard deviation of a normal distribution.
_NORMAL: Final = 1.4826
# Frames over which motion is smoothed. A stretch of fewer frames says nothing about lag.
_WINDOW: Final = 25

# The columns (T,) of a track in consecutive frames, and those of the boundary that it follows.
Stretch = tuple[FloatArray, FloatArray]


def motion_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns jitter and lag of clips with truth; see docs/evaluation.md."""
    differences = [values for run in runs for values in second_differences(run)]
    lags = {name: lag([pair for run in runs for pair in _stretches(run, row)]) for name, row in LAG_ROWS.items()}
    return {"jitter": jitter_figures(differences), "lag": lags}


def jitter_figures(differences: Sequence[FloatArray]) -> dict[str, Any]:
    """Returns the rms and the scaled median absolute deviation of second differences in pixels at 640 wide."""
    values = np.concatenate([np.zeros(0), *differences])
    return {
        "samples": len(values),
        "rms_px_640": rounded(float(np.sqrt(np.mean(values**2)))) if len(values) else None,
        "mad_px_640": rounded(_NORMAL * float(np.median(np.abs(values)))) if len(values) else None,
    }


def second_differences(run: ClipRun) -> Iterator[FloatArray]:
    """Yields x[t-1] - 2 x[t] + x[t+1] of the ego boundaries, over three frames that report the same track."""
    for frames in zip(run.frames, run.frames[1:], run.frames[2:], strict=False):
        if len({frame.truth.scene for frame in frames}) > 1:
            continue
        scale = 640.0 / frames[0].truth.width
        by_id = [
            {lane.track_id: frame.steady_x[index, _JITTER] for index, lane in enumerate(frame.answer.lanes)}
            for frame in frames
        ]
        for lane in frames[1].answer.lanes:
            if abs(lane.position) == 1 and all(lane.track_id in columns for columns in by_id):
                before, now, after = (columns[lane.track_id] for columns in by_id)
                yield (before - 2.0 * now + after) * scale


def lag(stretches: Iterable[Stretch]) -> dict[str, Any]:
    """Returns the delay in frames that explains most of the error: the least-squares fit of error = c - lag * motion.

    The constant c of each stretch takes up its bias. The motion of the reference may be noisy, so its smooth derivative
    (Savitzky and Golay, "Smoothing and differentiation of data by simplified least squares procedures", 1964) is the
    instrument of the fit: lag = -<error, smooth> / <motion, smooth>.
    """
    error_product = motion_product = 0.0
    frames = 0
    for x, reference in stretches:
        if len(x) < _WINDOW:
            continue
        smooth = savgol_filter(reference, _WINDOW, 2, deriv=1)
        smooth -= smooth.mean()
        error_product += float((x - reference) @ smooth)
        motion_product += float(np.gradient(reference) @ smooth)
        frames += len(x)
    return {"frames": frames, "lag_frames": rounded(-error_product / motion_product) if motion_product else None}


def _stretches(run: ClipRun, row: int) -> Iterator[Stretch]:
    """Yields the stretches in which a track follows the same boundary without interruption."""
    current: dict[tuple[int, int], list[tuple[float, float]]] = {}
    for frame in run.frames:
        continued: dict[tuple[int, int], list[tuple[float, float]]] = {}
        for truth_index, index in frame.pairs.items():
            key = frame.truth.lanes[truth_index].lane_id, frame.answer.lanes[index].track_id
            reference = float(frame.true_steady_x[truth_index, row])
            if not np.isnan(reference):
                continued[key] = current.pop(key, [])
                continued[key].append((float(frame.steady_x[index, row]), reference))
        yield from map(_arrays, current.values())
        current = continued
    yield from map(_arrays, current.values())


def _arrays(pairs: Sequence[tuple[float, float]]) -> Stretch:
    x, reference = np.array(pairs).T
    return x, reference
