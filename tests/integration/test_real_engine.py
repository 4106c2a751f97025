"""The shipped network behind the service: what goes in at one end comes out at the other."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from lanestream.engine import Engine
from lanestream.imaging import ImageLimits, decode
from lanestream.protocol import LanesMessage
from lanestream_client import LaneClient, SourceFrame
from lanestream_client.in_process import InProcess
from lanestream_exporter.scenes import Drive, render_clip, sample_clip

FPS = 25.0


@pytest.fixture(scope="module")
def drive() -> list[bytes]:
    """Six frames of a rendered highway, as PNG files, so that nothing is lost on the way."""
    clip = sample_clip(np.random.default_rng(24), 640, 360, frames=6, fps=FPS, drive=Drive("highway", fair=True))
    return [cv2.imencode(".png", frame.image)[1].tobytes() for frame in render_clip(clip)]


def without_timing(message: LanesMessage | None) -> dict[str, Any]:
    assert message is not None
    return message.model_dump(exclude={"timing_ms", "seq", "timestamp"})


def frames(files: list[bytes]) -> list[SourceFrame]:
    return [SourceFrame(seq, seq / FPS, data=data) for seq, data in enumerate(files)]


def test_both_ego_boundaries_are_followed(real_url: str, drive: list[bytes]) -> None:
    with LaneClient(real_url) as client:
        results = [result.lanes for result in client.stream(frames(drive), mode="all")]
    egos = {(lanes.ego.left, lanes.ego.right) for lanes in results if lanes is not None}
    assert len(egos) == 1, "the identities stay"
    (ego,) = egos
    assert None not in ego
    for lanes in results:
        assert lanes is not None
        for lane in lanes.lanes:
            for x, y in lane.points:
                assert lane.x(y) == pytest.approx(x, abs=0.01)


def test_a_stream_in_process_gives_the_same(real_url: str, real_engine: Engine, drive: list[bytes]) -> None:
    from lanestream.local import LocalEngine

    local = InProcess(LocalEngine(real_engine))
    with LaneClient(real_url) as client:
        remote = [without_timing(result.lanes) for result in client.stream(frames(drive), mode="all")]
        assert without_timing(client.detect(drive[0])) == remote[0]
    assert [without_timing(result.lanes) for result in local.stream(frames(drive))] == remote
    assert without_timing(local.detect(drive[0])) == remote[0]


def test_times_that_jump_break_nothing(real_url: str, drive: list[bytes]) -> None:
    times = [0.0, -5.0, 1e15, -1e15, 0.0, 0.04]
    jumping = [SourceFrame(seq, times[seq], data=data) for seq, data in enumerate(drive)]
    with LaneClient(real_url) as client:
        results = list(client.stream(jumping, mode="all"))
    assert [result.lanes is not None and result.lanes.timestamp for result in results] == times
    assert all(result.lanes is not None and result.lanes.ego.left is not None for result in results)


def test_sizes_may_change_in_the_middle(real_url: str, drive: list[bytes]) -> None:
    image = decode(drive[0], ImageLimits())
    sizes = [(640, 360), (320, 180), (1920, 1080), (64, 64), (200, 1000), (640, 360)]
    files = [cv2.imencode(".jpg", cv2.resize(image, size))[1].tobytes() for size in sizes]
    with LaneClient(real_url) as client:
        results = [result.lanes for result in client.stream(files, mode="all")]
    assert [(lanes.width, lanes.height) for lanes in results if lanes is not None] == sizes
