"""The blocking and the async client against real servers."""

from __future__ import annotations

import re
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fakes
import numpy as np
import pytest
from scripted import refused_url
from websockets.sync.server import ServerConnection
from websockets.sync.server import serve as ws_serve

from lanestream.errors import (
    BusyError,
    ConnectionFailedError,
    ImageError,
    ImageTooLargeError,
    NoDetectorError,
    NotReadyError,
    ProtocolError,
    SettingsError,
    SourceError,
)
from lanestream.local import LocalEngine
from lanestream.protocol import CameraModel, DepartureEventModel, DepartureOptions, LanesMessage
from lanestream.road.view import Image
from lanestream_client import AsyncLaneClient, LaneClient, SourceFrame, StreamResult
from lanestream_client.in_process import InProcessClient
from lanestream_client.requests import ServiceInfo
from lanestream_client.sinks import video_sink

Serve = Callable[..., str]
PAGE = Path(__file__).parents[2] / "docs" / "client.md"


def frames(count: int) -> Iterator[SourceFrame]:
    data = fakes.image_file()
    return (SourceFrame(seq, 0.04 * seq, data=data, name=f"{seq}.jpg") for seq in range(count))


def positions(lanes: LanesMessage | None) -> list[int]:
    assert lanes is not None
    return [lane.position for lane in lanes.lanes]


def test_detect_takes_bytes_and_paths(url: str, tmp_path: Path) -> None:
    path = tmp_path / "road.jpg"
    path.write_bytes(fakes.image_file())
    with LaneClient(url) as client:
        assert client.describe() == ServiceInfo("fake 1", "cpu")
        for image in (path, str(path), path.read_bytes()):
            assert [lane.position for lane in client.detect(image, horizon=0.3).lanes] == [-1, 1]
        with pytest.raises(ImageError, match="looks like text"):
            client.detect(b"text")
        with pytest.raises(SourceError, match="no such file"):
            client.detect(tmp_path / "missing.jpg")
        with pytest.raises(ProtocolError, match="horizon"):
            client.detect(path, horizon=7.0)


def test_detect_takes_pixels_and_draws_on_them(url: str) -> None:
    picture = fakes.picture()
    with LaneClient(url) as client:
        lanes = client.detect(picture)
        assert (lanes.width, lanes.height) == (320, 180)
        assert positions(lanes) == [-1, 1]
        assert positions(client.detect(picture[:, ::-1])) == [-1, 1], "a mirrored view is contiguous nowhere"
        drawn = lanes.draw(picture)
        assert drawn.shape == picture.shape
        assert (drawn != picture).any()
        with pytest.raises(ImageError, match="the frame is 160 x 90, but its lanes are in pixels of 320 x 180"):
            lanes.draw(picture[::2, ::2])
        with pytest.raises(ImageError, match=r"the frame has the type float32 .*rgb\[\.\.\., ::-1\] converts RGB"):
            client.detect(picture.astype(np.float32))  # type: ignore[arg-type]


def test_large_pixels_are_scaled_down_and_their_lanes_back(url: str) -> None:
    picture = fakes.picture(640, 360)
    with LaneClient(url) as client:
        assert client.detect(picture).width == 640
        (result,) = client.stream([picture], mode="all")
    assert result.lanes is not None
    assert (result.lanes.width, result.lanes.height) == (640, 360)


def test_streams_take_pixels_and_results_draw_themselves(url: str) -> None:
    picture = fakes.picture()
    with LaneClient(url) as client:
        results = list(client.stream([picture, SourceFrame(1, 0.04, pixels=picture), fakes.image_file()], mode="all"))
    assert [result.frame.seq for result in results] == [0, 1, 2]
    assert results[1].lanes is not None
    assert results[1].lanes.timestamp == 0.04
    for result in results:
        drawn = result.draw()
        assert drawn.shape == picture.shape
        assert (drawn != picture).any()
    on_white = results[0].draw(np.full_like(picture, 255))
    assert on_white[-20:, -20:].min() == 255
    with pytest.raises(ImageError, match="in pixels of 320 x 180"):
        results[0].draw(fakes.picture(640, 360))


def test_an_error_is_drawn_too(url: str) -> None:
    with LaneClient(url) as client:
        failed, unreadable = client.stream([fakes.image_file(shade=255), b"text"], mode="all")
    assert (failed.draw() != 255).any()
    with pytest.raises(ImageError, match="can't be decoded"):
        unreadable.draw()


def test_pixels_of_another_type_end_a_stream_after_the_results_before(url: str) -> None:
    picture = fakes.picture()
    with LaneClient(url) as client:
        results = iter(client.stream([picture, picture[..., 0]], mode="all"))
        assert next(results).frame.seq == 0
        with pytest.raises(ImageError, match=r"the shape \(180, 320\)"):
            next(results)


async def test_the_async_client_takes_pixels(url: str) -> None:
    picture = fakes.picture()

    async def camera() -> AsyncIterator[Image]:
        for _ in range(3):
            yield picture

    async with AsyncLaneClient(url) as client:
        assert positions(await client.detect(picture)) == [-1, 1]
        for source in (camera(), [picture] * 3):
            results = [result async for result in client.stream(source, mode="all")]
            assert [result.frame.seq for result in results] == [0, 1, 2]
            assert all(result.lanes is not None for result in results)


def test_pixels_work_in_process() -> None:
    picture = fakes.picture()
    client = InProcessClient(LocalEngine(fakes.engine()))
    assert positions(client.detect(picture)) == [-1, 1]
    assert positions(client.detect(picture[:, ::-1])) == [-1, 1]
    assert [positions(result.lanes) for result in client.stream([picture] * 5)][-1] == [-1, 1]


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_no_frame_of_a_file_is_lost(url: str, mode: str) -> None:
    with LaneClient(url) as client:
        stream = client.stream(frames(30), mode=mode)
        results = list(stream)
    assert [result.frame.seq for result in results] == list(range(30))
    assert all(result.lanes is not None and result.lanes.timestamp == result.frame.timestamp for result in results)
    assert stream.ready is not None
    assert stream.ready.mode == mode
    assert stream.summary is not None
    assert (stream.summary.answered, stream.summary.dropped) == (30, 0)


def test_errors_of_frames_come_in_frame_order(url: str) -> None:
    good = fakes.image_file()
    with LaneClient(url) as client:
        stream = client.stream([good, b"text", good, bytes(300_000), fakes.image_file(shade=255), good])
        results = list(stream)
    codes = [result.error.code if result.error else None for result in results]
    assert codes == [None, "bad_image", None, "image_too_large", "internal", None]
    assert [result.frame.seq for result in results] == list(range(6))


def test_a_source_error_is_raised_after_the_results_of_earlier_frames(url: str) -> None:
    def failing() -> Iterator[SourceFrame]:
        yield from frames(5)
        raise SourceError("the cable is unplugged")

    with LaneClient(url) as client:
        results = iter(client.stream(failing(), mode="all"))
        assert [next(results).frame.seq for _ in range(5)] == list(range(5))
        with pytest.raises(SourceError, match="cable"):
            next(results)


def test_a_stream_can_be_closed_early(url: str) -> None:
    def endless() -> Iterator[SourceFrame]:
        data = fakes.image_file()
        seq = 0
        while True:
            yield SourceFrame(seq, None, data=data)
            seq += 1

    with LaneClient(url) as client:
        results = iter(client.stream(endless(), mode="all"))
        assert next(results).frame.seq == 0
        results.close()


def test_frame_numbers_must_rise(url: str) -> None:
    data = fakes.image_file()
    with LaneClient(url) as client, pytest.raises(ProtocolError, match="must rise"):
        list(client.stream([SourceFrame(1, 0.0, data=data), SourceFrame(1, 0.1, data=data)]))


def test_an_unreachable_service_is_reported_in_one_line() -> None:
    with LaneClient(refused_url()) as client:
        for call in (client.describe, lambda: client.detect(b"x"), lambda: list(client.stream([b"x"]))):
            with pytest.raises(ConnectionFailedError, match=r"can't reach .*refused \(start one with"):
                call()


def test_another_server_at_the_url_is_reported(url: str) -> None:
    with LaneClient(f"{url}/elsewhere") as client:
        with pytest.raises(ConnectionFailedError, match="answered 403"):
            list(client.stream([b"x"]))
        with pytest.raises(Exception, match="Not Found"):
            client.detect(b"x")
    with pytest.raises(SettingsError, match="not a valid service URL"):
        LaneClient("ftp://somewhere")


def test_refusals_raise_their_error_classes(serve: Serve) -> None:
    with LaneClient(serve()) as client:
        for call in (client.describe, lambda: client.detect(b"x"), lambda: list(client.stream([b"x"]))):
            with pytest.raises(NotReadyError):
                call()
    replica = serve(fakes.engine(), max_sessions=1)
    with LaneClient(replica) as one, LaneClient(replica) as other:
        holding = iter(one.stream(frames(1000), mode="all"))
        next(holding)
        with pytest.raises(BusyError):
            list(other.stream([b"x"]))
        holding.close()


def test_the_detector_can_be_chosen(both_url: str) -> None:
    with LaneClient(both_url) as client:
        assert client.describe() == client.describe("candidates") == ServiceInfo("fake 1", "cpu")
        assert client.describe("regression") == ServiceInfo("other 2", "cpu")
        assert positions(client.detect(fakes.image_file(), detector="regression")) == [-1]
        assert positions(client.detect(fakes.image_file(), detector="candidates")) == [-1, 1]
        stream = client.stream(frames(3), detector="regression")
        assert [positions(result.lanes) for result in stream] == [[-1]] * 3
        assert stream.ready is not None
        assert (stream.ready.detector, stream.ready.model) == ("regression", "other 2")


async def test_the_detector_can_be_chosen_with_the_async_client(both_url: str) -> None:
    async with AsyncLaneClient(both_url) as client:
        assert await client.describe("regression") == ServiceInfo("other 2", "cpu")
        assert positions(await client.detect(fakes.image_file(), detector="regression")) == [-1]
        one, other = client.stream(frames(3)), client.stream(frames(3), detector="regression")
        both = zip([result async for result in one], [result async for result in other], strict=True)
        assert [(positions(a.lanes), positions(b.lanes)) for a, b in both] == [([-1, 1], [-1])] * 3


async def test_a_detector_that_is_not_loaded_is_refused(url: str) -> None:
    message = r"no detector regression.*\(ask for candidates\)"
    with LaneClient(url) as client:
        for call in (
            lambda: client.describe("regression"),
            lambda: client.detect(fakes.image_file(), detector="regression"),
            lambda: list(client.stream(frames(1), detector="regression")),
        ):
            with pytest.raises(NoDetectorError, match=message):
                call()
        with pytest.raises(ProtocolError, match="'candidates' or 'regression'"):
            list(client.stream(frames(1), detector="unknown"))
    async with AsyncLaneClient(url) as client:
        with pytest.raises(NoDetectorError, match=message):
            await client.detect(fakes.image_file(), detector="regression")
        with pytest.raises(NoDetectorError, match=message):
            _ = [result async for result in client.stream(frames(1), detector="regression")]


def test_the_detector_can_be_chosen_in_process() -> None:
    local = InProcessClient(LocalEngine(fakes.two_detectors()))
    assert local.describe() == ServiceInfo("fake 1", "cpu")
    assert local.describe("regression") == ServiceInfo("other 2", "cpu")
    assert positions(local.detect(fakes.image_file())) == [-1, 1]
    assert positions(local.detect(fakes.image_file(), detector="regression")) == [-1]
    one, other = local.stream(frames(3)), local.stream(frames(3), detector="regression")
    both = zip(one, other, strict=True)
    assert [(positions(a.lanes), positions(b.lanes)) for a, b in both] == [([-1, 1], [-1])] * 3
    one_detector = InProcessClient(LocalEngine(fakes.engine()))
    with pytest.raises(NoDetectorError, match="ask for candidates"):
        one_detector.stream(frames(1), detector="regression")


def drifting_frames() -> Iterator[SourceFrame]:
    """Frames for `fakes.drifting_engine`, of a vehicle that is slower than departure warnings are for by default."""
    data = fakes.image_file()
    return (SourceFrame(seq, 0.04 * seq, data=data, speed=10.0, indicator="off") for seq in range(80))


def departures(results: Iterable[StreamResult]) -> list[str]:
    events = [event for result in results if result.lanes is not None for event in result.lanes.events]
    return [event.state for event in events if isinstance(event, DepartureEventModel)]


async def test_departures_are_watched_as_the_client_asks(serve: Serve) -> None:
    camera, asked = CameraModel(height=1.4, field_of_view=62.0), DepartureOptions(least_speed=5.0)
    for options, expected in ((None, []), (asked, ["warning", "crossed"])):
        local = InProcessClient(LocalEngine(fakes.drifting_engine()))
        assert departures(local.stream(drifting_frames(), camera=camera, departure=options)) == expected
        with LaneClient(serve(fakes.drifting_engine())) as client:
            results = client.stream(drifting_frames(), mode="all", camera=camera, departure=options)
            assert departures(results) == expected
        async with AsyncLaneClient(serve(fakes.drifting_engine())) as async_client:
            stream = async_client.stream(drifting_frames(), mode="all", camera=camera, departure=options)
            assert departures([result async for result in stream]) == expected


async def test_the_clients_deliver_warnings(url: str) -> None:
    def repeated() -> Iterator[SourceFrame]:
        return (SourceFrame(seq, 1.0, data=fakes.image_file()) for seq in range(5))

    for client in (LaneClient(url), InProcessClient(LocalEngine(fakes.engine()))):
        stream = client.stream(repeated(), mode="all")
        assert stream.warnings == ()
        assert len(list(stream)) == 5
        assert [(warning.code, warning.seq) for warning in stream.warnings] == [("timestamps_not_advancing", 1)]
        if isinstance(client, LaneClient):
            client.close()
    async with AsyncLaneClient(url) as async_client:
        async_stream = async_client.stream(repeated(), mode="all")
        assert len([result async for result in async_stream]) == 5
        assert [warning.code for warning in async_stream.warnings] == ["timestamps_not_advancing"]


async def test_the_async_client_gives_the_same_results(url: str, tmp_path: Path) -> None:
    path = tmp_path / "road.jpg"
    path.write_bytes(fakes.image_file())
    async with AsyncLaneClient(url) as client:
        assert await client.describe() == ServiceInfo("fake 1", "cpu")
        assert (await client.detect(path)).width == 320
        with pytest.raises(ImageError):
            await client.detect(b"text")
        stream = client.stream([path.read_bytes(), b"text", path.read_bytes()], mode="all")
        results = [result async for result in stream]
        assert [result.error is None for result in results] == [True, False, True]
        assert stream.ready is not None
        assert stream.summary is not None
        assert stream.summary.failed == 1


async def test_the_async_client_takes_an_async_source(url: str) -> None:
    async def failing() -> AsyncIterator[SourceFrame]:
        for frame in frames(7):
            yield frame
        raise SourceError("the cable is unplugged")

    async with AsyncLaneClient(url) as client:
        results = aiter(client.stream(failing(), mode="all"))
        assert [(await anext(results)).frame.seq for _ in range(7)] == list(range(7))
        with pytest.raises(SourceError, match="cable"):
            await anext(results)
        unfinished = client.stream(frames(1000)).__aiter__()
        assert (await anext(unfinished)).frame.seq == 0
        await unfinished.aclose()


async def test_the_async_client_raises_the_same_errors() -> None:
    async with AsyncLaneClient(refused_url()) as client:
        with pytest.raises(ConnectionFailedError):
            await client.describe()
        with pytest.raises(ConnectionFailedError):
            _ = [result async for result in client.stream([b"x"])]


@contextmanager
def closing_service(*messages: str, code: int = 1012) -> Iterator[str]:
    """Yields the URL of a service that answers `start` with `messages` and closes with `code`."""

    def handle(connection: ServerConnection) -> None:
        connection.recv()
        for text in messages:
            connection.send(text)
        connection.close(code, "restarting")

    with ws_serve(handle, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(fakes.WAIT_S)


READY = fakes.ready()


@pytest.mark.parametrize("messages", [(), (READY.model_dump_json(),)])
def test_a_service_that_closes_the_stream_is_reported(messages: tuple[str, ...]) -> None:
    with (
        closing_service(*messages) as replica,
        LaneClient(replica, reconnect_s=0.0) as client,
        pytest.raises(ConnectionFailedError, match="closed the stream with code 1012: restarting"),
    ):
        list(client.stream(frames(100), mode="all"))


async def test_the_async_client_reports_a_service_that_closes_the_stream() -> None:
    with closing_service(READY.model_dump_json()) as replica:
        async with AsyncLaneClient(replica, reconnect_s=0.0) as client:
            with pytest.raises(ConnectionFailedError, match="1012"):
                _ = [result async for result in client.stream(frames(100), mode="all")]


def test_the_close_code_of_a_too_large_message_has_its_error() -> None:
    with (
        closing_service(READY.model_dump_json(), code=1009) as replica,
        LaneClient(replica) as client,
        pytest.raises(ImageTooLargeError),
    ):
        list(client.stream(frames(100), mode="all"))


def examples() -> list[str]:
    """Returns the blocks of Python in docs/client.md."""
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_examples_of_the_client_page_work(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    monkeypatch.chdir(tmp_path)
    blocking, asynchronous, *_ = examples()
    for code in (blocking, asynchronous):
        exec(code.replace("http://127.0.0.1:8000", url), {})  # noqa: S102
        lines = capsys.readouterr().out.splitlines()
        assert [line.split(" ", 2)[0] for line in lines if line[0].isdigit()] == [str(seq) for seq in range(25)]


def test_the_examples_with_arrays_and_other_libraries_work(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    monkeypatch.chdir(tmp_path)
    _, _, arrays, supervision, *_ = (code.replace("http://127.0.0.1:8000", url) for code in examples())
    names: dict[str, Any] = {}
    exec(arrays, names)  # noqa: S102
    assert (tmp_path / "road.lanes.jpg").stat().st_size > 0
    assert names["picture"].shape == (180, 320, 3)
    pytest.importorskip("supervision")
    exec(supervision, names)  # noqa: S102
    assert (names["picture"] != names["frame"]).any()
    assert names["zone"].polygon.shape[1] == 2


def test_the_example_with_rerun_works(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun = pytest.importorskip("rerun")
    with video_sink(tmp_path / "drive.mp4", 25.0) as sink:
        assert sink is not None
        for number in range(5):
            sink.write(fakes.picture(), number / 25.0)
    monkeypatch.chdir(tmp_path)
    (code,) = (code for code in examples() if "rerun.init" in code)
    monkeypatch.setattr(rerun, "init", lambda name, spawn: None)
    exec(code.replace("http://127.0.0.1:8000", url), {})  # noqa: S102
