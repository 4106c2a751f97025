"""The road filter: one extended Kalman filter for all boundaries that a camera sees.

On a flat road all boundaries share a vanishing point and a curvature, and they move sideways together as the vehicle
does. So a boundary that is hidden follows the others, and its identity survives. With lengths in depths of the road
view (from the mean horizon to the bottom row), a boundary is

    x(t) = V + d + b (t - h) + C / (t - h)

at t depths below the mean horizon. Shared by all: h, how far the frame's horizon is below the mean one (pitch), the
vanishing column V, the curvature term C, and the sideways speed s, with which every b falls. A boundary's own: its
place b, and its small departure d from the vanishing column.

Errors of detections are correlated in time: the same shadow or worn stripe misleads a detector for some frames. Two
more states absorb that: an error of every boundary's direction that all share, because they are fitted together, and
an error of each boundary's place. Both are Ornstein-Uhlenbeck processes (Y. Bar-Shalom et al., "Estimation with
applications to tracking and navigation", 2001, section 8.2.3; state augmentation for colored measurement noise in
section 8.3). A filter that takes correlated errors for white noise is too sure of itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lanestream.road.curve import Curves, FloatArray, curve_basis
from lanestream.road.results import Detection, Estimate, RoadEstimate
from lanestream.road.view import RoadView
from lanestream.tracking.kalman import Gaussian, predict, update

# The shared states: pitch, vanishing column and its rate, curvature term and its rate, sideways speed, and the shared
# error of the vanishing column.
PITCH, COLUMN, COLUMN_RATE, CURVATURE, CURVATURE_RATE, SIDEWAYS, COLUMN_ERROR = range(7)
ROAD: Final = 7
# The states of each boundary: its place, its departure from the vanishing column, and the error of its place.
PLACE, DEPARTURE, PLACE_ERROR = range(3)
OWN: Final = 3

# Boundaries are measured at these rows, in depths below the mean horizon.
ROWS: Final[FloatArray] = np.array([1.0, 0.5, 0.2])
# The frame's horizon is at most so far from the mean one. A filter that believes more has lost the road.
MOST_PITCH: Final = 0.3
# A row counts at least this far below the frame's horizon.
_NEAREST_HORIZON: Final = 0.02

# --- How the states move, in depths and seconds ---------------------------------------------------------------------

# Time constants of the decay: of the pitch towards its mean, of the rates and of the sideways speed towards zero, of
# departures, and of the correlated errors.
_PITCH_S, _RATE_S, _SIDEWAYS_S, _DEPARTURE_S, _ERROR_S = 1.1, 0.7, 2.2, 0.75, 0.14
# White noise that drives the rates of the vanishing column and of the curvature term, and the sideways speed.
_COLUMN_NOISE, _CURVATURE_NOISE, _SIDEWAYS_NOISE = 1.0, 0.035, 1.0
# The place of a boundary drifts by this, per square root of a second.
_PLACE_NOISE: Final = 0.1
# Stationary sigmas of the pitch, the departures and the correlated errors of the vanishing column and of places.
_PITCH_SIGMA, _DEPARTURE_SIGMA, _COLUMN_ERROR_SIGMA, _PLACE_ERROR_SIGMA = 0.03, 0.06, 0.01, 0.027
# Sigmas of a road before its first measurement, in the order of the shared states; the pitch and the error are known.
_FIRST_SIGMAS: Final = np.array([0.0, 10.0, 0.3, 1.0, 0.1, 0.5, 0.0])
# Sigma of the place of a new boundary, and of the departure of one that may not belong to the road.
_NEW_PLACE, _NEW_DEPARTURE = 3.0, 0.1
# The same for one that coasts, besides.
_COASTING_NOISE: Final = 0.2
# What is added to the sigma of the place of a boundary that was elsewhere than expected for some frames.
_LOOSENED: Final = 0.15

# Errors of detections are this much larger than their fits' covariances say, and have at least these sigmas at ROWS.
_FIT_SCALE: Final = 2.2
_ROW_SIGMAS: Final = np.array([0.006, 0.003, 0.003])

# Errors that last for seconds, which no filter can average out: of every place, in row offsets, of the vanishing column
# and of the curvature term. Reported uncertainties include them.
_PLACE_BIAS, _COLUMN_BIAS, _CURVATURE_BIAS = 0.06, 0.018, 0.004


@dataclass(frozen=True)
class RoadFilter:
    """The state of the road and of its N boundaries. Lengths are in depths, unless named otherwise.

    `horizon` and `depth` are in pixels: of the view that defined the rows. `rest` is the mean of the pitch state.
    """

    horizon: float
    depth: float
    rest: float
    state: Gaussian

    @classmethod
    def started(cls, view: RoadView) -> RoadFilter:
        """Returns the filter of a road that is unknown but for its horizon."""
        variances = _FIRST_SIGMAS**2
        variances[PITCH] += _PITCH_SIGMA**2
        variances[COLUMN_ERROR] += _COLUMN_ERROR_SIGMA**2
        return cls(view.horizon, view.depth, 0.0, Gaussian(np.zeros(ROAD), np.diag(variances)))

    @property
    def number(self) -> int:
        """The number of boundaries."""
        return (len(self.state.mean) - ROAD) // OWN

    @property
    def places(self) -> FloatArray:
        """The places b (N,) of the boundaries."""
        return self.state.mean[ROAD + PLACE :: OWN]

    @property
    def rows(self) -> FloatArray:
        """The rows (3,) of the image at which boundaries are measured, in pixels."""
        return self.horizon + ROWS * self.depth

    @property
    def pitched_horizon(self) -> float:
        """The row of the frame's horizon, in pixels."""
        return self.horizon + float(self.state.mean[PITCH]) * self.depth

    @property
    def is_sound(self) -> bool:
        """Whether the filter has not diverged."""
        return bool(np.isfinite(self.state.mean).all()) and abs(float(self.state.mean[PITCH])) <= MOST_PITCH

    @property
    def place_sigmas(self) -> FloatArray:
        """The sigmas (N,) of the places of the boundaries."""
        return np.sqrt(self.state.covariance.diagonal()[ROAD + PLACE :: OWN])

    @property
    def sideways(self) -> Estimate:
        """The speed at which the vehicle moves to the right, in row offsets per second."""
        return Estimate(float(self.state.mean[SIDEWAYS]), self._sigma(SIDEWAYS))

    @property
    def estimate(self) -> RoadEstimate:
        """What all boundaries share, in pixels."""
        mean, depth = self.state.mean, self.depth
        return RoadEstimate(
            vanishing_column=Estimate(
                float(mean[COLUMN]) * depth, float(np.hypot(self._sigma(COLUMN), _COLUMN_BIAS)) * depth
            ),
            curvature=Estimate(
                float(mean[CURVATURE]) * depth**2, float(np.hypot(self._sigma(CURVATURE), _CURVATURE_BIAS)) * depth**2
            ),
            lateral_rate=self.sideways,
        )

    def lane_center(self, left: int, right: int) -> Estimate:
        """Returns the column midway between two boundaries at the nearest row, in depths."""
        values, jacobian = _columns(self.state.mean, np.array([left, right]), with_errors=False)
        gradient = 0.5 * (jacobian[0, 0] + jacobian[1, 0])
        variance = float(gradient @ self.state.covariance @ gradient) + 0.5 * _PLACE_BIAS**2 + _COLUMN_BIAS**2
        return Estimate(0.5 * float(values[0, 0] + values[1, 0]), float(np.sqrt(variance)))

    def _sigma(self, index: int) -> float:
        return float(np.sqrt(self.state.covariance[index, index]))

    def resting_at(self, horizon: float) -> RoadFilter:
        """Returns the filter whose pitch returns to the row `horizon`, in pixels."""
        return replace(self, rest=(horizon - self.horizon) / self.depth)

    def rounded(self) -> RoadFilter:
        """Returns the filter in single precision, in which it is saved: a restored one continues exactly."""
        mean, covariance = (
            np.asarray(a, np.float32).astype(np.float64) for a in (self.state.mean, self.state.covariance)
        )
        return replace(self, state=Gaussian(mean, covariance))

    def predicted(self, seconds: float, activity: float, scales: FloatArray, coasting: NDArray[np.bool_]) -> RoadFilter:
        """Returns the filter after a step of `seconds`.

        `activity` multiplies the variances with which the road moves, and `scales` (N,) those of correlated errors.
        The places of boundaries that are `coasting` (N,) become less certain.
        """
        transition, noise = _motion(self.number, seconds, activity, scales)
        places = ROAD + PLACE + OWN * np.flatnonzero(coasting)
        noise[places, places] += _COASTING_NOISE**2 * seconds
        state = predict(self.state, transition, noise)
        state.mean[PITCH] += (1.0 - transition[PITCH, PITCH]) * self.rest
        return replace(self, state=state)

    def measure(self, detections: Sequence[Detection]) -> tuple[FloatArray, FloatArray]:
        """Returns the columns (M, 3) of detections at the rows, and their covariances (M, 3, 3), in depths."""
        values, noise = np.empty((len(detections), 3)), np.empty((len(detections), 3, 3))
        for j, detection in enumerate(detections):
            basis = curve_basis(detection.curve.horizon, self.rows) / self.depth
            values[j] = basis @ detection.curve.coefficients
            noise[j] = _FIT_SCALE**2 * (basis @ detection.covariance @ basis.T)
        return values, noise + np.diag(_ROW_SIGMAS**2)

    def expected(self) -> tuple[FloatArray, FloatArray]:
        """Returns the columns (N, 3) of the boundaries at the rows with their covariances (N, 3, 3), in depths."""
        indices = np.arange(self.number)
        values, jacobian = _columns(self.state.mean, indices, with_errors=True)
        return values, jacobian @ self.state.covariance @ jacobian.swapaxes(1, 2)

    def updated(
        self, indices: NDArray[np.intp], values: FloatArray, noise: FloatArray
    ) -> tuple[RoadFilter, FloatArray]:
        """Returns the filter after the boundaries at `indices` (G,) were measured, see `measure`.

        The second value (G,) is the normalized innovation squared of each measurement.
        """
        state, distances = update(self.state, lambda mean: _columns(mean, indices, with_errors=True), values, noise)
        return replace(self, state=state), distances

    def with_boundaries(self, curves: Curves) -> RoadFilter:
        """Returns the filter with more boundaries, about where `curves` are; measurements must follow.

        The first boundaries define the road.
        """
        number, added = self.number, len(curves)
        mean = np.concatenate([self.state.mean, np.zeros(OWN * added)])
        if not number:
            v, _, k = np.median(curves.coefficients, axis=0)
            mean[COLUMN], mean[CURVATURE] = v / self.depth, k / self.depth**2
            mean[PITCH] = (curves.horizon - self.horizon) / self.depth
        t = ROWS[1] - mean[PITCH]
        columns = curves.x(self.rows[1:2])[:, 0] / self.depth
        mean[ROAD + OWN * number + PLACE :: OWN] = (columns - mean[COLUMN] - mean[CURVATURE] / t) / t
        covariance = np.zeros((len(mean), len(mean)))
        covariance[: len(mean) - OWN * added, : len(mean) - OWN * added] = self.state.covariance
        departure = _NEW_DEPARTURE if number else _DEPARTURE_SIGMA
        own = np.tile(np.array([_NEW_PLACE, departure, _PLACE_ERROR_SIGMA]) ** 2, added)
        new = np.arange(len(mean) - OWN * added, len(mean))
        covariance[new, new] = own
        return replace(self, state=Gaussian(mean, covariance))

    def loosened(self, indices: Sequence[int]) -> RoadFilter:
        """Returns the filter with less certain places of the boundaries at `indices`."""
        if not indices:
            return self
        covariance = self.state.covariance.copy()
        own = ROAD + OWN * np.asarray(indices, np.intp)
        covariance[own + PLACE, own + PLACE] += _LOOSENED**2
        return replace(self, state=Gaussian(self.state.mean, covariance))

    def with_only(self, kept: Sequence[int]) -> RoadFilter:
        """Returns the filter with the boundaries at the indices `kept`, in that order."""
        if list(kept) == list(range(self.number)):
            return self
        own = ROAD + OWN * np.asarray(kept, np.intp)[:, None] + np.arange(OWN)
        indices = np.concatenate([np.arange(ROAD), own.ravel()])
        state = self.state
        return replace(self, state=Gaussian(state.mean[indices], state.covariance[np.ix_(indices, indices)]))

    def below(self, view: RoadView) -> RoadFilter:
        """Returns the filter with rows chosen for `view`, to whose horizon its pitch returns."""
        ratio = self.depth / view.depth
        scale = np.ones(len(self.state.mean))
        scale[[PITCH, COLUMN, COLUMN_RATE, COLUMN_ERROR]] = ratio
        scale[[CURVATURE, CURVATURE_RATE]] = ratio**2
        scale[ROAD + DEPARTURE :: OWN] = ratio
        mean = self.state.mean * scale
        mean[PITCH] += (self.horizon - view.horizon) / view.depth
        state = Gaussian(mean, self.state.covariance * np.outer(scale, scale))
        return RoadFilter(view.horizon, view.depth, 0.0, state)

    def curves(self) -> Curves:
        """Returns the boundaries, in pixels."""
        mean = self.state.mean
        coefficients = np.empty((self.number, 3))
        coefficients[:, 0] = (mean[COLUMN] + mean[ROAD + DEPARTURE :: OWN]) * self.depth
        coefficients[:, 1] = self.places
        coefficients[:, 2] = mean[CURVATURE] * self.depth**2
        return Curves(self.pitched_horizon, coefficients)

    def covariances(self, bias_scales: FloatArray) -> FloatArray:
        """Returns the covariances (N, 3, 3) of the coefficients of `curves`.

        They include the uncertainty of the horizon: they give the right sigmas of columns at the rows. `bias_scales`
        (N,) multiply the variances of errors that last.
        """
        _, jacobian = _columns(self.state.mean, np.arange(self.number), with_errors=False)
        jacobian *= self.depth
        inverse = np.linalg.inv(curve_basis(self.pitched_horizon, self.rows))
        covariances = inverse @ (jacobian @ self.state.covariance @ jacobian.swapaxes(1, 2)) @ inverse.T
        covariances[:, 0, 0] += (_COLUMN_BIAS * self.depth) ** 2 * bias_scales
        covariances[:, 1, 1] += _PLACE_BIAS**2 * bias_scales
        return np.asarray(covariances)


def _columns(mean: FloatArray, indices: NDArray[np.intp], with_errors: bool) -> tuple[FloatArray, FloatArray]:
    """Returns the columns (G, 3) at ROWS of the boundaries at `indices` (G,), and their derivatives (G, 3, n).

    Detections have correlated errors, boundaries don't.
    """
    t = np.maximum(ROWS - mean[PITCH], _NEAREST_HORIZON)
    own = ROAD + OWN * indices
    place, departure, error = mean[own + PLACE], mean[own + DEPARTURE], mean[own + PLACE_ERROR]
    shared = mean[COLUMN] + mean[CURVATURE] / t
    values = shared + departure[:, None] + place[:, None] * t
    jacobian = np.zeros((len(indices), 3, len(mean)))
    jacobian[:, :, PITCH] = mean[CURVATURE] / t**2 - place[:, None]
    jacobian[:, :, COLUMN] = 1.0
    jacobian[:, :, CURVATURE] = 1.0 / t
    group = np.arange(len(indices))
    jacobian[group, :, own + PLACE] = t
    jacobian[group, :, own + DEPARTURE] = 1.0
    if with_errors:
        values += mean[COLUMN_ERROR] + error[:, None] * t
        jacobian[:, :, PITCH] -= error[:, None]
        jacobian[:, :, COLUMN_ERROR] = 1.0
        jacobian[group, :, own + PLACE_ERROR] = t
    return values, jacobian


def _motion(number: int, seconds: float, activity: float, scales: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns the transition (n, n) and the noise (n, n) of a step of `seconds` of a road with N boundaries."""
    size = ROAD + OWN * number
    places = ROAD + PLACE + OWN * np.arange(number)
    diagonal, noise = np.ones(size), np.zeros((size, size))
    transition = np.zeros((size, size))

    def revert(states: int | NDArray[np.intp], decay_s: float, variance: float | FloatArray) -> None:
        """An Ornstein-Uhlenbeck process."""
        kept = float(np.exp(-seconds / decay_s))
        diagonal[states] = kept
        noise[states, states] = variance * (1.0 - kept**2)

    def integrate(states: int | NDArray[np.intp], rate: int, decay_s: float, drive: float, sign: float = 1.0) -> None:
        """A rate that decays, driven by white noise, and the states that it moves."""
        kept = float(np.exp(-seconds / decay_s))
        diagonal[rate] = kept
        transition[states, rate] = sign * decay_s * (1.0 - kept)
        power = activity * drive**2
        moved = np.atleast_1d(states)
        noise[np.ix_(moved, moved)] += power * seconds**3 / 3.0
        noise[moved, rate] += sign * power * seconds**2 / 2.0
        noise[rate, moved] += sign * power * seconds**2 / 2.0
        noise[rate, rate] += power * seconds

    revert(PITCH, _PITCH_S, activity * _PITCH_SIGMA**2)
    revert(COLUMN_ERROR, _ERROR_S, _COLUMN_ERROR_SIGMA**2 * (float(scales.mean()) if number else 1.0))
    revert(places - PLACE + DEPARTURE, _DEPARTURE_S, activity * _DEPARTURE_SIGMA**2)
    revert(places - PLACE + PLACE_ERROR, _ERROR_S, _PLACE_ERROR_SIGMA**2 * scales)
    integrate(COLUMN, COLUMN_RATE, _RATE_S, _COLUMN_NOISE)
    integrate(CURVATURE, CURVATURE_RATE, _RATE_S, _CURVATURE_NOISE)
    integrate(places, SIDEWAYS, _SIDEWAYS_S, _SIDEWAYS_NOISE, -1.0)
    noise[places, places] += activity * _PLACE_NOISE**2 * seconds
    indices = np.arange(size)
    transition[indices, indices] = diagonal
    return transition, noise
