"""The Kalman filter of boundaries: their columns at three fixed rows, and the velocities of these columns.

Three rows determine the curve x(y) = v + b u + k / u; if it is straight, the three columns are collinear. The model
is nearly constant velocity with the frames' own time steps (Y. Bar-Shalom et al., "Estimation with applications to
tracking and navigation", 2001, section 6.2), with a velocity that decays as in section 8.2.3, so no boundary keeps
drifting without detections. The update is in Joseph form (section 5.2.2). All functions take a batch of boundaries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from lanestream.road.curve import Curve, Curves, FloatArray, curve_basis
from lanestream.road.view import RoadView

# The dimensions of a measurement (three columns) and of a state (columns and velocities).
MEASURED: Final = 3
STATE: Final = 6

# Time constant of the velocity's decay in seconds.
_DECAY_S: Final = 0.4


@dataclass(frozen=True)
class TrackedRows:
    """The three rows `y` (3,) at which boundaries are tracked, below the horizon for which they were chosen."""

    horizon: float
    y: FloatArray

    @classmethod
    def of(cls, view: RoadView, shares: FloatArray) -> TrackedRows:
        """Returns the rows at `shares` (3,) of the depth of a view, nearest first."""
        return cls(view.horizon, view.horizon + shares * view.depth)

    @cached_property
    def _to_coefficients(self) -> FloatArray:
        """The matrix (3, 3) from columns at the rows to a curve's coefficients."""
        return np.asarray(np.linalg.inv(curve_basis(self.horizon, self.y)))

    def curves(self, columns: FloatArray) -> Curves:
        """Returns the boundaries with these `columns` (N, 3) at the rows."""
        return Curves(self.horizon, columns @ self._to_coefficients.T)

    def covariances_of_curves(self, covariances: FloatArray) -> FloatArray:
        """Returns the covariances (N, 3, 3) of the curves' coefficients from those of the columns."""
        return np.asarray(self._to_coefficients @ covariances @ self._to_coefficients.T)

    def measure(self, curve: Curve, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the columns (3,) of a detected curve and their covariance (3, 3), from that of its coefficients."""
        basis = curve_basis(curve.horizon, self.y)
        return basis @ curve.coefficients, np.asarray(basis @ covariance @ basis.T)

    def mapping_to(self, other: TrackedRows) -> FloatArray:
        """Returns the matrix (3, 3) from columns at these rows to columns at the `other` ones."""
        return np.asarray(curve_basis(self.horizon, other.y) @ self._to_coefficients)


def initial_state(columns: FloatArray, covariance: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns the state (6,) and covariance (6, 6) of a new boundary.

    It is at `columns` (3,) with their `covariance` (3, 3), at rest within `speed` (3,) pixels per second.
    """
    state = np.concatenate([columns, np.zeros(MEASURED)])
    full = np.zeros((STATE, STATE))
    full[:MEASURED, :MEASURED] = covariance
    full[MEASURED:, MEASURED:] = np.diag(speed**2)
    return state, full


def predict(
    states: FloatArray, covariances: FloatArray, seconds: float, acceleration: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns states (N, 6) and covariances (N, 6, 6) after a step of `seconds`: F x and F P F' + Q.

    `acceleration` (3,) is the white acceleration noise at the rows, in pixels per second squared.
    """
    kept = float(np.exp(-seconds / _DECAY_S))
    step = np.array([[1.0, _DECAY_S * (1.0 - kept)], [0.0, kept]])
    spread = np.array([[seconds**3 / 3.0, seconds**2 / 2.0], [seconds**2 / 2.0, seconds]])
    transition = np.kron(step, np.eye(MEASURED))
    noise = np.kron(spread, np.diag(acceleration**2))
    return states @ transition.T, transition @ covariances @ transition.T + noise


def update(
    states: FloatArray, covariances: FloatArray, columns: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns states (N, 6) and covariances (N, 6, 6) after the measurements `columns` (N, 3).

    `noise` (N, 3, 3) are the measurements' covariances R. With S = H P H' + R, the gain is K = P H' S^-1, the state
    x + K (z - H x) and the covariance (I - K H) P (I - K H)' + K R K'.
    """
    innovation = covariances[:, :MEASURED, :MEASURED] + noise
    gain = covariances[:, :, :MEASURED] @ np.linalg.inv(innovation)
    residual = columns - states[:, :MEASURED]
    remaining = np.broadcast_to(np.eye(STATE), covariances.shape).copy()
    remaining[:, :, :MEASURED] -= gain
    joseph = remaining @ covariances @ remaining.swapaxes(1, 2) + gain @ noise @ gain.swapaxes(1, 2)
    return states + (gain @ residual[:, :, None])[:, :, 0], joseph


def innovation_distances(
    columns: FloatArray, covariances: FloatArray, measured: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Returns squared Mahalanobis distances and log determinants (N, M) of N tracks' innovations for M measurements.

    `columns` (N, 3) and `covariances` (N, 3, 3) are the tracks', `measured` (M, 3) and `noise` (M, 3, 3) the
    detections'.
    """
    innovation = covariances[:, None] + noise
    residual = measured - columns[:, None]
    _, log_determinant = np.linalg.slogdet(innovation)
    weighted = np.linalg.solve(innovation, residual[..., None])[..., 0]
    return np.asarray((residual * weighted).sum(axis=2)), np.asarray(log_determinant)
