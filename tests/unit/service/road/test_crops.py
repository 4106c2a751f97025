"""How patches and road crops are sampled."""

from __future__ import annotations

import numpy as np
import pytest

from lanestream.road.crops import PatchGeometry, RoadCropGeometry
from lanestream.road.curve import Curves
from lanestream.road.view import RoadView, Spans

VIEW = RoadView(640, 360, 160.0)


def spans(*rows: tuple[float, float]) -> Spans:
    top, bottom = np.array(rows).T
    return Spans(top, bottom, np.ones(len(rows), bool))


def test_a_patch_follows_its_curve_and_widens_with_the_road() -> None:
    curves = Curves(160.0, np.array([[320.0, 0.5, 400.0]] * 2))
    geometry = PatchGeometry(size=33, half_width=0.5, obliquity=0.0)
    (columns, other), (rows, _) = geometry.grids(curves, spans((200.0, 350.0), (190.0, 300.0)), VIEW)
    assert not np.array_equal(columns, other)
    assert columns.shape == rows.shape == (33, 33)
    assert (rows[0, 0], rows[-1, 0]) == (200.0, 350.0)
    np.testing.assert_allclose(columns[:, 16], curves[0].x(rows[:, 16]), atol=1e-3)
    widths = columns[:, -1] - columns[:, 0]
    np.testing.assert_allclose(widths, rows[:, 0] - 160.0, rtol=1e-4)


def test_a_patch_of_an_oblique_candidate_is_as_wide_across_it_as_an_upright_one() -> None:
    curves = Curves(160.0, np.array([[320.0, slope, 0.0] for slope in (3.0, 0.0)]))
    oblique, upright = PatchGeometry(size=33).grids(curves, spans((200.0, 350.0), (200.0, 350.0)), VIEW)[0]
    across = (oblique[:, -1] - oblique[:, 0]) / np.hypot(1.0, 3.0)
    np.testing.assert_allclose(across, upright[:, -1] - upright[:, 0], rtol=1e-4)


def test_a_patch_is_never_narrower_than_its_minimum() -> None:
    curves = Curves(160.0, np.array([[320.0, 0.0, 0.0]]))
    columns = PatchGeometry(size=33, half_width=0.33, min_half_width=4.0).grids(curves, spans((161.0, 350.0)), VIEW)[0][
        0
    ]
    assert columns[0, -1] - columns[0, 0] == pytest.approx(8.0, rel=1e-4)


def test_a_road_crop_has_its_horizon_and_its_middle_at_fixed_pixels() -> None:
    view = RoadView(640, 360, 150.0)
    columns, rows = RoadCropGeometry(size=113, above=0.12).grid(view)
    np.testing.assert_allclose(rows[12], 150.0, atol=1e-6)
    np.testing.assert_allclose(rows[-1], 359.0)
    np.testing.assert_allclose(columns[:, 56], view.middle)
    np.testing.assert_allclose(columns[-1, [0, -1]], [view.middle - 320.0, view.middle + 320.0])
    assert columns[0, -1] - columns[0, 0] == pytest.approx(0.6 * 640)


@pytest.mark.parametrize("invalid", [{"size": 0}, {"half_width": 0.0}, {"min_half_width": -1.0}, {"obliquity": -0.1}])
def test_invalid_patches_are_refused(invalid: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        PatchGeometry(**invalid)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "invalid", [{"size": 0}, {"detail_width": 0}, {"above": -0.1}, {"narrowest": 0.0}, {"narrowest": 1.1}]
)
def test_invalid_road_crops_are_refused(invalid: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        RoadCropGeometry(**invalid)  # type: ignore[arg-type]
