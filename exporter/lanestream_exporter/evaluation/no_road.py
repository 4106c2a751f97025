"""Pictures without a road: in how many of them a method reports a boundary, which is always wrong."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest

from lanestream.road.view import Image
from lanestream_exporter.evaluation.boundaries import ReportedBoundary
from lanestream_exporter.evaluation.methods import Method
from lanestream_exporter.scenes.no_road import sample_kind_and_picture

_SIZES: Final = ((1280, 720), (640, 480), (960, 540), (540, 960))
# Differs from the last part of the seeds of pictures for training, which is 3: no network has seen these pictures.
_SEED: Final = 4


@dataclass(frozen=True)
class NoRoadOutcome:
    """The kind of a picture without a road, and the boundaries that a method reported in it."""

    kind: str
    reports: tuple[ReportedBoundary, ...]

    @property
    def has_marking(self) -> bool:
        """Whether a marking was reported."""
        return any(report.kind == "marking" for report in self.reports)

    @property
    def has_ego_lane(self) -> bool:
        """Whether both boundaries of the ego lane were reported."""
        return {-1, 1} <= {report.position for report in self.reports}


def no_road_pictures(count: int) -> Iterator[tuple[str, Image]]:
    """Yields the first `count` pictures of an endless series, each BGR (H, W, 3) after the name of its kind."""
    for index in range(count):
        rng = np.random.default_rng([0, index, _SEED])
        yield sample_kind_and_picture(rng, *_SIZES[index % len(_SIZES)])


def run_no_road(methods: Sequence[Method], count: int) -> dict[str, list[NoRoadOutcome]]:
    """Runs every method on `count` pictures; returns the outcomes by the method's name."""
    outcomes: dict[str, list[NoRoadOutcome]] = {method.name: [] for method in methods}
    for kind, image in no_road_pictures(count):
        for method in methods:
            outcomes[method.name].append(NoRoadOutcome(kind, method.find(image)))
    return outcomes


def by_kind(outcomes: Sequence[NoRoadOutcome]) -> dict[str, list[NoRoadOutcome]]:
    """Returns the outcomes of each kind of picture, in alphabetical order."""
    kinds: dict[str, list[NoRoadOutcome]] = {kind: [] for kind in sorted({outcome.kind for outcome in outcomes})}
    for outcome in outcomes:
        kinds[outcome.kind].append(outcome)
    return kinds


def no_road_figures(outcomes: Sequence[NoRoadOutcome]) -> dict[str, Any]:
    """Returns in how many pictures, of one at least, something is reported; see docs/evaluation.md.

    The pictures are independent of each other, so the interval is that of a binomial share (C. Clopper and E. Pearson,
    Biometrika 26, 1934).
    """
    found = sum(bool(outcome.reports) for outcome in outcomes)
    low, high = binomtest(found, len(outcomes)).proportion_ci(0.95, "exact")
    return {
        "pictures": len(outcomes),
        "with_boundary": found,
        "with_marking": sum(outcome.has_marking for outcome in outcomes),
        "with_ego_lane": sum(outcome.has_ego_lane for outcome in outcomes),
        "share": round(found / len(outcomes), 4),
        "intervals": {"share": [round(float(low), 4), round(float(high), 4)]},
    }
