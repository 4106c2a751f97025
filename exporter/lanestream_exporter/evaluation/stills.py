"""Stills: whether a stream of one picture keeps the boundaries that the single picture shows.

Nothing moves, so whatever is lost was lost by what the stream remembers: tracks, the horizon, the ego-lane prior.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lanestream.road.view import Image
from lanestream_exporter.datasets.labels import LabeledFrame, LabeledImages
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.methods import Method
from lanestream_exporter.scenes import render_still, sample_scene

FRAMES: Final = 30
_FPS: Final = 25.0
_SIZE: Final = (1280, 720)
# Differs from the last part of the seeds of training scenes.
_SEED: Final = 6
# A boundary is kept if, at half of the rows that it has in common with one of the last frame, their distance across
# the line is less than this share of the width.
_SAME: Final = 0.03
_ROWS: Final = 32


@dataclass(frozen=True)
class StillOutcome:
    """What a method reports in a picture: alone, and in the last frame of a stream of it."""

    source: str
    alone: tuple[ReportedBoundary, ...]
    streamed: tuple[ReportedBoundary, ...]
    width: int

    @property
    def lost(self) -> int:
        """The number of boundaries of the single picture that the stream does not report."""
        return sum(not any(_is_same(one, other, self.width) for other in self.streamed) for one in self.alone)

    @property
    def gained(self) -> int:
        """The number of boundaries that only the stream reports."""
        return sum(not any(_is_same(one, other, self.width) for other in self.alone) for one in self.streamed)


def run_stills(
    methods: Sequence[Method], images: LabeledImages, frames: Sequence[LabeledFrame], count: int
) -> dict[str, list[StillOutcome]]:
    """Streams `count` pictures, half of them rendered, to every method that has a memory.

    The others are evenly spaced among the `images` of each data set, whose labels are `frames`. If there are fewer,
    more are rendered. Returns the outcomes by the method's name.
    """
    outcomes: dict[str, list[StillOutcome]] = {m.name: [] for m in methods if m.kind != "baseline"}
    real = [(frame.dataset or "frames", image) for frame, image in _evenly_spaced(images, frames, count // 2)]
    rendered = (("rendered", image) for image in _rendered(count - len(real)))
    for source, image in (*real, *rendered):
        for method in methods:
            if method.name in outcomes:
                outcomes[method.name].append(_streamed(method, source, image))
    return outcomes


def still_figures(outcomes: Sequence[StillOutcome]) -> dict[str, Any]:
    """Returns in how many of the stills a boundary is lost, and how many are lost and gained in all."""
    return {
        "stills": len(outcomes),
        "boundaries": sum(len(outcome.alone) for outcome in outcomes),
        "with_loss": sum(outcome.lost > 0 for outcome in outcomes),
        "lost": sum(outcome.lost for outcome in outcomes),
        "gained": sum(outcome.gained for outcome in outcomes),
    }


def by_source(outcomes: Sequence[StillOutcome]) -> dict[str, list[StillOutcome]]:
    """Returns the outcomes of each data set and of rendered pictures."""
    sources: dict[str, list[StillOutcome]] = {}
    for outcome in outcomes:
        sources.setdefault(outcome.source, []).append(outcome)
    return sources


def _streamed(method: Method, source: str, image: Image) -> StillOutcome:
    track = method.start_clip()
    for index in range(FRAMES):
        streamed = track(image, index / _FPS)
    return StillOutcome(source, method.find(image), streamed, image.shape[1])


def _evenly_spaced(
    images: LabeledImages, frames: Sequence[LabeledFrame], count: int
) -> Iterator[tuple[LabeledFrame, Image]]:
    numbers = Counter(frame.dataset for frame in frames)
    per_dataset = count // max(len(numbers), 1)
    chosen = {
        name: set(np.linspace(0, number - 1, min(per_dataset, number)).astype(int).tolist())
        for name, number in numbers.items()
    }
    seen: Counter[str] = Counter()
    for frame, image in images:
        if seen[frame.dataset] in chosen.get(frame.dataset, ()):
            yield frame, image
        seen[frame.dataset] += 1


def _rendered(count: int) -> Iterator[Image]:
    for index in range(count):
        yield render_still(sample_scene(np.random.default_rng([0, index, _SEED]), *_SIZE)).image


def _is_same(one: ReportedBoundary, other: ReportedBoundary, width: int) -> bool:
    top, bottom = max(one.top, other.top), min(one.bottom, other.bottom)
    if bottom <= top:
        return False
    rows = np.linspace(top, bottom, _ROWS)
    across = np.abs(one.curve.x(rows) - other.curve.x(rows)) / np.hypot(1.0, one.curve.slope(rows))
    return bool(np.median(across) < _SAME * width)
