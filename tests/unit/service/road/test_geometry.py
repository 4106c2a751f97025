"""Coordinates: curves, resizing, what is in view, how strips are cut."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.detection.patches import PatchGeometry
from lanestream.road.curve import Curve, curve_basis, under_horizon
from lanestream.road.results import Candidate
from lanestream.road.view import RoadView, Scaling, visible_rows

VIEW = RoadView(640, 360, 160.0)


def test_curve_goes_through_its_three_points() -> None:
    rows, columns = np.array([350.0, 260.0, 200.0]), np.array([500.0, 410.0, 395.0])
    curve = Curve.through(160.0, rows, columns)
    np.testing.assert_allclose(curve.x(rows), columns, atol=1e-9)
    np.testing.assert_allclose(curve_basis(160.0, rows) @ curve.coefficients, columns, atol=1e-9)


def test_a_curve_told_from_another_horizon_keeps_its_columns() -> None:
    curve = Curve(200.0, (320.0, -1.2, 3000.0))
    (same,) = under_horizon([curve], 200.0, 479.0)
    np.testing.assert_allclose(same.coefficients, curve.coefficients)
    (higher,) = under_horizon([curve], 150.0, 479.0)
    rows = 200.0 + np.array([1.0, 0.45, 0.15]) * 279.0
    assert higher.horizon == 150.0
    np.testing.assert_allclose(higher.x(rows), curve.x(rows), atol=1e-6)
    # Above its own horizon the first one has no columns; told from a higher one it goes on.
    assert float(higher.x(195.0)) < 640.0 < float(curve.x(195.0))
    assert not under_horizon([], 150.0, 479.0)


def test_slope_is_the_derivative() -> None:
    curve = Curve(160.0, (320.0, 1.2, 900.0))
    rows = np.array([180.0, 250.0, 350.0])
    numeric = (curve.x(rows + 1e-4) - curve.x(rows - 1e-4)) / 2e-4
    np.testing.assert_allclose(curve.slope(rows), numeric, rtol=1e-6)


@given(
    factor=st.floats(0.1, 4.0),
    b=st.floats(-5.0, 5.0),
    k=st.floats(-3000.0, 3000.0),
    row=st.floats(200.0, 350.0),
)
def test_resizing_moves_points_and_curves_alike(factor: float, b: float, k: float, row: float) -> None:
    scaling = Scaling(factor)
    curve = Curve(160.0, (320.0, b, k))
    resized = scaling.curve_to_working(curve)
    expected = scaling.to_working(float(curve.x(row)))
    # Below a pixel of distance from the horizon both clamp, at different rows.
    if scaling.to_working(row) - resized.horizon > 1.0:
        assert float(resized.x(scaling.to_working(row))) == pytest.approx(expected, rel=1e-9, abs=1e-6)
        back = scaling.curve_to_image(resized)
        assert back.coefficients == pytest.approx(curve.coefficients, rel=1e-9, abs=1e-6)


def test_pixel_centres_are_at_integers() -> None:
    half = Scaling(0.5)
    assert half.to_working(0.5) == 0.0
    assert half.to_image(0.0) == 0.5


def test_visible_rows_stop_where_the_curve_leaves_the_image() -> None:
    leaving_left = Curve(160.0, (320.0, -2.0, 0.0))
    top, bottom = visible_rows(leaving_left, VIEW, 0.1) or (0.0, 0.0)
    assert top == pytest.approx(VIEW.row_at(0.1))
    assert bottom == pytest.approx(320.0, abs=4.0)
    assert visible_rows(Curve(160.0, (-500.0, -1.0, 0.0)), VIEW, 0.1) is None


def test_strip_follows_its_curve_and_widens_with_the_road() -> None:
    curve = Curve(160.0, (320.0, 0.5, 400.0))
    candidates = [Candidate(curve, 200.0, 350.0, 1.0), Candidate(curve, 190.0, 300.0, 1.0)]
    (columns, other), (rows, _) = PatchGeometry(size=33, half_width=0.5, lean=0.0).grids(candidates, VIEW)
    assert not np.array_equal(columns, other)
    assert columns.shape == rows.shape == (33, 33)
    np.testing.assert_allclose(columns[:, 16], curve.x(rows[:, 16]), atol=1e-3)
    widths = columns[:, -1] - columns[:, 0]
    np.testing.assert_allclose(widths, rows[:, 0] - 160.0, rtol=1e-4)


def test_a_leaning_strip_is_as_wide_across_its_candidate_as_an_upright_one() -> None:
    candidates = [Candidate(Curve(160.0, (320.0, slope, 0.0)), 200.0, 350.0, 1.0) for slope in (3.0, 0.0)]
    leaning, upright = PatchGeometry(size=33).grids(candidates, VIEW)[0]
    across = (leaning[:, -1] - leaning[:, 0]) / np.hypot(1.0, 3.0)
    np.testing.assert_allclose(across, upright[:, -1] - upright[:, 0], rtol=1e-4)
