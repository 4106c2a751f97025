"""The Kalman filter against filterpy, and its coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.road.curve import Curve
from lanestream.road.view import RoadView
from lanestream.tracking.kalman import (
    MEASURED,
    STATE,
    TrackedRows,
    initial_state,
    innovation_distances,
    predict,
    update,
)

Array = NDArray[np.float64]

VIEW = RoadView(640, 360, 160.0)
SHARES = np.array([1.0, 0.5, 0.2])
DECAY_S = 0.4
BATCHES = st.integers(1, 5)
SEEDS = st.integers(0, 2**32 - 1)


def covariances(rng: np.random.Generator, number: int, size: int, scale: float) -> Array:
    """Returns random positive definite matrices (number, size, size)."""
    root = rng.normal(0.0, scale, (number, size, size))
    return root @ root.swapaxes(1, 2) + scale * np.eye(size)


def reference(state: Array, covariance: Array) -> KalmanFilter:
    """Returns filterpy's filter at a state, which measures its first three components."""
    kalman = KalmanFilter(dim_x=STATE, dim_z=MEASURED)
    kalman.x, kalman.P = state[:, None].copy(), covariance.copy()
    kalman.H = np.eye(MEASURED, STATE)
    return kalman


def transition(seconds: float) -> Array:
    """Returns the matrix F of a velocity that decays: its integral over the step moves the column."""
    kept = np.exp(-seconds / DECAY_S)
    matrix = np.eye(STATE)
    matrix[:MEASURED, MEASURED:] = DECAY_S * (1.0 - kept) * np.eye(MEASURED)
    matrix[MEASURED:, MEASURED:] = kept * np.eye(MEASURED)
    return matrix


def process_noise(seconds: float, acceleration: Array) -> Array:
    """Returns the matrix Q of white acceleration noise, integrated over the step."""
    noise = np.zeros((STATE, STATE))
    for row, sigma in enumerate(acceleration.tolist()):
        noise[row, row] = sigma**2 * seconds**3 / 3.0
        noise[row, row + MEASURED] = noise[row + MEASURED, row] = sigma**2 * seconds**2 / 2.0
        noise[row + MEASURED, row + MEASURED] = sigma**2 * seconds
    return noise


@given(seed=SEEDS, number=BATCHES, seconds=st.floats(0.0, 1.4))
def test_predict_is_filterpys(seed: int, number: int, seconds: float) -> None:
    rng = np.random.default_rng(seed)
    states, acceleration = rng.normal(0.0, 300.0, (number, STATE)), rng.uniform(1.0, 900.0, MEASURED)
    before = covariances(rng, number, STATE, 20.0)
    predicted, after = predict(states, before, seconds, acceleration)
    for index in range(number):
        kalman = reference(states[index], before[index])
        kalman.predict(F=transition(seconds), Q=process_noise(seconds, acceleration))
        np.testing.assert_allclose(predicted[index], kalman.x[:, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after[index], kalman.P, rtol=1e-9, atol=1e-6)


@given(seed=SEEDS, number=BATCHES, noise_scale=st.floats(0.05, 50.0))
def test_update_is_filterpys(seed: int, number: int, noise_scale: float) -> None:
    rng = np.random.default_rng(seed)
    states, columns = rng.normal(0.0, 300.0, (number, STATE)), rng.normal(0.0, 300.0, (number, MEASURED))
    before, noise = covariances(rng, number, STATE, 20.0), covariances(rng, number, MEASURED, noise_scale)
    updated, after = update(states, before, columns, noise)
    for index in range(number):
        kalman = reference(states[index], before[index])
        kalman.update(columns[index], R=noise[index])
        np.testing.assert_allclose(updated[index], kalman.x[:, 0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(after[index], kalman.P, rtol=1e-6, atol=1e-6)
        assert (np.linalg.eigvalsh(after[index]) > 0.0).all()


@given(seed=SEEDS, tracks=BATCHES, detections=BATCHES)
def test_innovation_distances_are_filterpys(seed: int, tracks: int, detections: int) -> None:
    rng = np.random.default_rng(seed)
    states, measured = rng.normal(0.0, 50.0, (tracks, STATE)), rng.normal(0.0, 50.0, (detections, MEASURED))
    before, noise = covariances(rng, tracks, STATE, 10.0), covariances(rng, detections, MEASURED, 5.0)
    columns, spread = states[:, :MEASURED], before[:, :MEASURED, :MEASURED]
    distance, log_determinant = innovation_distances(columns, spread, measured, noise)
    assert distance.shape == log_determinant.shape == (tracks, detections)
    for i in range(tracks):
        for j in range(detections):
            kalman = reference(states[i], before[i])
            kalman.update(measured[j], R=noise[j])
            assert distance[i, j] == pytest.approx(kalman.mahalanobis**2, rel=1e-6, abs=1e-9)
            assert log_determinant[i, j] == pytest.approx(np.log(np.linalg.det(kalman.S)), rel=1e-6, abs=1e-9)


def test_a_new_boundary_is_at_rest_at_its_detection() -> None:
    columns, covariance = np.array([500.0, 410.0, 350.0]), np.diag([4.0, 3.0, 2.0])
    state, full = initial_state(columns, covariance, np.array([200.0, 100.0, 60.0]))
    assert state.tolist() == [500.0, 410.0, 350.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(full, np.diag([4.0, 3.0, 2.0, 200.0**2, 100.0**2, 60.0**2]))


def test_a_velocity_without_detections_decays() -> None:
    state = np.array([[300.0, 300.0, 300.0, 100.0, 50.0, 20.0]])
    (after,), _ = predict(state, np.eye(STATE)[None], 10.0, np.ones(MEASURED))
    np.testing.assert_allclose(after[MEASURED:], 0.0, atol=1e-6)
    np.testing.assert_allclose(after[:MEASURED], [340.0, 320.0, 308.0], atol=1e-6)


@given(v=st.floats(0.0, 640.0), b=st.floats(-4.0, 4.0), k=st.floats(-3000.0, 3000.0), horizon=st.floats(140.0, 180.0))
def test_a_measured_curve_is_the_curve_of_its_columns(v: float, b: float, k: float, horizon: float) -> None:
    rows, curve = TrackedRows.of(VIEW, SHARES), Curve(160.0, (v, b, k))
    covariance = np.diag([2.0, 0.01, 900.0])
    columns, measured = rows.measure(curve, covariance)
    np.testing.assert_allclose(columns, curve.x(rows.y), rtol=1e-9, atol=1e-9)
    assert rows.curves(columns[None])[0].coefficients == pytest.approx(curve.coefficients, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(rows.covariances_of_curves(measured[None])[0], covariance, rtol=1e-6, atol=1e-4)
    other = TrackedRows.of(VIEW.with_horizon(horizon), SHARES)
    np.testing.assert_allclose(rows.mapping_to(other) @ columns, curve.x(other.y), rtol=1e-6, atol=1e-6)
