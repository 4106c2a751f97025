"""How sure a figure is: percentile intervals of the bootstrap over blocks of neighbouring frames.

Neighbouring frames of a drive are near copies of each other, so whole blocks are drawn, never single frames (the
non-overlapping block bootstrap: E. Carlstein, Annals of Statistics 14, 1986).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabelledFrame

# Sums of per-frame counts (R, C) to figures, each (R,); a figure is not a number where nothing was counted.
Figures = Callable[[FloatArray], dict[str, FloatArray]]

STILLS: Final = 5  # labelled frames of a block
SPAN: Final = 60  # video frames that a block of a clip spans at least
_DRIVES: Final = 10  # from so many drives on, whole drives are drawn
_DRAWS: Final = 2000
_SEED: Final = 0


def blocks(frames: Sequence[LabelledFrame]) -> NDArray[np.int64]:
    """The block of each frame (N,), numbered from 0.

    A block is a whole drive where there are ten drives or more. Otherwise it is five neighbouring labelled frames of a
    drive or, where the frames are numbered frames of a clip, two or more that span 60 frames of it.
    """
    drives: dict[str, list[int]] = {}
    for index, frame in enumerate(frames):
        drives.setdefault(frame.group, []).append(index)
    result, first = np.zeros(len(frames), dtype=np.int64), 0
    for members in drives.values():
        length = len(members) if len(drives) >= _DRIVES else _length([frames[i] for i in members])
        result[members] = first + np.arange(len(members)) // length
        first = int(result[members[-1]]) + 1
    return result


def measured(counts: FloatArray, frames: Sequence[LabelledFrame], figures: Figures) -> dict[str, float | None]:
    """The figures of all frames together; `counts` is (N, C). None where nothing was counted."""
    total = counts.sum(axis=0, keepdims=True) if len(frames) else np.zeros((1, counts.shape[1]))
    return {name: _number(float(value[0])) for name, value in figures(total).items()}


def intervals(counts: FloatArray, frames: Sequence[LabelledFrame], figures: Figures) -> dict[str, list[float] | None]:
    """The 95 % interval [low, high] of each figure; None with fewer than two blocks.

    The draws are seeded: the same input gives the same answer.
    """
    ids = blocks(frames)
    number = int(ids.max(initial=-1)) + 1
    sums = np.stack([np.bincount(ids, column, number) for column in counts.T], axis=1) if number else counts
    rng = np.random.default_rng(_SEED)
    draws = rng.multinomial(number, np.full(number, 1.0 / number), _DRAWS) if number else np.zeros((_DRAWS, 0), int)
    return {name: _interval(values, number) for name, values in figures(np.asarray(draws @ sums, dtype=float)).items()}


def ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    """part / whole, not a number where whole is 0."""
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


def _length(frames: Sequence[LabelledFrame]) -> int:
    numbers = [frame.source.rpartition("#")[2] for frame in frames if "#" in frame.source]
    if len(numbers) < max(2, len(frames)) or not all(number.isdigit() for number in numbers):
        return STILLS
    apart = np.median(np.diff(np.array(numbers, dtype=np.int64)))
    return max(2, int(np.ceil(SPAN / max(float(apart), 1.0))))
