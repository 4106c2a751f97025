"""The clients against real servers: the one that blocks and the one that awaits."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import fakes
import pytest
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
from lanestream.protocol import LanesMessage
from lanestream_client import AsyncLaneClient, LaneClient, SourceFrame
from lanestream_client.in_process import InProcess
from lanestream_client.service import ServiceInfo

Serve = Callable[..., str]
PAGE = Path(__file__).parents[2] / "docs" / "client.md"


def frames(count: int) -> Iterator[SourceFrame]:
    data = fakes.image_file()
    return (SourceFrame(seq, 0.04 * seq, data=data, name=f"{seq}.jpg") for seq in range(count))


def positions(lanes: LanesMessage | None) -> list[int]:
    assert lanes is not None
    return [lane.position for lane in lanes.lanes]


@pytest.fixture
def nobody() -> str:
    """The URL of a port that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"http://127.0.0.1:{probe.getsockname()[1]}"


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
            client.detect(tmp_path / "none.jpg")
        with pytest.raises(ProtocolError, match="horizon"):
            client.detect(path, horizon=7.0)


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_a_source_that_can_wait_loses_nothing(url: str, mode: str) -> None:
    with LaneClient(url) as client:
        stream = client.stream(frames(30), mode=mode)
        results = list(stream)
    assert [result.frame.seq for result in results] == list(range(30))
    assert all(result.lanes is not None and result.lanes.timestamp == result.frame.timestamp for result in results)
    assert stream.ready is not None
    assert stream.ready.mode == mode
    assert stream.summary is not None
    assert (stream.summary.answered, stream.summary.dropped) == (30, 0)


def test_errors_of_frames_come_in_their_place(url: str) -> None:
    good = fakes.image_file()
    with LaneClient(url) as client:
        stream = client.stream([good, b"text", good, bytes(300_000), fakes.image_file(shade=255), good])
        results = list(stream)
    codes = [result.error.code if result.error else None for result in results]
    assert codes == [None, "bad_image", None, "image_too_large", "internal", None]
    assert [result.frame.seq for result in results] == list(range(6))


def test_a_source_that_fails_is_told_after_what_it_gave(url: str) -> None:
    def failing() -> Iterator[SourceFrame]:
        yield from frames(5)
        raise SourceError("the cable is out")

    with LaneClient(url) as client:
        results = iter(client.stream(failing(), mode="all"))
        assert [next(results).frame.seq for _ in range(5)] == list(range(5))
        with pytest.raises(SourceError, match="cable"):
            next(results)


def test_breaking_off_early_is_clean(url: str) -> None:
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


def test_numbers_must_rise(url: str) -> None:
    data = fakes.image_file()
    with LaneClient(url) as client, pytest.raises(ProtocolError, match="must rise"):
        list(client.stream([SourceFrame(1, 0.0, data=data), SourceFrame(1, 0.1, data=data)]))


def test_a_service_that_is_not_there_is_told_in_a_line(nobody: str) -> None:
    with LaneClient(nobody) as client:
        for call in (client.describe, lambda: client.detect(b"x"), lambda: list(client.stream([b"x"]))):
            with pytest.raises(ConnectionFailedError, match=r"can't reach .*refused \(start one with"):
                call()


def test_something_else_at_the_url_is_told(url: str) -> None:
    with LaneClient(f"{url}/elsewhere") as client:
        with pytest.raises(ConnectionFailedError, match="answered 403"):
            list(client.stream([b"x"]))
        with pytest.raises(Exception, match="Not Found"):
            client.detect(b"x")
    with pytest.raises(SettingsError, match="no address"):
        LaneClient("ftp://somewhere")


def test_refusals_have_their_types(serve: Serve) -> None:
    with LaneClient(serve()) as client:
        for call in (client.describe, lambda: client.detect(b"x"), lambda: list(client.stream([b"x"]))):
            with pytest.raises(NotReadyError):
                call()
    place = serve(fakes.engine(), max_sessions=1)
    with LaneClient(place) as one, LaneClient(place) as other:
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


async def test_the_detector_can_be_chosen_by_the_awaiting_client(both_url: str) -> None:
    async with AsyncLaneClient(both_url) as client:
        assert await client.describe("regression") == ServiceInfo("other 2", "cpu")
        assert positions(await client.detect(fakes.image_file(), detector="regression")) == [-1]
        one, other = client.stream(frames(3)), client.stream(frames(3), detector="regression")
        both = zip([result async for result in one], [result async for result in other], strict=True)
        assert [(positions(a.lanes), positions(b.lanes)) for a, b in both] == [([-1, 1], [-1])] * 3


async def test_a_detector_that_is_not_there_has_its_type(url: str) -> None:
    told = r"no detector regression.*\(ask for candidates\)"
    with LaneClient(url) as client:
        for call in (
            lambda: client.describe("regression"),
            lambda: client.detect(fakes.image_file(), detector="regression"),
            lambda: list(client.stream(frames(1), detector="regression")),
        ):
            with pytest.raises(NoDetectorError, match=told):
                call()
        with pytest.raises(ProtocolError, match="'candidates' or 'regression'"):
            list(client.stream(frames(1), detector="guesses"))
    async with AsyncLaneClient(url) as client:
        with pytest.raises(NoDetectorError, match=told):
            await client.detect(fakes.image_file(), detector="regression")
        with pytest.raises(NoDetectorError, match=told):
            _ = [result async for result in client.stream(frames(1), detector="regression")]


def test_the_detector_can_be_chosen_in_process() -> None:
    local = InProcess(LocalEngine(fakes.two_detectors()))
    assert local.describe() == ServiceInfo("fake 1", "cpu")
    assert local.describe("regression") == ServiceInfo("other 2", "cpu")
    assert positions(local.detect(fakes.image_file())) == [-1, 1]
    assert positions(local.detect(fakes.image_file(), detector="regression")) == [-1]
    one, other = local.stream(frames(3)), local.stream(frames(3), detector="regression")
    both = zip(one, other, strict=True)
    assert [(positions(a.lanes), positions(b.lanes)) for a, b in both] == [([-1, 1], [-1])] * 3
    only = InProcess(LocalEngine(fakes.engine()))
    with pytest.raises(NoDetectorError, match="ask for candidates"):
        only.stream(frames(1), detector="regression")


async def test_the_awaiting_client_does_the_same(url: str, tmp_path: Path) -> None:
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


async def test_the_awaiting_client_takes_a_source_that_awaits(url: str) -> None:
    async def failing() -> AsyncIterator[SourceFrame]:
        for frame in frames(7):
            yield frame
        raise SourceError("the cable is out")

    async with AsyncLaneClient(url) as client:
        results = aiter(client.stream(failing(), mode="all"))
        assert [(await anext(results)).frame.seq for _ in range(7)] == list(range(7))
        with pytest.raises(SourceError, match="cable"):
            await anext(results)
        breaking_off = client.stream(frames(1000)).__aiter__()
        assert (await anext(breaking_off)).frame.seq == 0
        await breaking_off.aclose()


async def test_the_awaiting_client_tells_failures_alike(nobody: str) -> None:
    async with AsyncLaneClient(nobody) as client:
        with pytest.raises(ConnectionFailedError):
            await client.describe()
        with pytest.raises(ConnectionFailedError):
            _ = [result async for result in client.stream([b"x"])]


@contextmanager
def dying(*said: str, code: int = 1012) -> Iterator[str]:
    """The URL of a service that says what it has to say to `start`, then closes with `code`."""

    def handle(connection: ServerConnection) -> None:
        connection.recv()
        for text in said:
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


@pytest.mark.parametrize("said", [(), (READY.model_dump_json(),)])
def test_a_service_that_goes_away_is_told(said: tuple[str, ...]) -> None:
    told = "closed the stream with code 1012: restarting"
    with (
        dying(*said) as place,
        LaneClient(place, reconnect_s=0.0) as client,
        pytest.raises(ConnectionFailedError, match=told),
    ):
        list(client.stream(frames(100), mode="all"))


async def test_a_service_that_goes_away_is_told_to_the_awaiting_client() -> None:
    with dying(READY.model_dump_json()) as place:
        async with AsyncLaneClient(place, reconnect_s=0.0) as client:
            with pytest.raises(ConnectionFailedError, match="1012"):
                _ = [result async for result in client.stream(frames(100), mode="all")]


def test_a_message_that_was_too_big_is_told_as_that() -> None:
    with (
        dying(READY.model_dump_json(), code=1009) as place,
        LaneClient(place) as client,
        pytest.raises(ImageTooLargeError),
    ):
        list(client.stream(frames(100), mode="all"))


def test_the_code_of_the_page_about_the_client(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(blocks) == 2
    for code in blocks:
        exec(code.replace("http://127.0.0.1:8000", url), {})  # noqa: S102
        lines = capsys.readouterr().out.splitlines()
        assert [line.split(" ", 2)[0] for line in lines if line[0].isdigit()] == [str(seq) for seq in range(25)]
