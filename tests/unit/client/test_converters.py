"""Lanes for supervision and Rerun, with the libraries themselves where they are installed."""

from __future__ import annotations

import sys
from pathlib import Path

import fakes
import numpy as np
import pytest

from lanestream.errors import ImageError, MissingExtraError
from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel, LanesMessage
from lanestream_client.converters import LANE_EDGES, LANE_POINTS, ego_lane_polygon, log_to_rerun, to_supervision


@pytest.fixture
def message() -> LanesMessage:
    """Two boundaries of a straight lane, in pixels and in meters."""
    camera = LocalEngine(fakes.kinds_engine()).open_camera(
        camera=CameraModel(height=1.4, field_of_view=62.0), single_image=True
    )
    return camera.lanes(fakes.picture(), seq=7, timestamp=0.28)


def test_supervision_gets_key_points_that_it_can_draw(message: LanesMessage) -> None:
    supervision = pytest.importorskip("supervision")
    points = to_supervision(message)
    assert points.xy.shape == (2, LANE_POINTS, 2)
    left = message.lanes[0]
    assert points.xy[0][0] == pytest.approx(left.line.bottom, abs=0.01)
    assert points.xy[0][-1] == pytest.approx(left.line.top, abs=0.01)
    assert points.class_id.tolist() == [0, 1]
    assert points.data["class_name"].tolist() == ["marking", "road_edge"]
    assert points.data["position"].tolist() == [-1, 1]
    assert points.data["track_id"].tolist() == [lane.track_id for lane in message.lanes]
    assert len(points[points.data["position"] == 1]) == 1
    drawn = supervision.EdgeAnnotator(edges=LANE_EDGES).annotate(np.zeros((180, 320, 3), np.uint8), points)
    row = round(left.line.bottom[1]) - 20
    assert drawn[row, round(left.x(row))].any()
    assert not drawn[row, 160].any()


def test_supervision_gets_no_key_points_without_lanes(message: LanesMessage) -> None:
    supervision = pytest.importorskip("supervision")
    points = to_supervision(message.model_copy(update={"lanes": []}))
    assert len(points) == 0
    drawn = supervision.EdgeAnnotator(edges=LANE_EDGES).annotate(np.zeros((180, 320, 3), np.uint8), points)
    assert not drawn.any()


def test_supervision_finds_what_is_in_the_ego_lane(message: LanesMessage) -> None:
    supervision = pytest.importorskip("supervision")
    polygon = ego_lane_polygon(message)
    assert polygon is not None
    vehicles = supervision.Detections(xyxy=np.array([[150.0, 100.0, 170.0, 120.0], [0.0, 80.0, 30.0, 100.0]]))
    assert supervision.PolygonZone(polygon).trigger(vehicles).tolist() == [True, False]
    assert polygon.min() >= 0
    assert (polygon.max(axis=0) <= (319, 179)).all()
    assert ego_lane_polygon(message.model_copy(update={"lanes": message.lanes[:1]})) is None


def test_rerun_gets_the_image_and_lines_in_pixels_and_meters(message: LanesMessage, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun")
    recording = rerun.RecordingStream("test")
    recording.save(tmp_path / "lanes.rrd")
    log_to_rerun(message, fakes.picture(), recording=recording)
    log_to_rerun(message.model_copy(update={"lanes": [], "seq": 8}), entity="rear", recording=recording)
    recording.disconnect()
    written = (tmp_path / "lanes.rrd").read_bytes()
    for part in (
        b"/camera/image",
        b"/camera/image/lanes",
        b"/camera/road/lanes",
        b"/rear/image/lanes",
    ):
        assert part in written
    for part in (b"capture_time", b"LineStrips2D", b"LineStrips3D", b"EncodedImage"):
        assert part in written
    with pytest.raises(ImageError, match="in pixels of 320 x 180"):
        log_to_rerun(message, fakes.picture(640, 360), recording=recording)


@pytest.mark.parametrize(("module", "package"), [("supervision", "supervision"), ("rerun", "rerun-sdk")])
def test_a_missing_library_is_named(
    message: LanesMessage, monkeypatch: pytest.MonkeyPatch, module: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    convert = to_supervision if module == "supervision" else log_to_rerun
    with pytest.raises(MissingExtraError) as caught:
        convert(message)
    assert caught.value.message == f"this needs the package {module}, which is not installed"
    assert caught.value.hint == f"pip install {package}"
