"""The horizon that the labels of a frame share."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lanestream.road.curve import Curve
from lanestream_exporter.datasets.horizons import shared_horizon

WIDTH, HEIGHT, HORIZON = 640, 360, 150.0
MIDDLE = (WIDTH - 1) / 2.0
LEFT, RIGHT = Curve(HORIZON, (MIDDLE + 8.0, -1.1, 300.0)), Curve(HORIZON, (MIDDLE + 8.0, 1.3, 300.0))


def points(curve: Curve) -> NDArray[np.float64]:
    rows = np.linspace(HEIGHT - 1.0, HORIZON + 12.0, 120)
    columns = curve.x(rows)
    return np.stack([columns, rows], axis=1)[(columns >= 0) & (columns <= WIDTH - 1)]


def test_two_labels_show_the_horizon_they_share() -> None:
    assert shared_horizon([points(LEFT), points(RIGHT)], HEIGHT, None) == pytest.approx(HORIZON, abs=1.0)
    assert shared_horizon([points(LEFT)], HEIGHT, None) is None
    assert shared_horizon([], HEIGHT, 140.0) == 140.0


@pytest.mark.parametrize("horizon", [-200.0, -72.0, 10.0])
def test_the_horizon_of_a_camera_that_looks_down_is_above_the_image(horizon: float) -> None:
    curves = [Curve(horizon, (MIDDLE, slope, 900.0)) for slope in (-0.7, 0.6)]
    rows = np.linspace(HEIGHT - 1.0, max(0.0, horizon + 12.0), 60)
    lanes = [np.stack([curve.x(rows), rows], axis=1) for curve in curves]
    assert shared_horizon(lanes, HEIGHT, None) == pytest.approx(horizon, abs=1.0)
    assert shared_horizon(lanes[:1], HEIGHT, horizon + 2.0) == pytest.approx(horizon, abs=4.0)


def test_a_road_unlike_the_model_keeps_the_horizon_of_its_drive() -> None:
    lanes = [points(LEFT), points(RIGHT)]
    # Labels that the model describes are believed even if the rest of the drive has another horizon.
    assert shared_horizon(lanes, HEIGHT, HORIZON + 8.0) == pytest.approx(HORIZON, abs=1.0)
    # A sharp curve that begins far ahead, whose inner boundary curves more than its outer one.
    for lane, extra in zip(lanes, (2e4, 6e4), strict=True):
        lane[:, 0] += extra / (lane[:, 1] - HORIZON + 10.0) ** 2
    alone = shared_horizon(lanes, HEIGHT, None)
    assert alone is not None
    assert abs(alone - HORIZON) > 8.0
    assert shared_horizon(lanes, HEIGHT, HORIZON) == pytest.approx(HORIZON, abs=4.0)
