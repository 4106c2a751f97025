"""The Kalman filter of one boundary: its columns at three fixed rows, and their velocities.

Three rows tell the curve x(y) = v + b u + k / u; a straight boundary is one whose three columns are in line. The model
is nearly constant velocity with the frames' own time steps (Y. Bar-Shalom et al., "Estimation with applications to
tracking and navigation", 2001, section 6.2), its velocity fading as in section 8.2.3: no boundary keeps drifting
unseen. The update is filterpy's, in Joseph form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from filterpy.kalman import KalmanFilter

from lanestream.geometry import RoadView
from lanestream.lanes import Curve, FloatArray, curve_basis

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

    def curve(self, columns: FloatArray) -> Curve:
        """The boundary with these columns (3,) at the rows."""
        return Curve.through(self.horizon, self.y, columns)

    def covariance_of_curve(self, covariance: FloatArray) -> FloatArray:
        """The covariance (3, 3) of the curve's coefficients from that of the columns."""
        inverse = np.linalg.inv(curve_basis(self.horizon, self.y))
        return np.asarray(inverse @ covariance @ inverse.T)

    def measured(self, curve: Curve, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Columns (3,) and their covariance (3, 3) of a detected curve and that of its coefficients."""
        basis = curve_basis(curve.horizon, self.y)
        return curve.x(self.y), np.asarray(basis @ covariance @ basis.T)

    def mapped_to(self, other: Rows) -> FloatArray:
        """The matrix (3, 3) that takes columns at these rows to columns at the other ones."""
        inverse = np.linalg.inv(curve_basis(self.horizon, self.y))
        return np.asarray(curve_basis(self.horizon, other.y) @ inverse)


def boundary_filter(columns: FloatArray, covariance: FloatArray, speed: FloatArray) -> KalmanFilter:
    """A filter that starts at `columns` (3,) with their `covariance` (3, 3), at rest give or take `speed` (3,) px/s."""
    kalman = KalmanFilter(dim_x=6, dim_z=3)
    kalman.x = np.concatenate([columns, np.zeros(3)])
    kalman.H = np.hstack([np.eye(3), np.zeros((3, 3))])
    kalman.P = np.block([[covariance, np.zeros((3, 3))], [np.zeros((3, 3)), np.diag(speed**2)]])
    return kalman


def predict(kalman: KalmanFilter, seconds: float, acceleration: FloatArray) -> None:
    """Moves a filter on by `seconds`, with white `acceleration` (3,) in px/s^2 at its rows."""
    power = np.diag(acceleration**2)
    kept = float(np.exp(-seconds / _FADING_S))
    travel = _FADING_S * (1.0 - kept)
    kalman.F = np.block([[np.eye(3), travel * np.eye(3)], [np.zeros((3, 3)), kept * np.eye(3)]])
    kalman.Q = np.block(
        [[seconds**3 / 3.0 * power, seconds**2 / 2.0 * power], [seconds**2 / 2.0 * power, seconds * power]]
    )
    kalman.predict()


def mahalanobis(kalman: KalmanFilter, columns: FloatArray, noise: FloatArray) -> tuple[float, float]:
    """(squared Mahalanobis distance, log determinant) of the innovation of a measurement with covariance `noise`."""
    innovation = kalman.P[:3, :3] + noise
    residual = columns - kalman.x[:3]
    _, log_determinant = np.linalg.slogdet(innovation)
    return float(residual @ np.linalg.solve(innovation, residual)), float(log_determinant)
