"""The road filter: its model against a plain one and filterpy, and what it recovers of simulated roads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drives import DT, LANE, VIEW, detection
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.road.curve import Curve, Curves, curve_basis
from lanestream.road.results import Detection
from lanestream.road.view import RoadView
from lanestream.tracking.kalman import _ROUNDS, Gaussian
from lanestream.tracking.road_filter import (
    _COLUMN_BIAS,
    _PLACE_BIAS,
    COLUMN,
    COLUMN_ERROR,
    CURVATURE,
    DEPARTURE,
    OWN,
    PITCH,
    PLACE,
    PLACE_ERROR,
    ROAD,
    ROWS,
    SIDEWAYS,
    RoadFilter,
)

Array = NDArray[np.float64]

SEEDS = st.integers(0, 2**32 - 1)
NUMBERS = st.integers(1, 5)


def column(road: RoadFilter, mean: NDArray[Any], boundary: int, row: float, *, with_errors: bool) -> Any:
    """Returns the column in pixels of a boundary at a row of the image: the formula of the model, for one number."""
    own = ROAD + OWN * boundary
    t = (row - road.horizon) / road.depth - mean[PITCH]
    x = mean[COLUMN] + mean[own + DEPARTURE] + mean[own + PLACE] * t + mean[CURVATURE] / t
    if with_errors:
        x = x + mean[COLUMN_ERROR] + mean[own + PLACE_ERROR] * t
    return road.depth * x


def columns(road: RoadFilter, mean: NDArray[Any], indices: Sequence[int], rows: Array, *, with_errors: bool) -> Array:
    """Returns the columns (G * R,) of boundaries at rows, one after the other."""
    return np.array([column(road, mean, i, row, with_errors=with_errors) for i in indices for row in rows.tolist()])


def derivatives(road: RoadFilter, mean: Array, indices: Sequence[int], rows: Array, *, with_errors: bool) -> Array:
    """Returns the derivatives (G * R, n) of `columns` by the state, by finite differences along the imaginary axis."""
    step = 1e-30
    result = np.empty((len(indices) * len(rows), len(mean)))
    for state in range(len(mean)):
        shifted = mean.astype(complex)
        shifted[state] += 1j * step
        result[:, state] = columns(road, shifted, indices, rows, with_errors=with_errors).imag / step
    return result


def bias_of_curves(road: RoadFilter) -> Array:
    """Returns the covariance (3, 3) of the errors of all curves that the filter can't see, in pixels."""
    return np.diag([(_COLUMN_BIAS * road.depth) ** 2, _PLACE_BIAS**2, 0.0])


def predicted(road: RoadFilter, seconds: float, activity: float = 1.0, coasting: Sequence[int] = ()) -> RoadFilter:
    """Returns the road after a step, with usual errors, while the boundaries at `coasting` are not seen."""
    return road.predicted(seconds, activity, np.ones(road.number), np.isin(np.arange(road.number), coasting))


def curves_of(road: RoadFilter) -> tuple[Curves, Array]:
    """Returns the curves and their covariances, with usual errors that last."""
    return road.curves(), road.covariances(np.ones(road.number))


def random_road(seed: int, number: int) -> RoadFilter:
    """Returns a filter of a road like any, with uncertainties that are all correlated."""
    rng = np.random.default_rng(seed)
    size = ROAD + OWN * number
    mean = rng.normal(0.0, 0.03, size)
    mean[COLUMN] = 1.6 + rng.normal(0.0, 0.2)
    mean[ROAD + PLACE :: OWN] = np.sort(rng.uniform(-4.0, 4.0, number))
    root = rng.normal(0.0, 0.01, (size, size))
    return RoadFilter(160.0, 199.0, 0.0, Gaussian(mean, root @ root.T))


@settings(max_examples=30)
@given(seed=SEEDS, number=NUMBERS)
def test_expected_columns_are_those_of_the_formula(seed: int, number: int) -> None:
    road = random_road(seed, number)
    values, covariances = road.expected()
    mean, everyone = road.state.mean, range(number)
    np.testing.assert_allclose(
        values.ravel() * road.depth, columns(road, mean, everyone, road.rows, with_errors=True), rtol=1e-9
    )
    gradients = derivatives(road, mean, everyone, road.rows, with_errors=True).reshape(number, 3, -1) / road.depth
    np.testing.assert_allclose(
        covariances, gradients @ road.state.covariance @ gradients.swapaxes(1, 2), rtol=1e-7, atol=1e-12
    )


@settings(max_examples=30)
@given(seed=SEEDS, number=NUMBERS, data=st.data())
def test_an_update_is_that_of_filterpys_extended_filter(seed: int, number: int, data: st.DataObject) -> None:
    road, rng = random_road(seed, number), np.random.default_rng(seed)
    indices = sorted(data.draw(st.sets(st.integers(0, number - 1), min_size=1)))
    root = rng.normal(0.0, 0.01, (len(indices), 3, 3))
    noise = root @ root.swapaxes(1, 2) + 1e-5 * np.eye(3)
    expected, spread = (part[indices] for part in road.expected())
    measured = expected + 0.5 * np.sqrt(np.diagonal(spread + noise, axis1=1, axis2=2)) * rng.uniform(
        -1, 1, (len(indices), 3)
    )
    updated_road, distances = road.updated(np.array(indices), measured, noise)
    if distances.max() > 3.0:
        return  # the weights of such measurements are less than 1

    def predicted(mean: Array) -> Array:
        return columns(road, mean, indices, road.rows, with_errors=True)[:, None] / road.depth

    def jacobian(mean: Array) -> Array:
        return derivatives(road, mean, indices, road.rows, with_errors=True) / road.depth

    size, stacked = len(road.state.mean), np.zeros((3 * len(indices), 3 * len(indices)))
    for group, own in enumerate(noise):
        stacked[3 * group : 3 * group + 3, 3 * group : 3 * group + 3] = own
    extended = ExtendedKalmanFilter(dim_x=size, dim_z=len(stacked))
    extended.x, extended.P = road.state.mean[:, None].copy(), road.state.covariance.copy()
    extended.update(measured.reshape(-1, 1), lambda x: jacobian(x[:, 0]), lambda x: predicted(x[:, 0]), R=stacked)
    mean, covariance = extended.x[:, 0], extended.P
    for _ in range(_ROUNDS - 1):
        again = KalmanFilter(dim_x=size, dim_z=len(stacked))
        again.x, again.P = road.state.mean[:, None].copy(), road.state.covariance.copy()
        slope = jacobian(mean)
        again.update(measured.reshape(-1, 1) - predicted(mean) + slope @ mean[:, None], R=stacked, H=slope)
        mean, covariance = again.x[:, 0], again.P
    updated = updated_road.state
    np.testing.assert_allclose(updated.mean, mean, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(updated.covariance, covariance, rtol=1e-5, atol=1e-9)
    eigenvalues = np.linalg.eigvalsh(updated.covariance)
    assert eigenvalues[0] > -1e-10 * eigenvalues[-1]


@given(seed=SEEDS, number=NUMBERS, seconds=st.floats(0.0, 1.0), activity=st.floats(0.05, 4.0))
def test_two_short_steps_are_one_long_one(seed: int, number: int, seconds: float, activity: float) -> None:
    road = replace(random_road(seed, number), rest=0.02)
    once = predicted(road, 2.0 * seconds, activity).state
    twice = predicted(predicted(road, seconds, activity), seconds, activity).state
    np.testing.assert_allclose(once.mean, twice.mean, rtol=1e-9, atol=1e-12)
    before = np.linalg.eigvalsh(once.covariance)
    assert before[0] > -1e-9 * before[-1]
    np.testing.assert_allclose(once.covariance, once.covariance.T, rtol=1e-12, atol=1e-15)


@settings(max_examples=30)
@given(seed=SEEDS, number=NUMBERS)
def test_no_time_changes_nothing(seed: int, number: int) -> None:
    road = random_road(seed, number)
    still = predicted(road, 0.0).state
    np.testing.assert_allclose(still.mean, road.state.mean, rtol=1e-12)
    np.testing.assert_allclose(still.covariance, road.state.covariance, rtol=1e-12, atol=1e-15)


def test_boundaries_move_together_against_the_vehicle() -> None:
    road = random_road(1, 3)
    road.state.mean[SIDEWAYS] = 0.5
    moved = predicted(road, 0.1).places - road.places
    assert moved == pytest.approx(np.full(3, moved[0]))
    assert -0.05 <= moved[0] < -0.03, "a vehicle that moves to the right leaves boundaries behind on its left"


def test_places_that_are_not_seen_or_were_elsewhere_are_less_certain() -> None:
    road = random_road(4, 3)
    seen, one_hidden = predicted(road, 0.1), predicted(road, 0.1, coasting=[1])
    np.testing.assert_array_equal(seen.state.mean, one_hidden.state.mean)
    wider = one_hidden.place_sigmas - seen.place_sigmas
    assert (wider[[0, 2]] == 0.0).all()
    assert wider[1] > 0.0
    assert road.loosened([]) is road
    loosened = road.loosened([2]).place_sigmas - road.place_sigmas
    assert (loosened[[0, 1]] == 0.0).all()
    assert loosened[2] > 0.0


def test_errors_that_last_are_scaled_for_each_boundary() -> None:
    road = random_road(4, 2)
    usual, scaled = road.covariances(np.ones(2)), road.covariances(np.array([1.0, 4.0]))
    np.testing.assert_array_equal(scaled[0], usual[0])
    np.testing.assert_allclose(scaled[1] - usual[1], 3.0 * bias_of_curves(road), rtol=1e-6, atol=1e-9)


def test_pitch_returns_to_the_mean_horizon() -> None:
    road = random_road(2, 1).resting_at(170.0)
    assert predicted(road, 60.0).pitched_horizon == pytest.approx(170.0)


def test_a_measured_curve_has_its_columns_and_a_larger_covariance_than_its_fit() -> None:
    road = random_road(3, 1)
    seen = detection(1.15, 700.0, v=330.0, view=VIEW.with_horizon(157.0))
    values, noise = road.measure([seen])
    np.testing.assert_allclose(values[0] * road.depth, seen.curve.x(road.rows), rtol=1e-12)
    basis = curve_basis(157.0, road.rows) / road.depth
    excess = np.linalg.eigvalsh(noise[0] - basis @ seen.covariance @ basis.T)
    assert excess[0] > 0.0


def followed(
    road: RoadFilter | None, frames: Sequence[tuple[Sequence[Detection], RoadView]], indices: Sequence[int]
) -> RoadFilter:
    """Returns the road after frames, DT seconds from each other, in which the boundaries at `indices` are seen."""
    for seen, view in frames:
        if road is None:
            road = RoadFilter.started(view).with_boundaries(Curves.of([one.curve for one in seen]))
        else:
            road = predicted(road.resting_at(view.horizon), DT)
        values, noise = road.measure(seen)
        road = road.updated(np.array(indices), values, noise)[0].rounded()
    assert road is not None
    return road


def test_a_moving_road_is_recovered() -> None:
    """The vanishing column, the curvature, the sideways speed and the horizon move; detections have noise."""
    rng = np.random.default_rng(11)
    places = np.array([-0.5, 0.5, 1.5]) * LANE
    frames = []
    for frame in range(100):
        time = frame * DT
        v, k, pitch = 320.0 + 10.0 * np.sin(time), 800.0 * np.sin(0.5 * time), rng.normal(0.0, 2.0)
        truth = [Curve(160.0 + pitch, (v, b - 0.15 * time, k)) for b in places]
        view = VIEW.with_horizon(160.0)
        # A detector assumes some horizon; the columns at the rows are what it sees.
        rows = VIEW.horizon + ROWS * VIEW.depth
        seen = Curves.through(160.0, rows, np.stack([curve.x(rows) for curve in truth]) + rng.normal(0.0, 1.0, (3, 3)))
        frames.append(([replace(detection(0.0), curve=curve) for curve in seen], view))
    road = followed(None, frames, range(3))
    estimate = road.estimate
    assert road.places == pytest.approx(places - 0.15 * time, abs=0.05)
    assert estimate.vanishing_column.value == pytest.approx(v, abs=10.0)
    assert estimate.curvature.value == pytest.approx(k, abs=300.0)
    assert road.sideways.value == pytest.approx(0.15, abs=0.06)
    for value, true in ((estimate.vanishing_column, v), (estimate.curvature, k), (road.sideways, 0.15)):
        assert abs(value.value - true) < 4.0 * value.sigma
    curves, _ = curves_of(road)
    near = np.array([350.0, 300.0, 250.0, 200.0])
    np.testing.assert_allclose(curves.x(near), [curve.x(near) for curve in truth], atol=4.0)


@pytest.mark.parametrize("hidden", [10, 30])
def test_a_hidden_boundary_follows_the_others_in_a_lane_change(hidden: int) -> None:
    def seen(frame: int, indices: Sequence[int]) -> tuple[list[Detection], RoadView]:
        shift = 0.5 * LANE * max(0.0, frame - 24) * DT
        return [detection((0.5 * (-1, 1, 3)[i]) * LANE - shift) for i in indices], VIEW

    road = followed(None, [seen(frame, range(3)) for frame in range(25)], range(3))
    road = followed(road, [seen(frame, (0, 2)) for frame in range(25, 25 + hidden)], (0, 2))
    truth = 0.5 * LANE - 0.5 * LANE * hidden * DT
    assert road.places[1] == pytest.approx(truth, abs=0.05 * LANE)
    assert road.place_sigmas[1] > road.place_sigmas[0]


@settings(max_examples=30)
@given(seed=SEEDS, number=NUMBERS, horizon=st.floats(140.0, 180.0))
def test_rows_chosen_again_keep_the_curves_and_their_uncertainty(seed: int, number: int, horizon: float) -> None:
    road = random_road(seed, number)
    other = road.below(VIEW.with_horizon(horizon))
    assert (other.horizon, other.depth) == (horizon, 359.0 - horizon)
    (before, _), (after, _) = curves_of(road), curves_of(other)
    assert after.horizon == pytest.approx(before.horizon)
    np.testing.assert_allclose(after.coefficients, before.coefficients, rtol=1e-7, atol=1e-7)
    rows, mean = other.rows, road.state.mean
    for boundary in range(number):
        gradient = derivatives(road, mean, [boundary], rows, with_errors=True)
        spread = other.expected()[1][boundary] * other.depth**2
        np.testing.assert_allclose(spread, gradient @ road.state.covariance @ gradient.T, rtol=1e-6, atol=1e-9)
    assert other.estimate.vanishing_column.value == pytest.approx(road.estimate.vanishing_column.value)
    assert other.estimate.curvature.value == pytest.approx(road.estimate.curvature.value)
    assert other.sideways == road.sideways
    back = other.below(RoadView(640, 360, road.horizon)).state
    np.testing.assert_allclose(back.mean, road.state.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(back.covariance, road.state.covariance, rtol=1e-9, atol=1e-12)


@settings(max_examples=30)
@given(seed=SEEDS, number=NUMBERS)
def test_covariances_of_curves_give_the_sigmas_of_columns(seed: int, number: int) -> None:
    road = random_road(seed, number)
    curves, covariances = curves_of(road)
    basis = curve_basis(curves.horizon, road.rows)
    bias = basis @ bias_of_curves(road) @ basis.T
    for boundary in range(number):
        gradient = derivatives(road, road.state.mean, [boundary], road.rows, with_errors=False)
        expected = gradient @ road.state.covariance @ gradient.T + bias
        np.testing.assert_allclose(basis @ covariances[boundary] @ basis.T, expected, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(
            curves[boundary].x(road.rows),
            columns(road, road.state.mean, [boundary], road.rows, with_errors=False),
            rtol=1e-9,
        )


def test_sigmas_of_columns_are_those_of_sampled_roads() -> None:
    road = random_road(5, 2)
    road = replace(road, state=Gaussian(road.state.mean, 0.05 * road.state.covariance))
    rng = np.random.default_rng(6)
    sampled = rng.multivariate_normal(road.state.mean, road.state.covariance, 4000)
    drawn = np.array([columns(road, mean, range(2), road.rows, with_errors=False) for mean in sampled])
    curves, covariances = curves_of(road)
    basis = curve_basis(curves.horizon, road.rows)
    place_errors = rng.normal(0.0, _PLACE_BIAS, (len(drawn), 2, 1)) * basis[:, 1]
    column_errors = rng.normal(0.0, _COLUMN_BIAS * road.depth, (len(drawn), 1))
    drawn += place_errors.reshape(len(drawn), -1) + column_errors
    sigmas = np.sqrt(np.einsum("ri,bij,rj->br", basis, covariances, basis))
    np.testing.assert_allclose(sigmas.ravel(), drawn.std(axis=0), rtol=0.08)
    between = road.lane_center(0, 1)
    middle = 0.5 * (drawn[:, 0] + drawn[:, 3]) / road.depth
    assert between.value == pytest.approx(middle.mean(), abs=4.0 * between.sigma / np.sqrt(len(drawn)))
    assert between.sigma == pytest.approx(middle.std(), rel=0.08)


def test_new_boundaries_are_where_their_detections_are() -> None:
    first = [detection(-1.15, 500.0, v=330.0), detection(1.15, 500.0, v=330.0)]
    road = followed(None, [(first, VIEW)], (0, 1))
    estimate, sigmas = road.estimate, road.place_sigmas
    assert estimate.vanishing_column.value == pytest.approx(330.0, abs=1.0)
    assert estimate.curvature.value == pytest.approx(500.0, abs=50.0)
    np.testing.assert_allclose(road.places, [-1.15, 1.15], atol=0.01)
    more = road.with_boundaries(Curves.of([detection(3.45, 500.0, v=330.0).curve]))
    np.testing.assert_allclose(more.places, [-1.15, 1.15, 3.45], atol=0.02)
    assert more.place_sigmas[2] > 10.0 * sigmas.max(), "nothing is known of it before it is measured"
    np.testing.assert_array_equal(more.with_only([0, 1]).state.covariance, road.state.covariance)
    assert (more.state.covariance[:-OWN, -OWN:] == 0.0).all(), "nor has it anything to do with the others"


@given(seed=SEEDS, kept=st.permutations(range(4)).flatmap(lambda p: st.integers(0, 4).map(lambda n: p[:n])))
def test_only_the_kept_boundaries_stay_in_their_order(seed: int, kept: list[int]) -> None:
    road = random_road(seed, 4)
    fewer = road.with_only(kept)
    assert fewer.number == len(kept)
    for one, all_of_them in zip(fewer.expected(), road.expected(), strict=True):
        np.testing.assert_allclose(one, all_of_them[kept], rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(fewer.place_sigmas, road.place_sigmas[kept])
    assert fewer.estimate == road.estimate


def test_a_rounded_filter_is_rounded_once() -> None:
    road = random_road(7, 3).rounded()
    assert road.state.mean.tobytes() == road.rounded().state.mean.tobytes()
    assert road.state.covariance.tobytes() == road.rounded().state.covariance.tobytes()
    np.testing.assert_array_equal(road.state.covariance, road.state.covariance.T)
