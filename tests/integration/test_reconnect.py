"""Streams whose connections break, are refused or drained: both clients against a service that plays a script."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterator
from typing import Any

import fakes
import pytest
from scripted import Visit, refused_url, scripted

from lanestream.errors import (
    BusyError,
    ConnectionFailedError,
    DrainingError,
    EvictedError,
    ForbiddenError,
    IdleError,
    LanestreamError,
    NoDetectorError,
    NotReadyError,
    OverrunError,
    SourceError,
    TooOldError,
    UnauthorizedError,
)
from lanestream_client import AsyncLaneClient, LaneClient, SourceFrame, StreamResult
from lanestream_client.async_client import AsyncLaneStream
from lanestream_client.client import LaneStream
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.endpoint import endpoints
from lanestream_client.failover import Patience, Route
from lanestream_client.requests import start

KEY = "hidden-key"

Told = list[tuple[int, str]]
Outcome = tuple[Told, Any, LanestreamError | None]
Stream = Callable[..., Outcome]


def frames(count: int) -> Iterator[SourceFrame]:
    return (SourceFrame(seq, 0.04 * seq, data=b"image") for seq in range(count))


def told(result: StreamResult) -> tuple[int, str]:
    return result.frame.seq, result.error.code if result.error else "lanes"


def blocking(url: Any, source: Any, *, in_flight: int = 1, mode: Any = "all", **more: Any) -> Outcome:
    results: Told = []
    with LaneClient(url, in_flight=in_flight, **more) as client:
        stream = client.stream(source, mode=mode)
        try:
            results += map(told, stream)  # keeps those that came before an error
        except LanestreamError as error:
            return results, stream, error
    return results, stream, None


def awaiting(url: Any, source: Any, *, in_flight: int = 1, mode: Any = "all", **more: Any) -> Outcome:
    async def run() -> Outcome:
        results: Told = []
        async with AsyncLaneClient(url, in_flight=in_flight, **more) as client:
            stream = client.stream(source, mode=mode)
            try:
                async for result in stream:
                    results.append(told(result))
            except LanestreamError as error:
                return results, stream, error
        return results, stream, None

    return asyncio.run(run())


@pytest.fixture(params=[blocking, awaiting], ids=["blocking", "awaiting"])
def stream(request: pytest.FixtureRequest) -> Stream:
    """Streams a source by one of the two clients: what came of its frames, the stream, the error that ended it."""
    followed: Stream = request.param
    return followed


def all_lanes(count: int) -> Told:
    return [(seq, "lanes") for seq in range(count)]


def well(visit: Visit) -> None:
    visit.open()
    visit.finish()


def test_in_all_a_broken_connection_costs_nothing_but_answers_that_were_made(stream: Stream) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        assert [visit.frame() for _ in range(3)] == [0, 1, 2]
        visit.answer(0)
        assert visit.frame() == 3
        visit.break_off()

    def resumed(visit: Visit) -> None:
        visit.open(resumed=True, last_seq=1)
        assert [visit.frame() for _ in range(2)] == [2, 3]
        visit.answer(2, 3)
        visit.finish()

    with scripted(breaking, resumed) as script:
        results, followed, error = stream(script.url, frames(9), in_flight=3)
    assert error is None
    assert results == [(0, "lanes"), (1, "lost"), *all_lanes(9)[2:]]
    assert [start.get("resume_token") for start in script.starts] == [None, "secret"]
    assert followed.reconnects == 1
    assert followed.ready.resumed
    total = followed.summary
    assert (total.frames, total.answered, total.lost, total.failed, total.dropped) == (9, 8, 1, 0, 0)


def test_in_latest_what_was_under_way_is_lost(stream: Stream) -> None:
    def breaking(visit: Visit) -> None:
        visit.open(mode="latest")
        assert [visit.frame() for _ in range(2)] == [0, 1]
        visit.break_off()

    with scripted(breaking, well) as script:
        results, followed, error = stream(script.url, frames(5), in_flight=2, mode="latest")
    assert error is None
    assert results == [(0, "lost"), (1, "lost"), (2, "lanes"), (3, "lanes"), (4, "lanes")]
    assert followed.summary.lost == 2


def test_a_service_that_drains_hands_over_to_the_next(stream: Stream) -> None:
    def draining(visit: Visit) -> None:
        visit.open()
        assert [visit.frame() for _ in range(3)] == [0, 1, 2]
        visit.drain()
        visit.answer(0)
        visit.refuse(DrainingError("too late"), 1)
        visit.close(1012)

    def next_one(visit: Visit) -> None:
        visit.open(resumed=True, last_seq=0)
        visit.finish()

    with scripted(draining) as one, scripted(next_one) as other:
        results, followed, error = stream([one.url, other.url], frames(6), in_flight=3)
        assert other.starts[0]["resume_token"] == "later"  # noqa: S105
    assert error is None
    assert results == all_lanes(6)
    assert followed.summary.lost == 0


@pytest.mark.parametrize(
    "refusal", [BusyError("m"), DrainingError("m"), NotReadyError("m")], ids=["busy", "draining", "not_ready"]
)
def test_a_refusal_that_passes_is_waited_out(stream: Stream, refusal: LanestreamError) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.frame()
        visit.break_off()

    def told_late(visit: Visit) -> None:
        visit.refuse(refusal)
        visit.close(1013)

    with scripted(breaking, refusal, told_late, well) as script:
        results, followed, error = stream(script.url, frames(3))
    assert (results, error, followed.reconnects) == (all_lanes(3), None, 1)


def test_a_stream_that_was_idle_is_opened_again(stream: Stream) -> None:
    def idle(visit: Visit) -> None:
        visit.open()
        visit.answer(visit.frame())
        visit.refuse(IdleError("nothing came"))
        visit.close(4002)

    def resumed(visit: Visit) -> None:
        visit.open(resumed=True, last_seq=0)
        visit.finish()

    with scripted(idle, resumed) as script:
        results, _, error = stream(script.url, frames(4))
    assert (results, error) == (all_lanes(4), None)


@pytest.mark.parametrize("kind", [EvictedError, TooOldError, OverrunError, NoDetectorError])
def test_an_end_that_is_meant_is_told_with_what_it_cost(stream: Stream, kind: type[LanestreamError]) -> None:
    def ending(visit: Visit) -> None:
        visit.open()
        visit.answer(visit.frame())
        visit.frame()
        visit.refuse(kind("so it is"))
        visit.close(4001)

    with scripted(ending) as script:
        results, followed, error = stream(script.url, frames(2))
    assert type(error) is kind
    assert results == [(0, "lanes"), (1, "lost")]
    assert (followed.summary.frames, followed.summary.lost) == (2, 1)


@pytest.mark.parametrize("kind", [UnauthorizedError, ForbiddenError])
def test_who_may_not_come_in_is_told_at_once(stream: Stream, kind: type[LanestreamError]) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.frame()
        visit.break_off()

    with scripted(kind("no")) as script:
        results, _, error = stream(script.url, frames(1))
        assert (results, type(error)) == ([], kind)
    with scripted(breaking, kind("no")) as script:
        results, _, error = stream(script.url, frames(1))
        assert (results, type(error)) == ([(0, "lost")], kind)


def test_who_wants_no_other_connection_is_told_of_the_first_loss(stream: Stream) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.frame()
        visit.close(1012)

    with scripted(breaking) as script:
        results, followed, error = stream(script.url, frames(3), reconnect_s=0.0)
    assert isinstance(error, ConnectionFailedError)
    assert "code 1012" in str(error)
    assert results[0] == (0, "lost")
    assert followed.summary.answered == 0


def test_patience_ends(stream: Stream) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.frame()
        visit.break_off()

    with scripted(breaking, then=NotReadyError("starting")) as script:
        results, followed, error = stream(script.url, [b"image"], reconnect_s=0.2)
    # The last attempt may be cut short by the end of the patience.
    assert isinstance(error, NotReadyError | ConnectionFailedError)
    assert results == [(0, "lost")]
    assert followed.summary.lost == 1


def test_a_replica_that_is_not_there_is_passed_over(stream: Stream) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.frame()
        visit.break_off()

    with scripted(breaking, well) as script:
        results, _, error = stream([refused_url(), script.url, refused_url()], frames(3))
    assert (results, error) == (all_lanes(3), None)
    _, _, error = stream([refused_url(), refused_url()], frames(3))
    assert isinstance(error, ConnectionFailedError)


@pytest.mark.parametrize("awaits", [False, True], ids=["blocking", "awaiting"])
def test_a_replica_that_does_not_even_refuse_is_passed_over(awaits: bool) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.frame()
        visit.break_off()

    with (
        socket.create_server(("127.0.0.1", 0)) as silent,
        scripted(breaking, NotReadyError("starting")) as one,
        scripted(well) as other,
    ):
        mute = f"http://127.0.0.1:{silent.getsockname()[1]}"
        way = Route(endpoints([one.url, mute, other.url]), Patience(attempt_s=0.1), 10.0)
        conversation = ClientProtocol(start("all", None, None, None, None))
        if awaits:
            results = asyncio.run(collected(AsyncLaneStream(way, as_they_come(frames(3)), conversation)))
        else:
            results = list(map(told, LaneStream(way, frames(3), conversation)))
    assert results == all_lanes(3)


async def as_they_come(source: Iterator[SourceFrame]) -> Any:
    for frame in source:
        yield frame


async def collected(results: AsyncLaneStream) -> Told:
    return [told(result) async for result in results]


def test_a_connection_lost_after_the_last_answer_is_no_loss(stream: Stream) -> None:
    def breaking(visit: Visit) -> None:
        visit.open()
        visit.answer(visit.frame(), visit.frame())
        assert visit.frame() == -1
        visit.break_off()

    with scripted(breaking) as script:
        results, followed, error = stream(script.url, frames(2), in_flight=2)
    assert (results, error, followed.reconnects) == (all_lanes(2), None, 0)
    assert followed.summary.answered == 2


def test_a_source_that_fails_between_two_connections_is_told_at_the_end(stream: Stream) -> None:
    def failing() -> Iterator[SourceFrame]:
        yield from frames(2)
        raise SourceError("the cable is out")

    def breaking(visit: Visit) -> None:
        visit.open()
        visit.answer(visit.frame())
        assert visit.frame() == 1
        visit.break_off()

    with scripted(breaking, well) as script:
        results, _, error = stream(script.url, failing())
    assert results == all_lanes(2)
    assert isinstance(error, SourceError)


def test_breaking_off_while_there_is_no_connection_is_clean() -> None:
    def breaking(visit: Visit) -> None:
        visit.open(mode="latest")
        visit.frame()
        visit.break_off()

    with scripted(breaking) as script, LaneClient(script.url) as client:
        results = iter(client.stream(frames(100)))
        assert told(next(results)) == (0, "lost")
        results.close()


def test_a_key_is_in_the_header_and_in_no_log(stream: Stream, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with scripted(well) as script:
        stream(script.url, frames(1), api_key=KEY)
        # What the service's side of the test logs is its own.
        logged = [record.getMessage() for record in caplog.records if "server" not in record.name]
    assert script.headers[0]["Authorization"] == f"Bearer {KEY}"
    assert not any(KEY in line for line in logged)


def test_requests_go_to_a_replica_that_answers(url: str) -> None:
    with LaneClient([refused_url(), url]) as client:
        assert client.describe().model == "fake 1"
        assert client.detect(fakes.image_file()).width == 320

    async def ask() -> str:
        async with AsyncLaneClient([refused_url(), url]) as client:
            return (await client.describe()).model

    assert asyncio.run(ask()) == "fake 1"
    with LaneClient([refused_url(), refused_url()]) as client, pytest.raises(ConnectionFailedError):
        client.describe()
