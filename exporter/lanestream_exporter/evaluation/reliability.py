"""Reliability: whether what is reported with a probability is right that often, for the ego pair and outer boundaries.

A report is right or wrong by the matching of all boundaries; one that may be an unlabeled boundary is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray
from lanestream_exporter.datasets.labels import LabeledLane
from lanestream_exporter.evaluation.boundaries import ReportedBoundary, ego_labels
from lanestream_exporter.evaluation.candidates import calibration
from lanestream_exporter.evaluation.figures import match_all
from lanestream_exporter.evaluation.outcomes import FrameEvaluation

Role = Literal["ego", "outer"]
ROLES: Final[tuple[Role, ...]] = ("ego", "outer")

# The probabilities from which on the trade between precision and recall is given.
LEAST: Final = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


def reliability_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns the reliability and the trade between precision and recall of both roles; see docs/evaluation.md.

    Methods that report nothing, or no probabilities, have none.
    """
    probabilities = [report.probability for outcome in outcomes for report in outcome.reports]
    if not probabilities or None in probabilities:
        return {}
    return {role: _figures(outcomes, role) for role in ROLES}


def judged_reports(outcome: FrameEvaluation, role: Role) -> tuple[NDArray[np.bool_], FloatArray]:
    """Returns which of the reports of a role are right (N,), and their probabilities (N,)."""
    matched = match_all(outcome)
    right = {found.index for found in matched.matches}
    judged = [i for i in sorted(right.union(matched.wrong_reports)) if _role(outcome.reports[i]) == role]
    return np.array([i in right for i in judged], bool), _probabilities(outcome)[judged]


def _figures(outcomes: Sequence[FrameEvaluation], role: Role) -> dict[str, Any]:
    judged = [judged_reports(outcome, role) for outcome in outcomes]
    is_right, probability = (np.concatenate(parts) for parts in zip(*judged, strict=True))
    found = np.concatenate([_found_labels(outcome, role) for outcome in outcomes])
    labels = sum(len(_labels(outcome, role)) for outcome in outcomes)
    trade = []
    for least in LEAST:
        chosen = is_right[probability >= least]
        right, reported, reached = int(chosen.sum()), len(chosen), int((found >= least).sum())
        trade.append(
            {
                "least": least,
                "right": right,
                "wrong": reported - right,
                "precision": round(right / reported, 4) if reported else None,
                "found": reached,
                "recall": round(reached / labels, 4) if labels else None,
            }
        )
    return {
        "reports": len(is_right),
        "labels": labels,
        "calibration": calibration(is_right, probability),
        "trade": trade,
    }


def _found_labels(outcome: FrameEvaluation, role: Role) -> FloatArray:
    """Returns with which probability each label of a role that is found was reported (N,).

    A report of either role finds it: an outer one finds an ego boundary if a nearer boundary is reported.
    """
    labels = _labels(outcome, role)
    found = [pair.index for pair in match_all(outcome).matches if any(pair.label is label for label in labels)]
    return _probabilities(outcome)[found]


def _probabilities(outcome: FrameEvaluation) -> FloatArray:
    return np.array([report.probability for report in outcome.reports], np.float64)


def _role(report: ReportedBoundary) -> Role:
    return "ego" if abs(report.position) == 1 else "outer"


def _labels(outcome: FrameEvaluation, role: Role) -> list[LabeledLane]:
    ego = ego_labels(outcome.frame)
    return ego if role == "ego" else [lane for lane in outcome.frame.lanes if not any(lane is each for each in ego)]
