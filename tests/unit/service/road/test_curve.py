"""Curves: through points, below other horizons, and a batch of them against single ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.road.curve import ANCHORS, Curve, Curves, curve_basis

HORIZON = 160.0
COEFFICIENTS = st.tuples(st.floats(-900.0, 900.0), st.floats(-6.0, 6.0), st.floats(-5000.0, 5000.0))
CURVES = st.lists(COEFFICIENTS.map(lambda coefficients: Curve(HORIZON, coefficients)), min_size=1, max_size=6)
# Some of them are above the horizon, where a row offset counts as 1.
ROWS = st.lists(st.floats(100.0, 480.0), min_size=1, max_size=5).map(np.array)


def test_a_curve_goes_through_its_three_points() -> None:
    rows, columns = np.array([350.0, 260.0, 200.0]), np.array([500.0, 410.0, 395.0])
    curve = Curve.through(HORIZON, rows, columns)
    np.testing.assert_allclose(curve.x(rows), columns, atol=1e-9)
    np.testing.assert_allclose(curve_basis(HORIZON, rows) @ curve.coefficients, columns, atol=1e-9)


def test_slope_is_the_derivative() -> None:
    curve = Curve(HORIZON, (320.0, 1.2, 900.0))
    rows = np.array([180.0, 250.0, 350.0])
    numeric = (curve.x(rows + 1e-4) - curve.x(rows - 1e-4)) / 2e-4
    np.testing.assert_allclose(curve.slope(rows), numeric, rtol=1e-6)


def test_below_another_horizon_a_curve_keeps_its_columns() -> None:
    curves = Curves(200.0, np.array([[320.0, -1.2, 3000.0]]))
    assert curves.below(200.0, 479.0) is curves
    higher = curves.below(150.0, 479.0)
    rows = 200.0 + ANCHORS * 279.0
    assert higher.horizon == 150.0
    np.testing.assert_allclose(higher.x(rows), curves.x(rows), atol=1e-6)
    # Above its own horizon the first one has no columns; below a higher horizon it continues.
    above = np.array([195.0])
    assert higher.x(above).item() < 640.0 < curves.x(above).item()
    assert len(Curves.none(200.0).below(150.0, 479.0)) == 0


@given(curves=CURVES, rows=ROWS)
def test_a_batch_of_curves_has_the_columns_and_slopes_of_each(curves: list[Curve], rows: np.ndarray) -> None:
    batch = Curves.of(curves)
    assert len(batch) == len(curves)
    assert list(batch) == [batch[index] for index in range(len(batch))] == curves
    np.testing.assert_allclose(batch.x(rows), [curve.x(rows) for curve in curves], rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(batch.slope(rows), [curve.slope(rows) for curve in curves], rtol=1e-12, atol=1e-9)
    own_rows = rows + np.arange(len(curves))[:, None]
    expected = [curve.x(row) for curve, row in zip(curves, own_rows, strict=True)]
    np.testing.assert_allclose(batch.x(own_rows), expected, rtol=1e-12, atol=1e-9)


@given(curves=CURVES, horizon=st.floats(100.0, 220.0))
def test_a_batch_is_fitted_and_moved_to_another_horizon_as_each_curve_is(curves: list[Curve], horizon: float) -> None:
    batch = Curves.of(curves)
    rows = HORIZON + ANCHORS * 300.0
    through = Curves.through(HORIZON, rows, batch.x(rows))
    for one, curve in zip(through, curves, strict=True):
        single = Curve.through(HORIZON, rows, curve.x(rows))
        assert one.coefficients == pytest.approx(single.coefficients, rel=1e-9, abs=1e-9)
        assert one.coefficients == pytest.approx(curve.coefficients, rel=1e-6, abs=1e-5)
    moved = batch.below(horizon, 479.0)
    for one, curve in zip(moved, curves, strict=True):
        single = Curves.of([curve]).below(horizon, 479.0)[0]
        assert one.coefficients == pytest.approx(single.coefficients, rel=1e-9, abs=1e-6)


def test_batches_can_be_joined_and_parts_of_them_selected() -> None:
    curves = Curves(HORIZON, np.arange(9.0).reshape(3, 3))
    assert list(curves.take([2, 0])) == [curves[2], curves[0]]
    assert list(curves.take(np.array([False, True, False]))) == [curves[1]]
    joined = Curves.concatenate([curves.take([0]), Curves.none(HORIZON), curves.take([1, 2])])
    np.testing.assert_array_equal(joined.coefficients, curves.coefficients)
    assert joined.horizon == HORIZON
    assert Curves.none(HORIZON).x(np.array([200.0, 300.0])).shape == (0, 2)


@pytest.mark.parametrize("horizons", [(), (160.0, 161.0)])
def test_a_batch_needs_one_horizon(horizons: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=f"{len(horizons)} horizons; one is needed"):
        Curves.of([Curve(horizon, (320.0, 1.0, 0.0)) for horizon in horizons])
