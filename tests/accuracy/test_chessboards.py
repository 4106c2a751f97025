"""`lanestream calibrate` with the chessboard pictures of a real camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lanestream.road.camera import Camera
from lanestream_exporter.camera_calibration import calibrate_lens, views


def test_real_pictures_of_a_chessboard_calibrate_their_lens(data: Path) -> None:
    lens = calibrate_lens(views(data / "udacity" / "camera_cal"), (9, 6))
    assert lens.size == (1280, 720)
    assert len(lens.used) == 16
    assert {name for name, _ in lens.failed} == {f"calibration{number}.jpg" for number in (1, 5, 7, 15)}
    assert lens.rms < 1.0
    # What others publish for this camera, from the same pictures.
    assert lens.focal_length == pytest.approx((1157.0, 1153.0), rel=0.01)
    assert lens.principal_point == pytest.approx((670.0, 388.0), abs=8.0)
    rays = (
        Camera(**lens.camera(1.3).model_dump())
        .lens(lens.size, lens.size)
        .rays(np.array([[0.0, 719.0], [1279.0, 719.0]]))
    )
    assert np.isfinite(rays).all()
    assert rays[1, 0] - rays[0, 0] > 1280 / lens.focal_length[0], "a barrel: the corners look farther out"
