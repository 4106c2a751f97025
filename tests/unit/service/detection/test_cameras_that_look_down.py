"""Roads whose horizon is above the image: candidates, and their fit to the paint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import roads

from lanestream.detection.curve_fit import fit_curves
from lanestream.detection.features import Channels
from lanestream.detection.interface import FrameContext
from lanestream.detection.proposals import propose
from lanestream.road.curve import Curve
from lanestream.road.view import RoadView
from lanestream_exporter.scenes import render_still, sample_scene
from lanestream_exporter.scenes.light import Atmosphere, SceneLight
from lanestream_exporter.scenes.markings import Paintwork
from lanestream_exporter.scenes.projection import PinholeCamera
from lanestream_exporter.scenes.road import Boundary, Course, Marking, Pose, Road
from lanestream_exporter.scenes.surface import Surface, SurfaceMaterial

ROWS = np.linspace(20.0, 359.0, 40)


@pytest.mark.parametrize("horizon", [-72.0, -36.0])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("k", [0.0, 1500.0])
def test_boundaries_below_a_horizon_above_the_image_are_proposed_and_fitted(
    horizon: float, known: bool, k: float
) -> None:
    view = RoadView(640, 360, horizon)
    truth = [Curve(horizon, (view.middle, slope, k)) for slope in (-0.55, 0.6)]
    channels = Channels.of(roads.in_color(roads.draw_road(view, truth, width=0.06)))
    proposals = propose(channels, FrameContext(horizon=horizon if known else None), None, None)
    assert proposals.view.horizon == pytest.approx(horizon, abs=16.0 if known else 36.0)
    assert (proposals.spans.top >= 0.0).all()
    assert (proposals.spans.bottom <= view.bottom).all()
    is_edge = np.zeros(len(proposals.curves), bool)
    fits = fit_curves(channels, proposals.curves, proposals.spans, proposals.view, is_edge=is_edge)
    for curve in truth:
        proposed = np.abs(proposals.curves.x(ROWS) - curve.x(ROWS)).max(axis=1)
        fitted = np.abs(fits.curves.x(ROWS) - curve.x(ROWS)).max(axis=1)
        assert proposed.min() <= 8.0
        assert fitted.min() <= 2.0


def test_the_markings_of_a_rendered_road_below_a_horizon_above_the_image_are_found() -> None:
    horizon = -0.2 * 360
    line = Marking("solid", "white", width=0.15, brightness=0.95, wear=0.0)
    scene = replace(
        sample_scene(np.random.default_rng(7), 640, 360),
        camera=PinholeCamera(640, 360, 60.0, 2.2, horizon),
        pose=Pose(20.0, 0.2, 0.01),
        road=Road(Course(40.0, (0.002, 0.003, 0.0, 0.0)), (Boundary(1.7, line), Boundary(-1.7, line)), (0.0,)),
        surface=Surface((SurfaceMaterial(-70.0, 70.0, (0.3, 0.3, 0.3), 1.0),)),
        paintwork=Paintwork(),
        light=SceneLight((0.4, 0.4, 0.4)),
        atmosphere=Atmosphere((0.8, 0.8, 0.8), 1e6),
        walls=(),
        items=(),
        bridges=(),
        traffic=(),
        wetness=0.0,
    )
    frame = render_still(scene)
    channels = Channels.of(frame.image)
    proposals = propose(channels, FrameContext(horizon=horizon), None, None)
    is_edge = np.zeros(len(proposals.curves), bool)
    fits = fit_curves(channels, proposals.curves, proposals.spans, proposals.view, is_edge=is_edge)
    assert fits.view.horizon == pytest.approx(horizon, abs=10.0)
    assert len(frame.labels.lanes) == 2
    for lane in frame.labels.lanes:
        assert lane.points[:, 1].min() < 30.0, "the label begins at the top of the image"
        assert np.abs(fits.curves.x(lane.points[:, 1]) - lane.points[:, 0]).mean(axis=1).min() <= 1.5
