"""Confidence intervals of figures: percentile intervals of the bootstrap over blocks of neighboring frames.

Neighboring frames of a drive are near duplicates, so whole blocks are resampled, never single frames (non-overlapping
block bootstrap: E. Carlstein, Annals of Statistics 14, 1986).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabeledFrame

# Computes figures, each (R,), from sums of per-frame counts (R, C); a figure without data is NaN.
FigureFunction = Callable[[FloatArray], dict[str, FloatArray]]

STILLS: Final = 5  # labeled frames per block
SPAN: Final = 60  # least number of video frames spanned by a block of a clip
_MIN_DRIVES: Final = 10  # from this number of drives, the blocks are whole drives
_RESAMPLES: Final = 2000
_SEED: Final = 0


def blocks(frames: Sequence[LabeledFrame]) -> NDArray[np.int64]:
    """Returns the block number of each frame (N,), from 0.

    With ten drives or more, a block is a whole drive. Otherwise it is five neighboring labeled frames of a drive or,
    for numbered frames of a clip, at least two that span 60 frames of it.
    """
    drives: dict[str, list[int]] = {}
    for index, frame in enumerate(frames):
        drives.setdefault(frame.group, []).append(index)
    result, first = np.zeros(len(frames), dtype=np.int64), 0
    for members in drives.values():
        length = len(members) if len(drives) >= _MIN_DRIVES else _block_length([frames[i] for i in members])
        result[members] = first + np.arange(len(members)) // length
        first = int(result[members[-1]]) + 1
    return result


def point_estimates(
    counts: FloatArray, frames: Sequence[LabeledFrame], figures: FigureFunction
) -> dict[str, float | None]:
    """Returns the figures over all frames; `counts` is (N, C). A figure without data is None."""
    total = counts.sum(axis=0, keepdims=True) if len(frames) else np.zeros((1, counts.shape[1]))
    return {name: _number(float(value[0])) for name, value in figures(total).items()}


def intervals(
    counts: FloatArray, frames: Sequence[LabeledFrame], figures: FigureFunction
) -> dict[str, list[float] | None]:
    """Returns the 95 % interval [low, high] of each figure; None with fewer than two blocks.

    The resampling is seeded: the same input gives the same intervals.
    """
    ids = blocks(frames)
    number = int(ids.max(initial=-1)) + 1
    sums = np.stack([np.bincount(ids, column, number) for column in counts.T], axis=1) if number else counts
    rng = np.random.default_rng(_SEED)
    draws = (
        rng.multinomial(number, np.full(number, 1.0 / number), _RESAMPLES) if number else np.zeros((_RESAMPLES, 0), int)
    )
    return {name: _interval(values, number) for name, values in figures(np.asarray(draws @ sums, dtype=float)).items()}


def ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    """Returns part / whole, NaN where whole is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(whole > 0, part / whole, np.nan))


def _interval(values: FloatArray, number: int) -> list[float] | None:
    known = values[~np.isnan(values)]
    if number < 2 or not len(known):
        return None
    low, high = np.percentile(known, [2.5, 97.5])
    return [round(float(low), 4), round(float(high), 4)]


def _number(value: float) -> float | None:
    return None if np.isnan(value) else round(value, 4)


def _block_length(frames: Sequence[LabeledFrame]) -> int:
    numbers = [frame.source.rpartition("#")[2] for frame in frames if "#" in frame.source]
    if len(numbers) < max(2, len(frames)) or not all(number.isdigit() for number in numbers):
        return STILLS
    spacing = np.median(np.diff(np.array(numbers, dtype=np.int64)))
    return max(2, int(np.ceil(SPAN / max(float(spacing), 1.0))))
