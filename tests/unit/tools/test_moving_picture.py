"""The moving picture of the documentation shows no wrong line, and stays small."""

from __future__ import annotations

from pathlib import Path

import fakes
import moving_picture
import numpy as np
import pytest
from PIL import Image

from lanestream.local import LocalEngine
from lanestream_exporter.datasets.labels import WHOLE, LabeledFrame, LabeledLane


def test_a_line_that_the_scene_does_not_have_is_an_error() -> None:
    lanes = LocalEngine(fakes.engine()).open_camera(single_image=True).lanes(fakes.picture(), seq=3, timestamp=0.0)
    points = [np.array(lane.points) for lane in lanes.lanes]
    assert len(points) == 2

    def labels(*labeled: np.ndarray) -> LabeledFrame:
        of_lanes = tuple(LabeledLane(each, position) for each, position in zip(labeled, (-1, 1), strict=False))
        return LabeledFrame(320, 180, of_lanes, "drive", "rendered", coverage=WHOLE)

    moving_picture.check(lanes, labels(*points))
    moving_picture.check(lanes, labels(points[0] + (3.0, 0.0), points[1]))
    with pytest.raises(RuntimeError, match=rf"frame 3 has wrong lines \(track ids {lanes.lanes[1].track_id}\)"):
        moving_picture.check(lanes, labels(points[0], points[1] + (40.0, 0.0)))
    with pytest.raises(RuntimeError, match="wrong lines"):
        moving_picture.check(lanes, labels(points[0]))


def test_the_picture_moves_and_its_size_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [Image.fromarray(np.full((45, 80, 3), shade, np.uint8)) for shade in (0, 100, 200)]
    out = tmp_path / "a.webp"
    moving_picture.write(frames, out)
    with Image.open(out) as written:
        assert (written.n_frames, written.size, written.info["loop"]) == (3, (80, 45), 0)
        written.seek(1)
        written.load()
        assert written.info["duration"] == 80
    monkeypatch.setattr(moving_picture, "MOST_BYTES", 10)
    with pytest.raises(RuntimeError, match="more than 10 bytes"):
        moving_picture.write(frames, out)
    assert not out.exists()
