"""Reliability: whether what is reported with a probability is right that often, for the ego pair and outer boundaries.

A report is right or wrong by the matching of all boundaries; one that may be an unlabeled boundary is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.boundaries import ego_labels
from lanestream_exporter.evaluation.candidates import calibration
from lanestream_exporter.evaluation.figures import match_all
from lanestream_exporter.evaluation.outcomes import FrameEvaluation

Role = Literal["ego", "outer"]
ROLES: Final[tuple[Role, ...]] = ("ego", "outer")

# The probabilities from which on the trade between precision and recall is given.
LEAST: Final = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)


def reliability_figures(outcomes: Sequence[FrameEvaluation]) -> dict[str, Any]:
    """Returns the reliability and the trade between precision and recall of both roles; see docs/evaluation.md.

    Methods that report no probabilities have none.
    """
    if any(report.probability is None for outcome in outcomes for report in outcome.reports):
        return {}
    return {role: _figures(outcomes, role) for role in ROLES}


def _figures(outcomes: Sequence[FrameEvaluation], role: Role) -> dict[str, Any]:
    judged = [_judged(outcome, role) for outcome in outcomes]
    is_right = np.concatenate([right for right, _, _ in judged]) if judged else np.zeros(0, bool)
    probability = np.concatenate([values for _, values, _ in judged]) if judged else np.zeros(0)
    labels = sum(number for _, _, number in judged)
    trade = []
    for least in LEAST:
        chosen = is_right[probability >= least]
        right, reported = int(chosen.sum()), len(chosen)
        trade.append(
            {
                "least": least,
                "right": right,
                "wrong": reported - right,
                "precision": round(right / reported, 4) if reported else None,
                "recall": round(right / labels, 4) if labels else None,
            }
        )
    return {
        "reports": len(is_right),
        "labels": labels,
        "calibration": calibration(is_right, probability),
        "trade": trade,
    }


def _judged(outcome: FrameEvaluation, role: Role) -> tuple[NDArray[np.bool_], FloatArray, int]:
    """Returns whether each judged report of a role is right (N,), its probability (N,), and the number of labels."""
    matched = match_all(outcome)
    ego = ego_labels(outcome.frame)
    labels = len(ego) if role == "ego" else len(outcome.frame.lanes) - len(ego)
    verdicts = {**{found.index: True for found in matched.matches}, **dict.fromkeys(matched.wrong_reports, False)}
    chosen = [i for i in sorted(verdicts) if (abs(outcome.reports[i].position) == 1) == (role == "ego")]
    probabilities = [outcome.reports[i].probability for i in chosen]
    return np.array([verdicts[i] for i in chosen], bool), np.array(probabilities, np.float64), labels
