"""The filter's algebra against a plain reference, against filterpy, and against outliers."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.tracking.kalman import (
    _DEGREES,
    Gaussian,
    MeasurementModel,
    costs,
    outlier_weights,
    predict,
    squared_distances,
    update,
)

Array = NDArray[np.float64]

SEEDS = st.integers(0, 2**32 - 1)
SIZES = st.integers(3, 12)
GROUPS = st.integers(1, 5)


def covariances(rng: np.random.Generator, number: int, size: int, scale: float) -> Array:
    """Returns random positive definite matrices (number, size, size)."""
    root = rng.normal(0.0, scale, (number, size, size))
    return np.asarray(root @ root.swapaxes(1, 2) + scale * np.eye(size))


def random_state(rng: np.random.Generator, size: int) -> Gaussian:
    return Gaussian(rng.normal(0.0, 10.0, size), covariances(rng, 1, size, 2.0)[0])


def linear(matrices: Array) -> MeasurementModel:
    """Returns the model of measurements that are `matrices` (G, 3, n) times the state."""
    return lambda mean: (matrices @ mean, matrices)


def measured_near(rng: np.random.Generator, state: Gaussian, matrices: Array, noise: Array, sigmas: float) -> Array:
    """Returns measurements (G, 3) whose innovations have the Mahalanobis distance `sigmas`."""
    rows = []
    for matrix, own in zip(matrices, noise, strict=True):
        direction = rng.normal(size=3)
        root = np.linalg.cholesky(matrix @ state.covariance @ matrix.T + own)
        rows.append(matrix @ state.mean + root @ direction * sigmas / np.linalg.norm(direction))
    return np.array(rows)


def reference(state: Gaussian) -> KalmanFilter:
    """Returns filterpy's filter at a state, for measurements of three values."""
    kalman = KalmanFilter(dim_x=len(state.mean), dim_z=3)
    kalman.x, kalman.P = state.mean[:, None].copy(), state.covariance.copy()
    return kalman


def in_information_form(state: Gaussian, matrices: Array, measured: Array, noise: Array, weights: Array) -> Gaussian:
    """Returns the updated state of the textbook: information matrices and vectors add up, one source at a time."""
    information = np.linalg.inv(state.covariance)
    vector = information @ state.mean
    for matrix, values, own, weight in zip(matrices, measured, noise, weights, strict=True):
        gained = matrix.T @ np.linalg.inv(own / weight)
        information = information + gained @ matrix
        vector = vector + gained @ values
    covariance = np.linalg.inv(information)
    return Gaussian(covariance @ vector, covariance)


def assert_same(one: Gaussian, other: Gaussian) -> None:
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-7)


def assert_is_covariance(matrix: Array) -> None:
    np.testing.assert_array_equal(matrix, matrix.T)
    eigenvalues = np.linalg.eigvalsh(matrix)
    assert eigenvalues[0] >= -1e-10 * eigenvalues[-1]


@given(seed=SEEDS, size=SIZES)
def test_predict_is_filterpys(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    state, transition, noise = random_state(rng, size), rng.normal(size=(size, size)), covariances(rng, 1, size, 1.0)[0]
    kalman = reference(state)
    kalman.predict(F=transition, Q=noise)
    assert_same(predict(state, transition, noise), Gaussian(kalman.x[:, 0], kalman.P))


@given(seed=SEEDS, size=SIZES, groups=GROUPS, scale=st.floats(0.05, 20.0))
def test_an_update_without_outliers_is_the_textbooks_and_filterpys(
    seed: int, size: int, groups: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    state, matrices = random_state(rng, size), rng.normal(size=(groups, 3, size))
    noise = covariances(rng, groups, 3, scale)
    measured = measured_near(rng, state, matrices, noise, 1.7)
    updated, _ = update(state, linear(matrices), measured, noise)
    assert_same(updated, in_information_form(state, matrices, measured, noise, np.ones(groups)))
    kalman = reference(state)
    for matrix, values, own in zip(matrices, measured, noise, strict=True):
        kalman.update(values[:, None], R=own, H=matrix)
    assert_same(updated, Gaussian(kalman.x[:, 0], kalman.P))
    assert_is_covariance(updated.covariance)


@given(seed=SEEDS, size=SIZES, groups=GROUPS, sigmas=st.floats(0.0, 60.0))
def test_an_outliers_noise_is_divided_by_its_weight(seed: int, size: int, groups: int, sigmas: float) -> None:
    rng = np.random.default_rng(seed)
    state, matrices = random_state(rng, size), rng.normal(size=(groups, 3, size))
    noise = covariances(rng, groups, 3, 1.0)
    measured = measured_near(rng, state, matrices, noise, 0.5)
    measured[:1] = measured_near(rng, state, matrices[:1], noise[:1], sigmas)
    weights = np.ones(groups)
    weights[0] = min(1.0, (_DEGREES + 3.0) / (_DEGREES + sigmas**2))
    updated, _ = update(state, linear(matrices), measured, noise)
    assert_same(updated, in_information_form(state, matrices, measured, noise, weights))
    assert_is_covariance(updated.covariance)


def test_the_update_is_iterated_for_nonlinear_measurements() -> None:
    """Two rounds come closer to the most probable state than one."""
    state, noise = Gaussian(np.array([1.0]), np.array([[1.0]])), 0.01 * np.eye(3)[None]

    def squares(mean: Array) -> tuple[Array, Array]:
        return np.full((1, 3), mean[0] ** 2), np.full((1, 3, 1), 2.0 * mean[0])

    measured = np.full((1, 3), 1.5**2)
    candidates = np.linspace(0.0, 3.0, 30001)
    weight = float(outlier_weights(squared_distances(state, *squares(state.mean), measured, noise))[0])
    misfit = (candidates - 1.0) ** 2 + 3.0 * weight * (candidates**2 - 1.5**2) ** 2 / 0.01
    best = candidates[misfit.argmin()]
    jacobian = squares(state.mean)[1]
    once = in_information_form(state, jacobian, measured - 1.0 + jacobian @ state.mean, noise, np.array([weight]))
    updated, _ = update(state, squares, measured, noise)
    assert abs(updated.mean[0] - best) < 0.3 * abs(once.mean[0] - best)


def test_the_farther_away_an_outlier_is_the_less_it_moves_the_state() -> None:
    state, matrices, noise = Gaussian(np.zeros(3), np.eye(3)), np.eye(3)[None], np.eye(3)[None]
    errors = np.array([1.0, 3.0, 10.0, 30.0, 100.0])
    moved = np.array([update(state, linear(matrices), np.full((1, 3), e), noise)[0].mean[0] for e in errors])
    shares = moved / errors
    assert shares[0] == pytest.approx(0.5), "a usual error counts in full"
    assert (np.diff(shares) < 0.0).all()
    assert moved[-1] < moved[0], "a very large one counts less than a usual one"


@given(seed=SEEDS, tracks=GROUPS, detections=GROUPS)
def test_distances_and_costs_are_those_of_filterpys_innovations(seed: int, tracks: int, detections: int) -> None:
    rng = np.random.default_rng(seed)
    expected, measured = rng.normal(0.0, 5.0, (tracks, 3)), rng.normal(0.0, 5.0, (detections, 3))
    spread, noise = covariances(rng, tracks, 3, 2.0), covariances(rng, detections, 3, 1.0)
    found = costs(expected, spread, measured, noise)
    assert found.shape == (tracks, detections)
    for i in range(tracks):
        state = Gaussian(expected[i], spread[i])
        for j in range(detections):
            kalman = reference(state)
            kalman.update(measured[j][:, None], R=noise[j], H=np.eye(3))
            squared = kalman.mahalanobis**2
            seen = (measured[j : j + 1], noise[j : j + 1])
            distance = squared_distances(state, *linear(np.eye(3)[None])(state.mean), *seen)
            assert distance == pytest.approx(squared, rel=1e-6, abs=1e-9)
            log_likelihood = (_DEGREES + 3.0) * np.log(1.0 + squared / _DEGREES) + np.log(np.linalg.det(kalman.S))
            assert found[i, j] == pytest.approx(log_likelihood, rel=1e-6, abs=1e-8)
