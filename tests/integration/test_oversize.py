"""Images that are larger than the service accepts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator

import cv2
import fakes
import numpy as np
import pytest

from lanestream.errors import ImageTooLargeError, SettingsError
from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel, LanesMessage
from lanestream_client import AsyncLaneClient, LaneClient, SourceFrame
from lanestream_client.in_process import InProcessClient
from lanestream_client.oversize import _size_of

CAMERA = CameraModel(height=1.4, focal_length=(2500.0, 2500.0))


def photo(road: bytes, kind: str = ".jpg", size: tuple[int, int] = (4032, 2268)) -> bytes:
    """A photo of the road with 9.1 megapixels, or more."""
    image = cv2.imdecode(np.frombuffer(road, np.uint8), cv2.IMREAD_COLOR)
    return cv2.imencode(kind, cv2.resize(image, size, interpolation=cv2.INTER_CUBIC))[1].tobytes()


@pytest.fixture
def said() -> Iterator[list[str]]:
    """What the client logs. A server that starts in this process takes the root logger's handlers away."""
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())
    logging.getLogger("lanestream_client").addHandler(handler)
    yield lines
    logging.getLogger("lanestream_client").removeHandler(handler)


def check_alike(ours: LanesMessage, theirs: LanesMessage) -> None:
    assert (ours.width, ours.height) == (theirs.width, theirs.height)
    assert ours.horizon == pytest.approx(theirs.horizon, abs=0.01 * theirs.height)
    known = {lane.position: lane for lane in theirs.lanes}
    near = [lane for lane in ours.lanes if abs(lane.position) == 1]
    assert len(near) == 2
    for lane in near:
        for share in (0.8, 0.9, 0.99):
            row = share * theirs.height
            assert lane.x(row) == pytest.approx(known[lane.position].x(row), abs=0.006 * theirs.width)
        column, row = lane.points[0]
        assert column == pytest.approx(lane.x(row), abs=1.0)


async def test_a_large_photo_gets_the_lanes_that_it_gets_without_a_service(
    real_engine: object, real_url: str, road: bytes, said: list[str]
) -> None:
    data = photo(road, size=(4608, 2592))
    camera = CameraModel(height=1.4, focal_length=(4600.0, 4600.0))
    expected = InProcessClient(LocalEngine(real_engine)).detect(data, camera=camera)
    with LaneClient(real_url) as client:
        check_alike(client.detect(data, camera=camera), expected)
    async with AsyncLaneClient(real_url) as other:
        found = await other.detect(data, camera=camera)
    check_alike(found, expected)
    assert found.ego.lane_width_m == pytest.approx(expected.ego.lane_width_m, abs=0.2)
    assert said == 2 * [
        "images of 4608 x 2592 are larger than the service accepts: they are sent as 1920 x 1080; "
        "lanes are in pixels of the original"
    ]


@pytest.mark.parametrize("make", [lambda pixels: {"pixels": pixels}, lambda pixels: {"data": fakes_jpeg(pixels)}])
async def test_large_frames_of_a_stream(serve: Callable[..., str], make: Callable, said: list[str]) -> None:
    url = serve(fakes.engine(), max_pixels=400 * 225)
    frames = [SourceFrame(seq, 0.04 * seq, **make(np.full((360, 640, 3), 90, np.uint8))) for seq in range(3)]
    with LaneClient(url) as client:
        results = list(client.stream(frames, mode="all"))
    async with AsyncLaneClient(url) as other:
        results += [result async for result in other.stream(frames, mode="all")]
    assert [result.error for result in results] == 6 * [None]
    assert {(result.lanes.width, result.lanes.height) for result in results if result.lanes} == {(640, 360)}
    assert [line[:40] for line in said] == 2 * ["images of 640 x 360 are larger than the "]


def test_a_file_with_too_many_bytes_is_sent_smaller(serve: Callable[..., str]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (360, 640, 3), np.uint8)
    data = cv2.imencode(".png", noise)[1].tobytes()
    with LaneClient(serve(fakes.engine(), max_bytes=400_000)) as client:
        assert len(data) > 400_000
        assert (client.detect(data).width, client.detect(data).height) == (640, 360)
        (result,) = client.stream([data])
        assert result.error is None
        with pytest.raises(ImageTooLargeError):
            client.detect(bytes(500_000))


def test_a_camera_in_pixels_must_say_of_which_image(serve: Callable[..., str]) -> None:
    frame = SourceFrame(0, 0.0, pixels=np.full((360, 640, 3), 90, np.uint8))
    with LaneClient(serve(fakes.engine(), max_pixels=400 * 225)) as client:
        with pytest.raises(SettingsError, match=r'add "image_size": \[640, 360\]'):
            list(client.stream([frame], camera=CAMERA))
        known = CAMERA.model_copy(update={"image_size": (640, 360)})
        assert [result.error for result in client.stream([frame], camera=known)] == [None]


@pytest.mark.parametrize("kind", [".jpg", ".png", ".webp"])
def test_the_size_is_read_from_the_file(kind: str) -> None:
    for width, height in ((320, 180), (1001, 777)):
        data = cv2.imencode(kind, np.zeros((height, width, 3), np.uint8))[1].tobytes()
        assert _size_of(SourceFrame(0, None, data=data)) == (width, height)
    lossy = cv2.imencode(".webp", np.zeros((180, 320, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 50])[1].tobytes()
    assert _size_of(SourceFrame(0, None, data=lossy)) == (320, 180)
    assert [_size_of(SourceFrame(0, None, data=data)) for data in (b"", b"text", b"\xff\xd8\xff")] == 3 * [None]


def fakes_jpeg(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", pixels)[1].tobytes()
