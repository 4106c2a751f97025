"""Resizing, and the rows in which a curve is visible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.road.curve import Curve, Curves
from lanestream.road.results import EgoLane, FrameResult, LaneBoundary
from lanestream.road.view import RoadView, Scaling, visible_rows, visible_spans

VIEW = RoadView(640, 360, 160.0)


@given(factor=st.floats(0.1, 4.0), b=st.floats(-5.0, 5.0), k=st.floats(-3000.0, 3000.0), row=st.floats(200.0, 350.0))
def test_resizing_moves_points_and_curves_alike(factor: float, b: float, k: float, row: float) -> None:
    scaling = Scaling(factor)
    curve = Curve(160.0, (320.0, b, k))
    resized = scaling.curve_to_working(curve)
    expected = scaling.to_working(float(curve.x(row)))
    # Less than a pixel below the horizon both are limited, at different rows.
    if scaling.to_working(row) - resized.horizon > 1.0:
        assert float(resized.x(scaling.to_working(row))) == pytest.approx(expected, rel=1e-9, abs=1e-6)
        back = scaling.curve_to_image(resized)
        assert back.coefficients == pytest.approx(curve.coefficients, rel=1e-9, abs=1e-6)


def test_pixel_centers_are_at_integers() -> None:
    half = Scaling(0.5)
    assert half.to_working(0.5) == 0.0
    assert half.to_image(0.0) == 0.5
    assert Scaling.to_working_width(1280) == half


def test_a_covariance_is_resized_as_the_curve_is() -> None:
    scaling, rng = Scaling(0.4), np.random.default_rng(1)
    samples = rng.multivariate_normal([320.0, 1.0, 50.0], np.diag([4.0, 0.01, 900.0]), 2000)
    in_image = [scaling.curve_to_image(Curve(160.0, tuple(sample))).coefficients for sample in samples.tolist()]
    np.testing.assert_allclose(scaling.covariance_to_image(np.cov(samples.T)), np.cov(np.array(in_image).T), rtol=1e-6)


def test_a_result_is_converted_to_image_pixels() -> None:
    lane = LaneBoundary(1, -1, "detected", 0.9, Curve(160.0, (320.0, 1.0, 50.0)), np.eye(3), 170.0, 359.0, 1.0)
    result = FrameResult((lane,), EgoLane(1), 160.0).to_image(Scaling(0.5))
    assert result.horizon == result.lanes[0].curve.horizon == 320.5
    assert (result.lanes[0].top, result.lanes[0].bottom) == (340.5, 718.5)
    assert float(result.lanes[0].curve.x(520.5)) == pytest.approx(2.0 * (float(lane.curve.x(260.0)) + 0.5) - 0.5)


def test_visible_rows_end_where_the_curve_leaves_the_image() -> None:
    leaving_left = Curve(160.0, (320.0, -2.0, 0.0))
    top, bottom = visible_rows(leaving_left, VIEW, 0.1) or (0.0, 0.0)
    assert top == pytest.approx(VIEW.row_at(0.1))
    assert bottom == pytest.approx(320.0, abs=4.0)
    assert visible_rows(Curve(160.0, (-500.0, -1.0, 0.0)), VIEW, 0.1) is None


def test_below_a_horizon_above_the_image_curves_are_visible_from_its_first_row() -> None:
    view = RoadView(640, 360, -72.0)
    assert (view.row_at(0.1), view.highest_row(0.1)) == (pytest.approx(-28.9), 0.0)
    assert view.highest_row(0.5) == view.row_at(0.5)
    assert visible_rows(Curve(-72.0, (320.0, 0.5, 0.0)), view) == (0.0, 359.0)
    top, bottom = visible_rows(Curve(-72.0, (320.0, 1.0, 0.0)), view) or (-1.0, -1.0)
    assert (top, bottom) == (0.0, pytest.approx(319.0 - 72.0, abs=6.0))


def test_of_a_curve_that_leaves_and_comes_back_the_near_part_is_visible() -> None:
    back = Curve(160.0, (900.0, -2.0, -6000.0))
    top, bottom = visible_rows(back, VIEW, 0.1) or (0.0, 0.0)
    assert bottom == VIEW.bottom
    assert float(back.x(top)) == pytest.approx(639.0, abs=8.0)
    assert 0.0 < float(back.x(180.0)) < 639.0 < float(back.x(0.5 * (180.0 + top)))


@given(
    st.lists(st.tuples(st.floats(-300.0, 900.0), st.floats(-6.0, 6.0), st.floats(-5e3, 5e3)), min_size=1, max_size=5)
)
def test_spans_of_a_batch_are_those_of_each_curve(coefficients: list[tuple[float, float, float]]) -> None:
    curves = [Curve(160.0, each) for each in coefficients]
    spans = visible_spans(Curves.of(curves), VIEW)
    for index, curve in enumerate(curves):
        span = (float(spans.top[index]), float(spans.bottom[index])) if spans.visible[index] else None
        assert visible_rows(curve, VIEW) == span
    assert spans.take(np.array([0])).top.tolist() == spans.top[:1].tolist()


def test_a_view_measures_rows_from_the_horizon_to_the_bottom() -> None:
    assert (VIEW.bottom, VIEW.depth, VIEW.middle) == (359.0, 199.0, 319.5)
    assert (VIEW.row_at(0.0), VIEW.row_at(1.0)) == (160.0, 359.0)
    assert VIEW.with_horizon(100.0) == RoadView(640, 360, 100.0)
