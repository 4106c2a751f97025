"""Streams whose connections break, are refused or drained: both clients against a scripted service."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterator
from typing import Any

import fakes
import pytest
from scripted import ScriptedConnection, refused_url, scripted

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
from lanestream_client.endpoint import parse_endpoints
from lanestream_client.failover import FailoverPolicy, RetryPolicy
from lanestream_client.requests import start_message

KEY = "hidden-key"

Outcomes = list[tuple[int, str]]
StreamRun = tuple[Outcomes, Any, LanestreamError | None]
RunStream = Callable[..., StreamRun]


def frames(count: int) -> Iterator[SourceFrame]:
    return (SourceFrame(seq, 0.04 * seq, data=b"image") for seq in range(count))


def outcome(result: StreamResult) -> tuple[int, str]:
    """Returns the frame's number and the error's code, or `lanes`."""
    return result.frame.seq, result.error.code if result.error else "lanes"


def run_blocking(url: Any, source: Any, *, in_flight: int = 1, mode: Any = "all", **more: Any) -> StreamRun:
    results: Outcomes = []
    with LaneClient(url, in_flight=in_flight, **more) as client:
        stream = client.stream(source, mode=mode)
        try:
            results += map(outcome, stream)  # keeps the results before an error
        except LanestreamError as error:
            return results, stream, error
    return results, stream, None


def run_async(url: Any, source: Any, *, in_flight: int = 1, mode: Any = "all", **more: Any) -> StreamRun:
    async def run() -> StreamRun:
        results: Outcomes = []
        async with AsyncLaneClient(url, in_flight=in_flight, **more) as client:
            stream = client.stream(source, mode=mode)
            try:
                async for result in stream:
                    results.append(outcome(result))
            except LanestreamError as error:
                return results, stream, error
        return results, stream, None

    return asyncio.run(run())


@pytest.fixture(params=[run_blocking, run_async], ids=["blocking", "async"])
def run_stream(request: pytest.FixtureRequest) -> RunStream:
    """Streams a source with one of the two clients: returns the outcomes, the stream, and the error that ended it."""
    run: RunStream = request.param
    return run


def all_lanes(count: int) -> Outcomes:
    return [(seq, "lanes") for seq in range(count)]


def healthy(connection: ScriptedConnection) -> None:
    connection.open()
    connection.finish()


def breaking_after_one_frame(connection: ScriptedConnection) -> None:
    connection.open()
    connection.receive_frame()
    connection.break_off()


def test_in_mode_all_a_broken_connection_costs_only_the_results_of_processed_frames(run_stream: RunStream) -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open()
        assert [connection.receive_frame() for _ in range(3)] == [0, 1, 2]
        connection.send_lanes(0)
        assert connection.receive_frame() == 3
        connection.break_off()

    def resumed(connection: ScriptedConnection) -> None:
        connection.open(resumed=True, last_seq=1)
        assert [connection.receive_frame() for _ in range(2)] == [2, 3]
        connection.send_lanes(2, 3)
        connection.finish()

    with scripted(breaking, resumed) as script:
        results, stream, error = run_stream(script.url, frames(9), in_flight=3)
    assert error is None
    assert results == [(0, "lanes"), (1, "lost"), *all_lanes(9)[2:]]
    assert [start.get("resume_token") for start in script.starts] == [None, "secret"]
    assert stream.reconnects == 1
    assert stream.ready.resumed
    total = stream.summary
    assert (total.frames, total.answered, total.lost, total.failed, total.dropped) == (9, 8, 1, 0, 0)


def test_in_mode_latest_frames_in_flight_are_lost(run_stream: RunStream) -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open(mode="latest")
        assert [connection.receive_frame() for _ in range(2)] == [0, 1]
        connection.break_off()

    with scripted(breaking, healthy) as script:
        results, stream, error = run_stream(script.url, frames(5), in_flight=2, mode="latest")
    assert error is None
    assert results == [(0, "lost"), (1, "lost"), (2, "lanes"), (3, "lanes"), (4, "lanes")]
    assert stream.summary.lost == 2


def test_a_draining_service_hands_over_to_the_next(run_stream: RunStream) -> None:
    def draining(connection: ScriptedConnection) -> None:
        connection.open()
        assert [connection.receive_frame() for _ in range(3)] == [0, 1, 2]
        connection.drain()
        connection.send_lanes(0)
        connection.send_error(DrainingError("too late"), 1)
        connection.close(1012)

    def resumed(connection: ScriptedConnection) -> None:
        connection.open(resumed=True, last_seq=0)
        connection.finish()

    with scripted(draining) as one, scripted(resumed) as other:
        results, stream, error = run_stream([one.url, other.url], frames(6), in_flight=3)
        assert other.starts[0]["resume_token"] == "later"  # noqa: S105
    assert error is None
    assert results == all_lanes(6)
    assert stream.summary.lost == 0


@pytest.mark.parametrize(
    "refusal", [BusyError("m"), DrainingError("m"), NotReadyError("m")], ids=["busy", "draining", "not_ready"]
)
def test_a_temporary_refusal_is_retried(run_stream: RunStream, refusal: LanestreamError) -> None:
    def refusing_after_the_handshake(connection: ScriptedConnection) -> None:
        connection.send_error(refusal)
        connection.close(1013)

    with scripted(breaking_after_one_frame, refusal, refusing_after_the_handshake, healthy) as script:
        results, stream, error = run_stream(script.url, frames(3))
    assert (results, error, stream.reconnects) == (all_lanes(3), None, 1)


def test_an_idle_stream_is_opened_again(run_stream: RunStream) -> None:
    def idle(connection: ScriptedConnection) -> None:
        connection.open()
        connection.send_lanes(connection.receive_frame())
        connection.send_error(IdleError("no frames"))
        connection.close(4002)

    def resumed(connection: ScriptedConnection) -> None:
        connection.open(resumed=True, last_seq=0)
        connection.finish()

    with scripted(idle, resumed) as script:
        results, _, error = run_stream(script.url, frames(4))
    assert (results, error) == (all_lanes(4), None)


@pytest.mark.parametrize("kind", [EvictedError, TooOldError, OverrunError, NoDetectorError])
def test_a_permanent_error_is_raised_after_the_lost_results(run_stream: RunStream, kind: type[LanestreamError]) -> None:
    def ending(connection: ScriptedConnection) -> None:
        connection.open()
        connection.send_lanes(connection.receive_frame())
        connection.receive_frame()
        connection.send_error(kind("the reason"))
        connection.close(4001)

    with scripted(ending) as script:
        results, stream, error = run_stream(script.url, frames(2))
    assert type(error) is kind
    assert results == [(0, "lanes"), (1, "lost")]
    assert (stream.summary.frames, stream.summary.lost) == (2, 1)


@pytest.mark.parametrize("kind", [UnauthorizedError, ForbiddenError])
def test_a_rejected_caller_gets_the_error_without_a_retry(run_stream: RunStream, kind: type[LanestreamError]) -> None:
    with scripted(kind("no")) as script:
        results, _, error = run_stream(script.url, frames(1))
        assert (results, type(error)) == ([], kind)
    with scripted(breaking_after_one_frame, kind("no")) as script:
        results, _, error = run_stream(script.url, frames(1))
        assert (results, type(error)) == ([(0, "lost")], kind)


def test_without_reconnecting_the_first_loss_ends_the_stream(run_stream: RunStream) -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open()
        connection.receive_frame()
        connection.close(1012)

    with scripted(breaking) as script:
        results, stream, error = run_stream(script.url, frames(3), reconnect_s=0.0)
    assert isinstance(error, ConnectionFailedError)
    assert "code 1012" in str(error)
    assert results[0] == (0, "lost")
    assert stream.summary.answered == 0


def test_a_stream_gives_up_after_the_total_retry_time(run_stream: RunStream) -> None:
    with scripted(breaking_after_one_frame, refuse_later=NotReadyError("starting")) as script:
        results, stream, error = run_stream(script.url, [b"image"], reconnect_s=0.2)
    # The end of the retry time may cut the last attempt short.
    assert isinstance(error, NotReadyError | ConnectionFailedError)
    assert results == [(0, "lost")]
    assert stream.summary.lost == 1


def test_a_replica_that_refuses_connections_is_skipped(run_stream: RunStream) -> None:
    with scripted(breaking_after_one_frame, healthy) as script:
        results, _, error = run_stream([refused_url(), script.url, refused_url()], frames(3))
    assert (results, error) == (all_lanes(3), None)
    _, _, error = run_stream([refused_url(), refused_url()], frames(3))
    assert isinstance(error, ConnectionFailedError)


@pytest.mark.parametrize("use_async", [False, True], ids=["blocking", "async"])
def test_a_replica_that_never_answers_is_skipped(use_async: bool) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as silent,
        scripted(breaking_after_one_frame, NotReadyError("starting")) as one,
        scripted(healthy) as other,
    ):
        silent_url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        endpoints = parse_endpoints([one.url, silent_url, other.url])
        failover = FailoverPolicy(endpoints, RetryPolicy(attempt_s=0.1), 10.0)
        protocol = ClientProtocol(start_message("all", None, None, None, None, None, None))
        if use_async:
            results = asyncio.run(collect(AsyncLaneStream(failover, async_frames(frames(3)), protocol)))
        else:
            results = list(map(outcome, LaneStream(failover, frames(3), protocol)))
    assert results == all_lanes(3)


async def async_frames(source: Iterator[SourceFrame]) -> Any:
    for frame in source:
        yield frame


async def collect(results: AsyncLaneStream) -> Outcomes:
    return [outcome(result) async for result in results]


def test_a_connection_lost_after_the_last_result_costs_nothing(run_stream: RunStream) -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open()
        connection.send_lanes(connection.receive_frame(), connection.receive_frame())
        assert connection.receive_frame() == -1
        connection.break_off()

    with scripted(breaking) as script:
        results, stream, error = run_stream(script.url, frames(2), in_flight=2)
    assert (results, error, stream.reconnects) == (all_lanes(2), None, 0)
    assert stream.summary.answered == 2


def test_a_source_error_between_two_connections_is_raised_at_the_end(run_stream: RunStream) -> None:
    def failing() -> Iterator[SourceFrame]:
        yield from frames(2)
        raise SourceError("the cable is unplugged")

    def breaking(connection: ScriptedConnection) -> None:
        connection.open()
        connection.send_lanes(connection.receive_frame())
        assert connection.receive_frame() == 1
        connection.break_off()

    with scripted(breaking, healthy) as script:
        results, _, error = run_stream(script.url, failing())
    assert results == all_lanes(2)
    assert isinstance(error, SourceError)


def test_a_stream_can_be_closed_while_it_has_no_connection() -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open(mode="latest")
        connection.receive_frame()
        connection.break_off()

    with scripted(breaking) as script, LaneClient(script.url) as client:
        results = iter(client.stream(frames(100)))
        assert outcome(next(results)) == (0, "lost")
        results.close()


def test_a_key_is_in_the_header_and_not_in_the_logs(run_stream: RunStream, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with scripted(healthy) as script:
        run_stream(script.url, frames(1), api_key=KEY)
        # The service's side of this test may log headers.
        logged = [record.getMessage() for record in caplog.records if "server" not in record.name]
    assert script.headers[0]["Authorization"] == f"Bearer {KEY}"
    assert not any(KEY in line for line in logged)


def test_requests_go_to_the_first_replica_that_answers(url: str) -> None:
    with LaneClient([refused_url(), url]) as client:
        assert client.describe().model == "fake 1"
        assert client.detect(fakes.image_file()).width == 320

    async def describe() -> str:
        async with AsyncLaneClient([refused_url(), url]) as client:
            return (await client.describe()).model

    assert asyncio.run(describe()) == "fake 1"
    with LaneClient([refused_url(), refused_url()]) as client, pytest.raises(ConnectionFailedError):
        client.describe()
