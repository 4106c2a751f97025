"""Rendered towns: streets with kerbs, parked cars, walls and houses, whose every boundary is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from lanestream_exporter.datasets.labels import LabeledImages
from lanestream_exporter.evaluation.figures import boundary_figures
from lanestream_exporter.evaluation.methods import Method
from lanestream_exporter.evaluation.outcomes import FrameEvaluation
from lanestream_exporter.evaluation.reliability import reliability_figures
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.scenes.layout import RoadStyle

TOWN_STYLES: Final[dict[RoadStyle, float]] = {"street": 0.6, "campus": 0.4}
_SIZES: Final = ((1280, 720), (640, 480), (960, 540))
# Differs from the last part of the seeds of training scenes.
_SEED: Final = 5


def town_frames(count: int) -> LabeledImages:
    """Yields the first `count` frames of an endless series, each BGR (H, W, 3) after its labels."""
    for index in range(count):
        scene = sample_scene(np.random.default_rng([0, index, _SEED]), *_SIZES[index % len(_SIZES)], TOWN_STYLES)
        still = render_still(scene)
        yield still.labels, still.image


def run_towns(methods: Sequence[Method], count: int) -> dict[str, list[FrameEvaluation]]:
    """Runs every method on `count` frames as single images; returns the outcomes by the method's name."""
    outcomes: dict[str, list[FrameEvaluation]] = {method.name: [] for method in methods}
    for frame, image in town_frames(count):
        for method in methods:
            outcomes[method.name].append(FrameEvaluation(frame, method.find(image)))
    return outcomes


def town_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns the figures of boundaries and their reliability; see docs/evaluation.md."""
    return {"boundaries": boundary_figures(outcomes), "reliability": reliability_figures(outcomes)}
