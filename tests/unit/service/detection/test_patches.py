"""Patches: the boundary is upright in them, in any direction in the image."""

from __future__ import annotations

import numpy as np
import pytest
import roads

from lanestream.detection.patches import cut_patches
from lanestream.road.crops import PatchGeometry
from lanestream.road.curve import Curve, Curves
from lanestream.road.view import RoadView, Spans, visible_spans

VIEW = RoadView(640, 360, 160.0)


@pytest.mark.parametrize("curve", [Curve(160.0, (320.0, 1.1, 0.0)), Curve(160.0, (300.0, -1.2, 900.0))])
def test_a_marking_is_upright_in_its_patch(curve: Curve) -> None:
    image = roads.in_color(roads.draw_road(VIEW, [curve], paint=230, noise=0.0))
    curves = Curves.of([curve])
    patch = cut_patches(image, curves, visible_spans(curves, VIEW), VIEW, PatchGeometry(obliquity=0.0))[0]
    bright = patch[15:, :, 0] > 150
    centers = np.array([np.flatnonzero(row).mean() for row in bright])
    np.testing.assert_allclose(centers, 55.5, atol=3.0)
    # 0.1 row offsets of the patch's 0.66.
    np.testing.assert_allclose(bright[30:].sum(axis=1), 17.0, atol=3.0)


def test_patches_are_rgb() -> None:
    image = np.zeros((360, 640, 3), np.uint8)
    image[:] = (10, 20, 200)  # red in BGR
    curves = Curves(160.0, np.array([[320.0, 0.0, 0.0], [320.0, 1.0, 0.0]]))
    patches = cut_patches(image, curves, visible_spans(curves, VIEW), VIEW, PatchGeometry(size=32))
    assert patches.shape == (2, 32, 32, 3)
    assert (patches == np.array([200, 20, 10])).all()


def test_a_frame_without_candidates_has_no_patches() -> None:
    nothing = Spans(np.empty(0), np.empty(0), np.empty(0, bool))
    patches = cut_patches(np.zeros((360, 640, 3), np.uint8), Curves.none(160.0), nothing, VIEW, PatchGeometry())
    assert (patches.shape, patches.dtype) == ((0, 112, 112, 3), np.uint8)
