"""The joint curve fit on drawn roads: a line is found where it was drawn, and missing paint follows the common road."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import roads
from numpy.typing import NDArray

from lanestream.detection.curve_fit import Fits, FitSettings, fit_curves
from lanestream.detection.features import Channels
from lanestream.road.curve import ANCHORS, Curve, Curves
from lanestream.road.view import Image, RoadView, visible_spans

Array = NDArray[np.float64]

DEFAULT = FitSettings()
VIEW = RoadView(640, 480, 160.0)
DEPTH = VIEW.depth
FAR = np.array([VIEW.row_at(0.12), VIEW.row_at(0.2)])
NEAR = np.array([VIEW.row_at(0.3), VIEW.row_at(0.5)])


def on_road(*positions: float, curvature: float = 600.0, column: float = 320.0) -> list[Curve]:
    """Returns boundaries of one road, which share a vanishing point and a curvature."""
    return [Curve(VIEW.horizon, (column, position, curvature)) for position in positions]


def moved(curves: Sequence[Curve], *by: float) -> list[Curve]:
    """Returns curves whose lateral positions are off by so many row offsets."""
    return [
        Curve(curve.horizon, (curve.coefficients[0], curve.coefficients[1] + off, curve.coefficients[2]))
        for curve, off in zip(curves, by, strict=True)
    ]


def fit(
    gray: Image,
    start: Sequence[Curve],
    view: RoadView = VIEW,
    settings: FitSettings = DEFAULT,
    sigma: Array | None = None,
) -> Fits:
    curves = Curves.of(start)
    return fit_curves(roads.channels(gray), curves, visible_spans(curves, view), view, settings, sigma)


def errors(fits: Fits, truth: Sequence[Curve], rows: Array) -> Array:
    """Returns how far fits are from the truth in pixels, at the rows (R,) where the truth is inside the image."""
    expected = Curves.of(truth).x(rows)
    inside = (expected >= 0.0) & (expected <= VIEW.width - 1.0)
    return np.asarray(np.where(inside, np.abs(fits.curves.x(rows) - expected), 0.0))


@pytest.mark.parametrize("curvature", [0.0, 600.0, -1500.0])
@pytest.mark.parametrize("off", [0.0, 0.04, -0.04])
def test_lines_are_found_where_they_were_drawn(curvature: float, off: float) -> None:
    truth = on_road(-1.1, 1.2, curvature=curvature)
    fits = fit(roads.draw_road(VIEW, truth), moved(truth, off, off))
    assert errors(fits, truth, np.concatenate([NEAR, FAR])).max() < 1.0
    assert fits.view.horizon == pytest.approx(VIEW.horizon, abs=2.0)


def test_a_line_is_found_to_a_fraction_of_a_pixel() -> None:
    gray = [roads.draw_road(VIEW, moved(on_road(-0.4, 0.5), by, by)) for by in (0.0, 0.002)]
    start = moved(on_road(-0.4, 0.5), 0.02, 0.02)
    row = np.array([VIEW.row_at(0.5)])
    columns = [fit(image, start).curves.x(row) for image in gray]
    np.testing.assert_allclose(columns[1] - columns[0], 0.002 * 0.5 * DEPTH, atol=0.1)


def test_a_dashed_line_keeps_its_direction() -> None:
    truth = on_road(-1.1, 1.2)

    def dashes(share: Array) -> NDArray[np.bool_]:
        return np.asarray((1.0 / share) % 1.0 < 0.35)

    fits = fit(roads.draw_road(VIEW, truth, is_painted=dashes), moved(truth, 0.03, 0.03))
    assert errors(fits, truth, NEAR).max() < 1.5
    assert errors(fits, truth, FAR).max() < 3.0


@pytest.mark.parametrize("extra", [600.0, -600.0])
def test_a_curve_that_is_far_off_far_away_is_pulled_onto_the_paint(extra: float) -> None:
    truth = on_road(-1.1, 1.2)
    start = [Curve(VIEW.horizon, (*curve.coefficients[:2], curve.coefficients[2] + extra)) for curve in truth]
    assert np.abs(Curves.of(start).x(FAR) - Curves.of(truth).x(FAR)).max() > 15.0
    fits = fit(roads.draw_road(VIEW, truth), start)
    assert errors(fits, truth, np.concatenate([NEAR, FAR])).max() < 3.0


def test_on_a_road_without_paint_curves_stay() -> None:
    start = on_road(-1.1, 1.2)
    fits = fit(roads.draw_road(VIEW, []), start)
    assert errors(fits, start, np.concatenate([NEAR, FAR])).max() < 3.0


def test_fits_are_certain_where_there_is_paint() -> None:
    truth = on_road(-1.1, 1.2)
    with_paint, without = (fit(roads.draw_road(VIEW, curves), truth) for curves in (truth, []))
    for fits in (with_paint, without):
        assert (np.linalg.eigvalsh(fits.covariances) > 0.0).all()
    assert (sigma_at(with_paint, NEAR) < 0.5 * sigma_at(without, NEAR)).all()
    assert (errors(with_paint, truth, NEAR) < 3.0 * sigma_at(with_paint, NEAR)).all()


def sigma_at(fits: Fits, rows: Array) -> Array:
    """Returns the standard deviations (N, R) of the columns at `rows`."""
    u = rows - fits.view.horizon
    basis = np.stack([np.ones_like(u), u, 1.0 / u], axis=-1)
    return np.asarray(np.sqrt(np.einsum("ri,nij,rj->nr", basis, fits.covariances, basis)))


def test_what_is_known_well_moves_less() -> None:
    truth = on_road(-1.1, 1.2)
    gray, start = roads.draw_road(VIEW, truth), moved(truth, 0.04, 0.04)
    far, near = (errors(fit(gray, start, sigma=np.full((2, 3), sigma)), truth, NEAR).max() for sigma in (0.05, 30.0))
    assert near < 1.0 < far


def test_a_frame_without_curves_has_no_fits() -> None:
    nothing = Curves.none(160.0)
    fits = fit_curves(roads.channels(roads.draw_road(VIEW, [])), nothing, visible_spans(nothing, VIEW), VIEW)
    assert len(fits.curves) == 0
    assert fits.covariances.shape == (0, 3, 3)
    assert fits.view == VIEW


# --- Edges of the road ----------------------------------------------------------------------------------------------

ASPHALT, KERB = (90, 90, 90), (140, 140, 140)
# As bright as the asphalt in the paint channel.
GRASS = (45, 100, 80)


def fit_edges(image: Image, start: Sequence[Curve], are_edges: bool = True) -> Fits:
    curves = Curves.of(start)
    is_edge = np.full(len(start), are_edges)
    return fit_curves(Channels.of(image), curves, visible_spans(curves, VIEW), VIEW, is_edge=is_edge)


@pytest.mark.parametrize("beside", [KERB, GRASS], ids=["kerb", "grass"])
@pytest.mark.parametrize("curvature", [0.0, 600.0, -1500.0])
@pytest.mark.parametrize("off", [0.0, 0.04, -0.04])
def test_edges_are_found_where_two_surfaces_meet(beside: tuple[int, int, int], curvature: float, off: float) -> None:
    truth = on_road(-1.1, 1.2, curvature=curvature)
    fits = fit_edges(roads.draw_surfaces(VIEW, truth, [beside, ASPHALT, beside]), moved(truth, off, off))
    assert errors(fits, truth, np.concatenate([NEAR, FAR])).max() < 1.0
    assert fits.paint.min() > 0.9


def test_an_edge_is_fitted_to_the_step_and_a_marking_to_the_bar_beside_it() -> None:
    edges, bars, between = on_road(-1.5, 1.5), on_road(-1.36, 1.36), on_road(-1.43, 1.43)
    seam = roads.paint_on(roads.draw_surfaces(VIEW, edges, [GRASS, ASPHALT, GRASS]), VIEW, bars, width=0.05, paint=115)
    assert errors(fit_edges(seam, between), edges, NEAR).max() < 3.0
    assert errors(fit_edges(seam, between, are_edges=False), bars, NEAR).max() < 3.0


def test_an_edge_is_not_moved_between_the_stripes_of_a_double_line_beside_it() -> None:
    edge = on_road(1.2)
    image = roads.draw_surfaces(VIEW, edge, [ASPHALT, (180, 180, 180)])
    image = roads.paint_on(image, VIEW, on_road(1.3, 1.4), width=0.04, paint=220)
    assert errors(fit_edges(image, edge), edge, NEAR).max() < 3.0


def test_markings_and_edges_of_one_road_are_fitted_together() -> None:
    markings, edge = on_road(-1.1, 1.0), on_road(1.6)
    image = roads.paint_on(roads.draw_surfaces(VIEW, edge, [ASPHALT, GRASS]), VIEW, markings)
    truth, is_edge = [*markings, *edge], np.array([False, False, True])
    start = Curves.of(moved(truth, 0.04, -0.04, 0.04))
    fits = fit_curves(Channels.of(image), start, visible_spans(start, VIEW), VIEW, is_edge=is_edge)
    assert errors(fits, truth, np.concatenate([NEAR, FAR])).max() < 1.0


# --- The common road ------------------------------------------------------------------------------------------------


def near_half(share: Array) -> NDArray[np.bool_]:
    """Paint on the near half of the road only: a car hides the rest."""
    return np.asarray(share > 0.45)


def occluded_road() -> tuple[Image, list[Curve]]:
    """Returns three boundaries of a road, the last of which has paint only nearby, and its curves."""
    truth = on_road(-1.1, -0.1, 0.9)
    return roads.draw_road(VIEW, truth[2:], is_painted=near_half, gray=roads.draw_road(VIEW, truth[:2])), truth


def bent(curve: Curve, by: float) -> Curve:
    """Returns a curve that is off by so many pixels at the far anchor, and not at the other two."""
    rows = VIEW.horizon + ANCHORS * DEPTH
    return Curve.through(VIEW.horizon, rows, curve.x(rows) + np.array([0.0, 0.0, by]))


def test_a_far_end_without_paint_is_where_the_other_boundaries_meet() -> None:
    gray, truth = occluded_road()
    start = [*truth[:2], bent(truth[2], 12.0)]
    sigma = np.tile([6.0, 6.0, 20.0], (3, 1))
    together, alone = fit(gray, start, sigma=sigma), fit(gray, start[2:], sigma=sigma[2:])
    far = np.array([VIEW.row_at(0.15)])
    assert errors(together, truth, far)[2] < 4.0
    assert errors(alone, truth[2:], far)[0] > 8.0
    assert errors(together, truth, far)[:2].max() < 1.0
    # The others add to what is known of the far end.
    assert sigma_at(together, far)[2] < 0.5 * sigma_at(alone, far)[0]


def test_a_line_that_is_not_of_the_road_neither_moves_the_others_nor_follows_them() -> None:
    road = on_road(-1.1, -0.2, 0.8)
    stray = Curve(VIEW.horizon, (470.0, -1.0, -4000.0))
    gray = roads.draw_road(VIEW, [*road, stray])
    fits = fit(gray, [*road, stray])
    assert errors(fits, [*road, stray], NEAR).max() < 2.0
    assert errors(fits, [*road, stray], FAR)[:3].max() < 2.0
    assert fits.view.horizon == pytest.approx(VIEW.horizon, abs=3.0)


def test_a_single_boundary_is_not_moved_by_the_common_road() -> None:
    truth = on_road(1.1)
    assert errors(fit(roads.draw_road(VIEW, truth), truth), truth, np.concatenate([NEAR, FAR])).max() < 1.0


def test_in_a_sharp_curve_the_inner_boundary_may_curve_more_sharply() -> None:
    curvatures = (0.9 * 8000.0, 8000.0, 1.1 * 8000.0)
    truth = [Curve(VIEW.horizon, (300.0, b, k)) for b, k in zip((-1.6, -0.5, 0.6), curvatures, strict=True)]
    fits = fit(roads.draw_road(VIEW, truth), truth)
    assert errors(fits, truth, np.concatenate([NEAR, FAR])).max() < 2.0
    assert fits.curves.coefficients[:, 2] == pytest.approx(curvatures, rel=0.1)


Start = Callable[[float], list[Curve]]


def straight_lines(horizon: float) -> list[Curve]:
    """Returns straight lines that meet on the true horizon, below another one."""
    off = horizon - VIEW.horizon
    return [Curve(horizon, (320.0 + off * b, b, 0.0)) for b in (-1.6, -0.6, 0.7, 1.7)]


def curved_lines(horizon: float) -> list[Curve]:
    """Returns curved boundaries below another horizon than the true one, near their true columns."""
    return list(Curves.of(on_road(-1.6, -0.6, 0.7, 1.7, curvature=1500.0)).below(horizon, VIEW.bottom))


@pytest.mark.parametrize("off", [-8.0, 8.0])
@pytest.mark.parametrize("start", [straight_lines, curved_lines])
def test_the_boundaries_show_where_the_horizon_is(start: Start, off: float) -> None:
    assumed = VIEW.with_horizon(VIEW.horizon + off)
    gray = roads.draw_road(VIEW, start(VIEW.horizon))
    fits = fit(gray, start(assumed.horizon), assumed)
    assert abs(fits.view.horizon - VIEW.horizon) < 0.5 * abs(off)
    assert fits.curves.horizon == fits.view.horizon
    assert errors(fits, start(VIEW.horizon), NEAR).max() < 1.5


@pytest.mark.parametrize("off", [-50.0, 50.0])
def test_the_horizon_moves_no_farther_than_a_camera_pitches(off: float) -> None:
    assumed = VIEW.with_horizon(VIEW.horizon + off)
    fits = fit(roads.draw_road(VIEW, straight_lines(VIEW.horizon)), straight_lines(assumed.horizon), assumed)
    assert abs(fits.view.horizon - assumed.horizon) <= 0.04 * assumed.depth + 1e-6


def test_the_horizon_can_be_fixed() -> None:
    assumed = VIEW.with_horizon(VIEW.horizon + 8.0)
    gray = roads.draw_road(VIEW, straight_lines(VIEW.horizon))
    fits = fit(gray, straight_lines(assumed.horizon), assumed, FitSettings(move_horizon=False))
    assert fits.view.horizon == assumed.horizon
