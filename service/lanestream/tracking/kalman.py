"""The algebra of the extended Kalman filter: prediction, innovations, and an update that outliers can't dominate.

The equations are those of Y. Bar-Shalom, X. R. Li and T. Kirubarajan, "Estimation with applications to tracking and
navigation" (2001): prediction in section 5.2.3, the update in Joseph form in section 5.4.2, its iteration for nonlinear
measurements in section 10.5.2. filterpy has the same filter, but it brings SciPy and Matplotlib into every service; the
tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from lanestream.road.curve import FloatArray

# The degrees of freedom of the Student-t distribution of measurement errors: most are small, some are large.
_DEGREES: Final = 3.6
# How often an update is linearized. The second time is exact to a hundredth of a pixel on any road.
_ROUNDS: Final = 2

# Returns the predicted measurements (G, 3) of a state (n,), and their derivatives (G, 3, n).
MeasurementModel = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Gaussian:
    """A state (n,) with its covariance (n, n)."""

    mean: FloatArray
    covariance: FloatArray


def predict(state: Gaussian, transition: FloatArray, noise: FloatArray) -> Gaussian:
    """Returns the state after a step: F x and F P F' + Q, with the `transition` F and the process `noise` Q."""
    return Gaussian(transition @ state.mean, transition @ state.covariance @ transition.T + noise)


def update(
    state: Gaussian, model: MeasurementModel, measured: FloatArray, noise: FloatArray
) -> tuple[Gaussian, FloatArray]:
    """Returns the state after the measurements of G sources, and the normalized innovations squared (G,) of these.

    Each measurement may be an outlier.

    `measured` (G, 3) are their values, which `model` predicts; `noise` (G, 3, 3) are their covariances R. With the
    innovation y, its covariance S = H P H' + R and the gain K = P H' S^-1, the state is x + K y and its covariance
    (I - K H) P (I - K H)' + K R K'. A source's R is divided by the weight that a Student-t distribution gives its
    innovation (M. Roth, E. Ozkan and F. Gustafsson, "A Student's t filter for heavy tailed process and measurement
    noise", 2013), so a single wrong measurement moves the state little.
    """
    mean, covariance = state.mean, state.covariance
    values, jacobian = model(mean)
    distances = squared_distances(state, values, jacobian, measured, noise)
    weights = outlier_weights(distances)
    for number in range(_ROUNDS):
        if number:
            values, jacobian = model(mean)
        scattered = _block_diagonal(noise / weights[:, None, None])
        matrix = jacobian.reshape(-1, len(mean))
        spread = covariance @ matrix.T
        gain = np.linalg.solve(matrix @ spread + scattered, spread.T).T
        residual = (measured - values).ravel() - matrix @ (state.mean - mean)
        mean = state.mean + gain @ residual
    remaining = np.eye(len(mean)) - gain @ matrix
    joseph = remaining @ covariance @ remaining.T + gain @ scattered @ gain.T
    return Gaussian(mean, 0.5 * (joseph + joseph.T)), distances


def squared_distances(
    state: Gaussian, values: FloatArray, jacobian: FloatArray, measured: FloatArray, noise: FloatArray
) -> FloatArray:
    """Returns the squared Mahalanobis distance y' S^-1 y (G,) of each source's innovation, see `update`."""
    innovation = jacobian @ state.covariance @ jacobian.swapaxes(1, 2) + noise
    residual = measured - values
    weighted = np.linalg.solve(innovation, residual[:, :, None])[:, :, 0]
    return np.asarray((residual * weighted).sum(axis=1))


def costs(expected: FloatArray, covariances: FloatArray, measured: FloatArray, noise: FloatArray) -> FloatArray:
    """Returns the negative log likelihood (N, M), but for a constant, that N predictions belong to M measurements.

    `expected` (N, 3) with `covariances` (N, 3, 3) are predicted, `measured` (M, 3) have the covariances `noise`
    (M, 3, 3). The innovations have the Student-t distribution of `update`.
    """
    innovation = covariances[:, None] + noise
    residual = measured - expected[:, None]
    weighted = np.linalg.solve(innovation, residual[..., None])[..., 0]
    distances = (residual * weighted).sum(axis=2)
    _, log_determinants = np.linalg.slogdet(innovation)
    return np.asarray((_DEGREES + 3.0) * np.log1p(distances / _DEGREES) + log_determinants)


def outlier_weights(distances: FloatArray) -> FloatArray:
    """Returns the weights (G,), at most 1, of sources whose innovations of three values have squared `distances`."""
    return np.minimum(1.0, (_DEGREES + 3.0) / (_DEGREES + distances))


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """Returns the matrix with `blocks` (G, 3, 3) on its diagonal."""
    groups, size, _ = blocks.shape
    matrix = np.zeros((groups, size, groups, size))
    indices = np.arange(groups)
    matrix[indices, :, indices, :] = blocks
    return matrix.reshape(groups * size, groups * size)
