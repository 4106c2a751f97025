"""The outcome of a method on one frame: everything that the figures need, without the image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lanestream.detection.candidate_detector import CandidateDetector
from lanestream.detection.classification import Classification
from lanestream.detection.proposals import Proposals
from lanestream_exporter.datasets.labels import LabeledFrame
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, ego_sides
from lanestream_exporter.samples.truth import TruthRule, Verdicts

# The most candidates whose ranks are evaluated; the classifier sees fewer in service.
MOST_RANKED = 32

RULES = {"far_40": TruthRule(far=40.0), "far_30": TruthRule(far=30.0)}


@dataclass(frozen=True)
class LabelProposal:
    """A label and the rank (from 0) of the first candidate that is true to it; None if none of the 32 is."""

    ego: bool
    rank: int | None


@dataclass(frozen=True)
class JudgedCandidates:
    """Level A for one frame: probabilities (N,), verdicts (N,) under each of `RULES`, and the proposals of all labels.

    `probabilities` are the classifier's own; `decided` (N,) are those that the detector's decision is based on.
    """

    probabilities: NDArray[np.float64]
    decided: NDArray[np.float64]
    verdicts: dict[str, Verdicts]
    proposed: tuple[LabelProposal, ...]


@dataclass(frozen=True)
class FrameEvaluation:
    """A labeled frame, the boundaries that a method reported for it and, for a classifier, its candidates."""

    frame: LabeledFrame
    reports: tuple[ReportedBoundary, ...]
    candidates: JudgedCandidates | None = None


def ego_pair(outcome: FrameEvaluation) -> FrameEvaluation:
    """Returns the same frame with only the labels and reports of the ego lane's boundaries."""
    lanes = tuple(lane for lane in ego_sides(outcome.frame) if lane is not None)
    reports = tuple(report for report in outcome.reports if abs(report.position) == 1)
    return FrameEvaluation(replace(outcome.frame, lanes=lanes), reports)


def markings_only(outcome: FrameEvaluation) -> FrameEvaluation:
    """Returns the same frame without labeled and reported edges of the road."""
    lanes = tuple(lane for lane in outcome.frame.lanes if lane.kind != "road_edge")
    reports = tuple(report for report in outcome.reports if report.kind == "marking")
    return FrameEvaluation(replace(outcome.frame, lanes=lanes), reports)


def judge(proposals: Proposals, classification: Classification, frame: LabeledFrame) -> JudgedCandidates:
    """Judges up to 32 candidates against the labels of `frame`, all in pixels of the working image.

    `classification` is the classifier's of the first M, which are those that it sees in service.
    """
    seen = np.arange(len(classification.kinds))
    served = replace(proposals, curves=proposals.curves.take(seen), spans=proposals.spans.take(seen))
    verdicts = {name: rule.judge(served.curves, served.spans, served.view, frame) for name, rule in RULES.items()}
    ego, rule = ego_sides(frame), RULES["far_40"]
    proposed = []
    for lane in frame.lanes:
        true = rule.follows(proposals.curves, proposals.spans, proposals.view, lane, frame.width)
        rank = int(true.argmax()) if true.any() else None
        proposed.append(LabelProposal(any(lane is side for side in ego), rank))
    decided = CandidateDetector.with_prior(served, classification)
    return JudgedCandidates(classification.boundary, decided.boundary, verdicts, tuple(proposed))
