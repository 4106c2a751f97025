"""Drawing lanes and writing videos."""

from __future__ import annotations

from pathlib import Path

import av
import fakes
import numpy as np
import pytest

from lanestream.errors import SourceError
from lanestream.local import LocalEngine
from lanestream.protocol import LanesMessage, error_message
from lanestream.road.view import Image
from lanestream_client.overlays import draw_error, draw_lanes
from lanestream_client.sinks import json_lines, video_sink


def road(width: int, height: int) -> tuple[Image, LanesMessage]:
    image = np.full((height, width, 3), 90, np.uint8)
    return image, LocalEngine(fakes.engine()).open_camera().lanes(image, seq=7, timestamp=0.0)


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (320, 180), (64, 64), (3840, 2160), (181, 101)])
def test_lanes_are_drawn_at_any_size(width: int, height: int) -> None:
    image, message = road(width, height)
    drawn = draw_lanes(image, message)
    assert drawn.shape == image.shape
    assert drawn.dtype == np.uint8
    assert (image == 90).all(), "the original is left as it is"
    left, right = message.lanes
    row = round(0.8 * height)
    blue, _, red = (int(value) for value in drawn[row, round(left.x(row))])
    assert red > blue, "the left boundary is orange"
    blue, _, red = (int(value) for value in drawn[row, round(right.x(row))])
    assert blue > red, "the right boundary is blue"
    middle = drawn[row, width // 2]
    assert middle[1] > middle[2], "the ego lane is green"


def test_what_is_predicted_is_dashed() -> None:
    image, message = road(1280, 720)

    def painted(state: str) -> int:
        lane = message.lanes[0].model_copy(update={"state": state, "position": -2})
        drawn = draw_lanes(image, message.model_copy(update={"lanes": [lane]}))
        return int((drawn[360:] != 90).any(axis=2).sum())

    assert painted("predicted") < 0.75 * painted("detected")


def test_no_lanes_and_unknown_positions_can_be_drawn() -> None:
    image, message = road(320, 180)
    assert draw_lanes(image, message.model_copy(update={"lanes": []})).shape == image.shape
    far = message.lanes[0].model_copy(update={"position": 5})
    assert draw_lanes(image, message.model_copy(update={"lanes": [far]})).shape == image.shape


def test_an_error_can_be_drawn() -> None:
    image = np.full((180, 320, 3), 90, np.uint8)
    assert (draw_error(image, error_message(SourceError("why"), seq=3)) != image).any()


def sizes_and_times(path: Path) -> list[tuple[int, int, float]]:
    with av.open(str(path)) as container:
        return [(frame.width, frame.height, round(frame.time, 3)) for frame in container.decode(video=0)]


def test_a_video_keeps_times_and_one_size(tmp_path: Path) -> None:
    shapes = [(101, 181), (101, 181), (300, 200), (50, 400)]
    with video_sink(tmp_path / "new" / "a.mp4", 25.0) as sink:
        assert sink is not None
        for shape, time in zip(shapes, (5.0, 5.04, None, 5.04), strict=True):
            sink.write(np.full((*shape, 3), 128, np.uint8), time)
    assert sizes_and_times(tmp_path / "new" / "a.mp4") == [
        (182, 102, 0.0),
        (182, 102, 0.04),
        (182, 102, 0.08),
        (182, 102, 0.12),
    ]


def test_a_video_without_frames_breaks_nothing(tmp_path: Path) -> None:
    with video_sink(tmp_path / "a.mp4", 25.0):
        pass


def test_without_h264_it_is_mpeg4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", {"mpeg4"})
    with video_sink(tmp_path / "a.mp4", 25.0) as sink:
        assert sink is not None
        sink.write(np.full((48, 64, 3), 128, np.uint8), 0.0)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"


def test_sinks_without_a_path_are_none() -> None:
    with video_sink(None, 25.0) as video, json_lines(None) as lines:
        assert video is None
        assert lines is None
