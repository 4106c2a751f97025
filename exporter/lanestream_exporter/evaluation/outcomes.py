"""What is kept of a frame that a method has looked at: enough for every figure, without the image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lanestream.detection import Prepared
from lanestream.detection.candidate_detector import TRUE_LANE, CandidateDetector
from lanestream_exporter.datasets.labels import LabelledFrame
from lanestream_exporter.evaluation.boundaries import Found, ego_sides
from lanestream_exporter.samples.patches import TruthRule, distance_along

MOST_CANDIDATES = 32

RULES = {"far_40": TruthRule(far=40.0), "far_30": TruthRule(far=30.0)}


@dataclass(frozen=True)
class Proposed:
    """A label and the place (from 0) of the first candidate that is true to it; None where none of the 32 is."""

    ego: bool
    place: int | None


@dataclass(frozen=True)
class JudgedCandidates:
    """Level A of one frame: probabilities (N,), verdicts (N,) under each of `RULES`, and what was proposed at all.

    `probabilities` are the classifier's own, `decided` (N,) those by which the detector accepts.
    """

    probabilities: NDArray[np.float64]
    decided: NDArray[np.float64]
    verdicts: dict[str, NDArray[np.int64]]
    proposed: tuple[Proposed, ...]


@dataclass(frozen=True)
class Outcome:
    """A labelled frame, what a method reported for it and, for a classifier, its candidates."""

    frame: LabelledFrame
    found: tuple[Found, ...]
    candidates: JudgedCandidates | None = None


def ego_pair(outcome: Outcome) -> Outcome:
    """The same frame without all that is neither labelled nor reported as a boundary of the ego lane."""
    lanes = tuple(lane for lane in ego_sides(outcome.frame) if lane is not None)
    found = tuple(boundary for boundary in outcome.found if abs(boundary.position) == 1)
    return Outcome(replace(outcome.frame, lanes=lanes), found)


def judge(prepared: Prepared, outputs: NDArray[np.float32], wide: Prepared, frame: LabelledFrame) -> JudgedCandidates:
    """The candidates that the classifier saw against the labels, and those up to 32 that `wide` has instead."""
    verdicts = {name: rule.judge(prepared.candidates, frame, prepared.view) for name, rule in RULES.items()}
    ego, near = ego_sides(frame), RULES["far_40"]
    proposed = []
    for lane in frame.lanes:
        measured = [distance_along(c, lane, wide.view) for c in wide.candidates[:MOST_CANDIDATES]]
        true = [d * 1280.0 / frame.width <= near.near and overlap >= near.overlap for d, overlap in measured]
        place = true.index(True) if any(true) else None
        proposed.append(Proposed(any(lane is mine for mine in ego), place))
    own, decided = outputs[:, TRUE_LANE].astype(np.float64), CandidateDetector.judged(prepared, outputs)
    return JudgedCandidates(own, decided, verdicts, tuple(proposed))
