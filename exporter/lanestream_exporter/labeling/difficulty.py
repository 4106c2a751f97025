"""How hard a frame is: how much the two detectors disagree about the boundaries of the ego lane.

Where they disagree at least one of them is wrong, so a label teaches most there. See samples.hard_scenes for the idea's
source.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.interface import Detections, FrameContext, ModelRole
from lanestream.engine import Engine
from lanestream.errors import ModelError
from lanestream.images.resizing import working_image
from lanestream.road.results import Detection
from lanestream.road.view import LANE_WIDTHS, USUAL_LANE_WIDTH, Image, RoadView
from lanestream_exporter.samples.hard_scenes import ego_boundaries

_DETECTORS: Final = ("candidates", "regression")
_SIDES: Final = ("left", "right")
# The shares of the depth at which positions are compared.
_COMPARED: Final = np.array([0.4, 0.9])
_OTHER_KIND: Final = 0.5
_LEAST_PROBABILITY: Final = 0.5  # the weight of how far the smaller probability is below 1
_NEITHER: Final = 0.25  # both may have missed it


@dataclass(frozen=True)
class Difficulty:
    """How hard a frame is, from 0 to 1, and why."""

    score: float
    reason: str


class DetectorComparison:
    """Runs both detectors of an engine on single images."""

    def __init__(self, engine: Engine) -> None:
        """Raises ModelError if the engine lacks a detector."""
        if not set(_DETECTORS) <= engine.detectors.keys():
            raise ModelError(
                f"hard frames are found by comparing the detectors {' and '.join(_DETECTORS)}",
                "give a classifier with --model and a regressor with --regressor, or leave both out",
            )
        self._engine = engine

    def difficulty(self, image: Image) -> Difficulty:
        """Returns how hard a BGR image (H, W, 3) uint8 is: the mean of its two sides."""
        working, _ = working_image(image)
        detectors = self._engine.detectors
        first, second = (detectors[name].detect(working, FrameContext(), self._infer) for name in _DETECTORS)
        return compare(first, second)

    def _infer(self, role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._engine.models[role].run(inputs)


def compare(candidates: Detections, regression: Detections) -> Difficulty:
    """Returns how much the detections of the two detectors in one image disagree about the ego lane."""
    pairs = list(zip(ego_boundaries(candidates), ego_boundaries(regression), strict=True))
    width = _lane_width(candidates, regression)
    sides = [_side(*pair, candidates.view, width) for pair in pairs]
    score = float(np.mean([score for score, _ in sides]))
    reason = "; ".join(f"{side}: {why}" for side, (_, why) in zip(_SIDES, sides, strict=True))
    return Difficulty(round(score, 3), reason)


def _side(first: Detection | None, second: Detection | None, view: RoadView, lane_width: float) -> tuple[float, str]:
    """Returns the score of one side, from 0 to 1, and its reason."""
    if first is None and second is None:
        return _NEITHER, "no boundary found"
    if first is None or second is None:
        name, found = (_DETECTORS[0], first) if second is None else (_DETECTORS[1], second)
        assert found is not None  # noqa: S101 - one of the two is
        return 1.0, f"only {name} finds a boundary, with probability {found.probability:.2f}"
    below = _COMPARED * view.depth
    rows = view.horizon + below
    apart = float((np.abs(first.curve.x(rows) - second.curve.x(rows)) / below).max()) / lane_width
    probability = min(first.probability, second.probability)
    kinds = [found.appearance.kind for found in (first, second)]
    score = apart + _LEAST_PROBABILITY * (1.0 - probability) + (_OTHER_KIND if kinds[0] != kinds[1] else 0.0)
    why = f"{apart:.2f} lane widths apart, probability {probability:.2f}"
    return min(score, 1.0), why if kinds[0] == kinds[1] else f"{why}, {kinds[0]} or {kinds[1]}"


def _lane_width(*detections: Detections) -> float:
    """Returns the width of the ego lane in columns per row offset, by the first detector that finds both sides."""
    for found in detections:
        left, right = ego_boundaries(found)
        if left is not None and right is not None:
            columns = float(right.curve.x(found.view.bottom)) - float(left.curve.x(found.view.bottom))
            return float(np.clip(columns / found.view.depth, *LANE_WIDTHS))
    return USUAL_LANE_WIDTH
