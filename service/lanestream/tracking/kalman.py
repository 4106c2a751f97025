"""The Kalman filter of one boundary: its columns at three fixed rows, and their velocities.

Three rows tell the curve x(y) = v + b u + k / u; a straight boundary is one whose three columns are in line. The model
is nearly constant velocity with the frames' own time steps (Y. Bar-Shalom et al., "Estimation with applications to
tracking and navigation", 2001, section 6.2), its velocity fading as in section 8.2.3: no boundary keeps drifting
unseen. The update is filterpy's, in Joseph form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from filterpy.kalman import KalmanFilter

from lanestream.road.curve import Curve, FloatArray, curve_basis
from lanestream.road.view import RoadView

# Seconds in which an unconfirmed velocity fades to a third.
_FADING_S: Final = 0.4


@dataclass(frozen=True)
class Rows:
    """The three rows (3,) that boundaries are followed at, under the horizon that they were chosen for."""

    horizon: float
    y: FloatArray

    @classmethod
    def of(cls, view: RoadView, shares: tuple[float, float, float]) -> Rows:
        """The rows at `shares` of the depth of a view, nearest first."""
        return cls(view.horizon, view.horizon + np.asarray(shares) * view.depth)

    @cached_property
    def _to_coefficients(self) -> FloatArray:
        """The matrix (3, 3) that takes columns at the rows to a curve's coefficients."""
        return np.asarray(np.linalg.inv(curve_basis(self.horizon, self.y)))

    def curve(self, columns: FloatArray) -> Curve:
        """The boundary with these columns (3,) at the rows."""
        v, b, k = (self._to_coefficients @ columns).tolist()
        return Curve(self.horizon, (v, b, k))

    def covariance_of_curve(self, covariance: FloatArray) -> FloatArray:
        """The covariance (3, 3) of the curve's coefficients from that of the columns."""
        return np.asarray(self._to_coefficients @ covariance @ self._to_coefficients.T)

    def measured(self, curve: Curve, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns (3,) and their covariance (3, 3) of a detected curve and that of its coefficients."""
        basis = curve_basis(curve.horizon, self.y)
        return curve.x(self.y), np.asarray(basis @ covariance @ basis.T)

    def mapped_to(self, other: Rows) -> FloatArray:
        """The matrix (3, 3) that takes columns at these rows to columns at the other ones."""
        return np.asarray(curve_basis(self.horizon, other.y) @ self._to_coefficients)


def boundary_filter(columns: FloatArray, covariance: FloatArray, speed: FloatArray) -> KalmanFilter:
    """A filter that starts at `columns` (3,) with their `covariance` (3, 3), at rest give or take `speed` (3,) px/s."""
    kalman = KalmanFilter(dim_x=6, dim_z=3)
    kalman.x = np.concatenate([columns, np.zeros(3)])
    kalman.H = np.hstack([np.eye(3), np.zeros((3, 3))])
    kalman.P = np.block([[covariance, np.zeros((3, 3))], [np.zeros((3, 3)), np.diag(speed**2)]])
    return kalman


@dataclass(frozen=True)
class Motion:
    """How boundaries move from one frame to the next: the transition F (6, 6) and the noise Q (6, 6) of a step."""

    transition: FloatArray
    noise: FloatArray

    @classmethod
    def over(cls, seconds: float, acceleration: FloatArray) -> Motion:
        """A step of `seconds`, with white `acceleration` (3,) in px/s^2 at the rows."""
        kept = float(np.exp(-seconds / _FADING_S))
        step = np.array([[1.0, _FADING_S * (1.0 - kept)], [0.0, kept]])
        spread = np.array([[seconds**3 / 3.0, seconds**2 / 2.0], [seconds**2 / 2.0, seconds]])
        return cls(np.kron(step, np.eye(3)), np.kron(spread, np.diag(acceleration**2)))

    def move(self, kalman: KalmanFilter) -> None:
        """Moves a filter on by the step."""
        kalman.predict(F=self.transition, Q=self.noise)


def mahalanobis(
    columns: FloatArray, covariances: FloatArray, measured: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(squared Mahalanobis distance, log determinant) of the innovation of each of N tracks for each of M measurements.

    `columns` (N, 3) and `covariances` (N, 3, 3) are the tracks', `measured` (M, 3) and `noise` (M, 3, 3) the others;
    the results are (N, M).
    """
    innovation = covariances[:, None] + noise
    residual = measured - columns[:, None]
    _, log_determinant = np.linalg.slogdet(innovation)
    weighed = np.linalg.solve(innovation, residual[..., None])[..., 0]
    return np.asarray((residual * weighed).sum(axis=2)), np.asarray(log_determinant)
