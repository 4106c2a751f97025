"""Reported uncertainty: NEES, coverage of the 95 % band, and NIS.

NEES, the normalized estimation error squared, is e' S^-1 e for the errors e at the rows of figures and their reported
covariance S (Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation", 2001, 5.4).
Divided by the number of rows it is 1 on average if S is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import FloatArray
from lanestream_exporter.evaluation.tracking.comparison import BOTTOM, FAR, FIGURE_ROWS, ClipRun, rate, rounded

STATES: Final = ("detected", "inferred", "predicted")
# Half the width of the 95 % band of a normal distribution, in sigmas.
BAND: Final = 1.96
_ROWS: Final = list(FIGURE_ROWS.values())
# Added to variances, in square pixels: columns on the wire are rounded to a hundredth of a pixel.
_ROUNDING: Final = 1e-4


@dataclass(frozen=True)
class ErrorSamples:
    """The errors (N, 3) of followed boundaries at the rows of figures in pixels, NaN where unknown.

    `covariances` (N, 3, 3) are those that were reported for them, and `states` (N,) those of the boundaries.
    """

    states: NDArray[np.str_]
    errors: FloatArray
    covariances: FloatArray

    @classmethod
    def of(cls, runs: Sequence[ClipRun]) -> ErrorSamples:
        """Returns the samples of all frames of clips."""
        states, errors, covariances = [], [np.empty((0, len(_ROWS)))], []
        for frame in (frame for run in runs for frame in run.frames):
            errors.append(frame.errors()[:, _ROWS])
            for index in frame.pairs.values():
                lane = frame.answer.lanes[index]
                states.append(lane.state)
                covariances.append(lane.covariance_at(frame.rows[_ROWS]))
        shape = (-1, len(_ROWS), len(_ROWS))
        return cls(np.array(states, str), np.concatenate(errors), np.array(covariances, float).reshape(shape))

    def take(self, mask: NDArray[np.bool_]) -> ErrorSamples:
        """Returns the samples that a mask (N,) selects."""
        return ErrorSamples(self.states[mask], self.errors[mask], self.covariances[mask])

    def nees(self) -> FloatArray:
        """Returns NEES per degree of freedom (N,), over the rows at which the error is known; NaN if it is at none."""
        nees = np.full(len(self.errors), np.nan)
        known = ~np.isnan(self.errors)
        for rows in np.unique(known, axis=0):
            if rows.any():
                mine = (known == rows).all(axis=1)
                errors = self.errors[mine][:, rows]
                covariances = self.covariances[mine][:, rows][:, :, rows] + _ROUNDING * np.eye(int(rows.sum()))
                inverse = np.linalg.pinv(covariances, hermitian=True)
                nees[mine] = np.einsum("ni,nij,nj->n", errors, inverse, errors) / rows.sum()
        return nees


def uncertainty_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the figures for all followed boundaries and by state; see docs/evaluation.md."""
    samples = ErrorSamples.of(runs)
    by_state = {state: _figures(samples.take(samples.states == state)) for state in STATES}
    return {"all": _figures(samples), **by_state, "nis": nis_figures(runs)}


def nis_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns the mean NIS per degree of freedom of the filter's updates; None for a system that does not report it."""
    values = [value for run in runs for frame in run.frames for value in frame.answer.nis]
    return {"updates": len(values), "per_dof": rounded(float(np.mean(values))) if values else None}


def _figures(samples: ErrorSamples) -> dict[str, Any]:
    nees = samples.nees()
    nees = nees[~np.isnan(nees)]
    sigmas = np.sqrt(np.maximum(np.diagonal(samples.covariances, axis1=1, axis2=2), 0.0))
    return {
        "boundaries": len(samples.states),
        "nees_per_dof": rounded(float(np.mean(nees))) if len(nees) else None,
        "median_nees_per_dof": rounded(float(np.median(nees))) if len(nees) else None,
        "coverage": {
            name: _coverage(samples.errors[:, _ROWS.index(row)], sigmas[:, _ROWS.index(row)])
            for name, row in (("bottom", BOTTOM), ("far", FAR))
        },
    }


def _coverage(errors: FloatArray, sigmas: FloatArray) -> dict[str, Any]:
    known = ~np.isnan(errors)
    inside = int((np.abs(errors[known]) <= BAND * sigmas[known]).sum())
    return {"values": int(known.sum()), "inside": inside, "share": rate(inside, int(known.sum()))}
