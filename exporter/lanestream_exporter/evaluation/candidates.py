"""Figures of level A: the classifier on the candidates of its frames, and proposal recall."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.bootstrap import intervals, point_estimates, ratio
from lanestream_exporter.evaluation.outcomes import MOST_RANKED, RULES, FrameEvaluation, JudgedCandidates
from lanestream_exporter.samples.truth import UNSURE, Verdicts

_BINS = 10
# Fields of JudgedCandidates that can be evaluated: the classifier's probabilities, or those of the detector's decision.
ProbabilityField = Literal["probabilities", "decided"]


def candidate_figures(outcomes: Sequence[FrameEvaluation], threshold: float) -> dict[str, Any]:
    """Returns all figures of level A under both rules for false candidates; see docs/evaluation.md."""
    return {
        "threshold": threshold,
        **{rule: _judged(outcomes, rule, threshold) for rule in RULES},
        "decided": {rule: _judged(outcomes, rule, threshold, "decided") for rule in RULES},
        "proposal_recall": {"ego": _proposed(outcomes, True), "all": _proposed(outcomes, False)},
    }


def clear_candidates(
    outcomes: Sequence[FrameEvaluation], rule: str, field: ProbabilityField = "probabilities"
) -> tuple[NDArray[np.bool_], FloatArray]:
    """Returns (truth, probability), each (N,), of the candidates that are clearly true or false."""
    pairs = [_clear(judged, rule, field) for judged in _all(outcomes)]
    truth = np.concatenate([t for t, _ in pairs]) if pairs else np.zeros(0, bool)
    return truth, np.concatenate([p for _, p in pairs]) if pairs else np.zeros(0)


def _judged(
    outcomes: Sequence[FrameEvaluation], rule: str, threshold: float, field: ProbabilityField = "probabilities"
) -> dict[str, Any]:
    truth, probability = clear_candidates(outcomes, rule, field)
    counts = np.array([_confusion(*_clear(judged, rule, field), threshold) for judged in _all(outcomes)]).reshape(-1, 4)
    frames = [outcome.frame for outcome in outcomes if outcome.candidates is not None]
    names = ("true", "false", "unsure", "unknown")
    numbers = np.array([_numbers(judged.verdicts[rule]) for judged in _all(outcomes)]).reshape(-1, 4).sum(axis=0)
    both = truth.any() and not truth.all()
    return {
        "candidates": int(numbers.sum()),
        **dict(zip(names, map(int, numbers), strict=True)),
        "confusion": dict(zip(("tp", "fp", "fn", "tn"), map(int, counts.sum(axis=0)), strict=True)),
        "base_rate": round(float(truth.mean()), 4) if len(truth) else None,
        **point_estimates(counts, frames, _rates),
        "average_precision": round(float(average_precision_score(truth, probability)), 4) if both else None,
        "calibration": calibration(truth, probability),
        "intervals": intervals(counts, frames, _rates),
    }


def _rates(counts: FloatArray) -> dict[str, FloatArray]:
    tp, fp, fn, tn = counts.T
    return {
        "precision": ratio(tp, tp + fp),
        "recall": ratio(tp, tp + fn),
        "accuracy": ratio(tp + tn, tp + fp + fn + tn),
        "balanced_accuracy": 0.5 * (ratio(tp, tp + fn) + ratio(tn, tn + fp)),
    }


def calibration(truth: NDArray[np.bool_], probability: FloatArray) -> dict[str, Any]:
    """Returns ten bins of equal width, and the expected calibration error: their gaps weighted by their counts.

    After C. Guo et al., "On calibration of modern neural networks", 2017, for the `probability` (N,) of being true.
    """
    bin_of = np.minimum((probability * _BINS).astype(int), _BINS - 1)
    bins, error = [], 0.0
    for index in range(_BINS):
        inside = bin_of == index
        count = int(inside.sum())
        mean_probability = float(probability[inside].mean()) if count else None
        true_share = float(truth[inside].mean()) if count else None
        if mean_probability is not None and true_share is not None:
            error += abs(true_share - mean_probability) * count / len(truth)
        bins.append(
            {
                "low": index / _BINS,
                "high": (index + 1) / _BINS,
                "count": count,
                "mean_probability": None if mean_probability is None else round(mean_probability, 4),
                "true_share": None if true_share is None else round(true_share, 4),
            }
        )
    return {"expected_error": round(error, 4) if len(truth) else None, "bins": bins}


def _proposed(outcomes: Sequence[FrameEvaluation], ego: bool) -> dict[str, Any]:
    """Returns how many labels have a true candidate among the first 1, 2, ... 32."""
    labels = [[p for p in judged.proposed if p.ego or not ego] for judged in _all(outcomes)]
    frames = [outcome.frame for outcome in outcomes if outcome.candidates is not None]
    ranks = [[p.rank for p in frame if p.rank is not None] for frame in labels]
    reached = np.array([np.bincount(p, minlength=MOST_RANKED).cumsum() for p in map(_integers, ranks)])
    counts = np.column_stack([reached.reshape(-1, MOST_RANKED), [len(frame) for frame in labels]])
    total = counts.sum(axis=0)
    return {
        "labels": int(total[-1]),
        "found": [int(n) for n in total[:-1]],
        "recall": [round(float(n / total[-1]), 4) if total[-1] else None for n in total[:-1]],
        **point_estimates(counts, frames, _recalls),
        "intervals": intervals(counts, frames, _recalls),
    }


def _recalls(counts: FloatArray) -> dict[str, FloatArray]:
    return {f"recall_{limit}": ratio(counts[:, limit - 1], counts[:, -1]) for limit in (8, 16, 32)}


def _all(outcomes: Sequence[FrameEvaluation]) -> list[JudgedCandidates]:
    return [outcome.candidates for outcome in outcomes if outcome.candidates is not None]


def _clear(judged: JudgedCandidates, rule: str, field: ProbabilityField) -> tuple[NDArray[np.bool_], FloatArray]:
    verdicts = judged.verdicts[rule]
    clear = verdicts.is_true | verdicts.is_false
    probabilities: FloatArray = getattr(judged, field)
    return verdicts.is_true[clear], probabilities[clear]


def _numbers(verdicts: Verdicts) -> tuple[int, int, int, int]:
    """Returns how many candidates are true, false, unsure and unknown."""
    true, false, unsure = (int(mask.sum()) for mask in (verdicts.is_true, verdicts.is_false, verdicts.kinds == UNSURE))
    return true, false, unsure, len(verdicts.kinds) - true - false - unsure


def _confusion(truth: NDArray[np.bool_], probability: FloatArray, threshold: float) -> tuple[int, int, int, int]:
    accepted = probability >= threshold
    return (
        int((accepted & truth).sum()),
        int((accepted & ~truth).sum()),
        int((~accepted & truth).sum()),
        int((~accepted & ~truth).sum()),
    )


def _integers(values: Sequence[int]) -> NDArray[np.int64]:
    return np.asarray(values, dtype=np.int64)
