"""Probabilities that mean what they say: a temperature and a threshold, from validation frames alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax


@dataclass(frozen=True)
class Calibration:
    """Logits are divided by `temperature`; from the probability `threshold` on a boundary counts as there."""

    temperature: float = 1.0
    threshold: float = 0.5


def calibrated(logits: NDArray[np.float32], labels: NDArray[np.int64]) -> Calibration:
    """The temperature of least log loss and the threshold of best F1, for logits (N, 2) and labels (N,).

    Labels that are all alike can't tell either: then nothing is changed. Source of temperature scaling: C. Guo et al.,
    "On calibration of modern neural networks", 2017.
    """
    if len(np.unique(labels)) < 2:
        return Calibration()
    rows = np.arange(len(labels))

    def log_loss(log_temperature: float) -> float:
        return float(-log_softmax(logits / np.exp(log_temperature), axis=1)[rows, labels].mean())

    found = minimize_scalar(log_loss, bounds=(np.log(0.25), np.log(8.0)), method="bounded")
    temperature = float(np.exp(found.x))
    return Calibration(temperature, _threshold(softmax(logits / temperature, axis=1)[:, 1], labels))


def _threshold(probability: NDArray[np.float64], labels: NDArray[np.int64]) -> float:
    """Three quarters up the thresholds whose F1 is within half a point of the best.

    A plateau outlives its peak. Of its two ends the strict one is the better: a tracker carries a boundary that one
    frame misses, and follows a wrong one that the next frame tells again.
    """
    tried = np.linspace(0.05, 0.95, 91)
    scores = np.array([_f1(probability >= t, labels) for t in tried])
    return float(np.quantile(tried[scores >= scores.max() - 0.005], 0.75))


def _f1(accepted: NDArray[np.bool_], labels: NDArray[np.int64]) -> float:
    hits = float((accepted & (labels == 1)).sum())
    return 2.0 * hits / max(float(accepted.sum() + (labels == 1).sum()), 1.0)
