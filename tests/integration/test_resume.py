"""Sessions that outlive their sockets, over real sockets."""

from __future__ import annotations

import asyncio
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import fakes
import pytest
from redis import Redis
from redisserver import redis_server, running_redis
from tcpproxy import tcp_proxy
from websockets.asyncio.client import ClientConnection as AsyncConnection
from websockets.asyncio.client import connect
from websockets.sync.client import ClientConnection
from wsclient import receive, receive_close, send_message, stream

Serve = Callable[..., str]


def start(socket: ClientConnection, **fields: Any) -> dict[str, Any]:
    send_message(socket, "start", **fields)
    ready = receive(socket)
    assert ready["type"] == "ready", ready
    return ready


def answers(socket: ClientConnection, frames: int) -> list[dict[str, Any]]:
    received = []
    for _ in range(frames):
        socket.send(fakes.image_file())
        received.append(receive(socket))
    return received


def ids(answer: dict[str, Any]) -> list[int]:
    return [lane["track_id"] for lane in answer["lanes"]]


def test_a_session_is_resumed_over_another_socket(url: str) -> None:
    with stream(url) as socket:
        first = start(socket, mode="all", session="front-camera")
        assert (first["session"], first["resumed"], first["last_seq"]) == ("front-camera", False, None)
        before = answers(socket, 4)[-1]
    with stream(url) as socket:
        second = start(socket, mode="all", resume_token=first["resume_token"])
        assert (second["session"], second["resumed"], second["last_seq"]) == ("front-camera", True, 3)
        assert second["resume_token"] == first["resume_token"]
        after = answers(socket, 1)[0]
    assert after["seq"] == 4
    assert after["timestamp"] > before["timestamp"]
    assert ids(after) == ids(before) == [1, 2]
    assert after["lanes"][0]["age_s"] > before["lanes"][0]["age_s"]


def test_an_ended_session_is_not_resumed(url: str) -> None:
    with stream(url) as socket:
        token = start(socket, mode="all")["resume_token"]
        answers(socket, 4)
        send_message(socket, "end")
        assert receive(socket)["type"] == "summary"
        assert receive_close(socket)[0] == 1000
    with stream(url) as socket:
        again = start(socket, mode="all", resume_token=token)
        assert not again["resumed"], "an ended session can't be resumed"
        assert again["resume_token"] != token
        assert answers(socket, 1)[0]["seq"] == 0


def test_a_new_socket_evicts_the_old_one(url: str) -> None:
    with stream(url) as old, stream(url) as new:
        token = start(old, mode="all")["resume_token"]
        answers(old, 3)
        assert start(new, mode="all", resume_token=token)["resumed"]
        error = receive(old)
        assert (error["code"], error["fatal"]) == ("evicted", True)
        assert receive_close(old)[0] == 4001
        assert ids(answers(new, 1)[0]) == [1, 2]


def test_a_frame_in_progress_is_finished_before_the_session_moves(serve: Serve) -> None:
    network = fakes.GatedModel()
    url = serve(fakes.engine(network))
    with stream(url) as old, stream(url) as new:
        token = start(old, mode="all")["resume_token"]
        old.send(fakes.image_file())
        network.wait_for_a_frame()
        send_message(new, "start", mode="all", resume_token=token)
        network.let_through(9)
        ready = receive(new)
        assert (ready["resumed"], ready["last_seq"]) == (True, 0)
        assert answers(new, 1)[0]["seq"] == 1


def test_two_replicas_share_their_sessions_through_redis(serve: Serve, tmp_path: Path) -> None:
    with redis_server(tmp_path) as redis_url:
        one, other = (serve(fakes.engine(), redis_url=redis_url) for _ in range(2))
        with stream(one) as socket:
            first = start(socket, mode="all")
            before = answers(socket, 5)[-1]
        with stream(other) as socket:
            second = start(socket, mode="all", resume_token=first["resume_token"])
            assert (second["session"], second["resumed"], second["last_seq"]) == (first["session"], True, 4)
            assert ids(answers(socket, 1)[0]) == ids(before)
            with stream(one) as third:
                assert start(third, mode="all", resume_token=first["resume_token"])["resumed"]
                # The other replica notices within a second, without any frame.
                assert receive(socket)["code"] == "evicted"
                assert answers(third, 1)[0]["type"] == "lanes"


def test_a_session_can_be_resumed_only_for_a_limited_time(serve: Serve) -> None:
    url = serve(fakes.engine(), resume_s=1.0)
    with stream(url) as socket:
        ready = start(socket)
        assert ready["limits"]["resume_s"] == 1.0
    fakes.pause(1.1)
    with stream(url) as socket:
        assert not start(socket, resume_token=ready["resume_token"])["resumed"]


@pytest.mark.parametrize("limits", [{"handshake_s": 0.2}, {"idle_s": 0.2}])
def test_an_idle_stream_is_closed_and_can_be_resumed(serve: Serve, limits: dict[str, float]) -> None:
    url = serve(fakes.engine(), **limits)
    with stream(url) as socket:
        token = start(socket, mode="all")["resume_token"] if "idle_s" in limits else None
        error = receive(socket)
        assert (error["code"], error["fatal"]) == ("idle", True)
        assert receive_close(socket)[0] == 4002
    if token is not None:
        with stream(url) as socket:
            assert start(socket, mode="all", resume_token=token)["resumed"]


def test_a_frame_in_progress_keeps_a_stream_open(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network), idle_s=0.2)) as socket:
        start(socket, mode="all")
        socket.send(fakes.image_file())
        network.wait_for_a_frame()
        fakes.pause(0.5)
        network.let_through()
        assert receive(socket)["type"] == "lanes"
        assert receive(socket)["code"] == "idle"


def test_a_session_has_a_maximum_age(serve: Serve) -> None:
    url = serve(fakes.engine(), session_s=0.5)
    with stream(url) as socket:
        token = start(socket)["resume_token"]
        error = receive(socket)
        assert (error["code"], error["fatal"]) == ("session_too_old", True)
        assert receive_close(socket)[0] == 4003
    with stream(url) as socket:
        assert not start(socket, resume_token=token)["resumed"]


def test_too_many_frames_per_second_are_refused_one_by_one(serve: Serve) -> None:
    with stream(serve(fakes.engine(), frames_per_s=0.01)) as socket:
        start(socket, mode="all")
        messages = answers(socket, 4)
    assert [message.get("code") for message in messages] == [None] + ["too_fast"] * 3
    assert [message["seq"] for message in messages] == list(range(4))
    assert not any(message.get("fatal") for message in messages)


RACES = 50
UNLIMITED = {"max_sessions": 4 * RACES, "max_sessions_per_caller": 4 * RACES}


async def race(urls: Sequence[str], token: str) -> None:
    """Resumes a session over a socket of each URL at the same instant; exactly one of them must keep it."""
    async with connect(f"{urls[0]}/v1/stream") as one, connect(f"{urls[1]}/v1/stream") as other:
        outcomes = [asyncio.create_task(evicted_or_answered(socket)) for socket in (one, other)]
        for socket in (one, other):
            await socket.send(json.dumps({"type": "start", "mode": "all", "resume_token": token}))
        await asyncio.wait(outcomes, timeout=fakes.WAIT_S, return_when=asyncio.FIRST_COMPLETED)
        assert [task.result() for task in outcomes if task.done()] == ["evicted"], "one of them was evicted"
        winner = one if outcomes[1].done() else other
        await winner.send(fakes.image_file())
        async with asyncio.timeout(fakes.WAIT_S):
            assert sorted(await asyncio.gather(*outcomes)) == ["evicted", "lanes"]


async def evicted_or_answered(socket: AsyncConnection) -> str:
    """Returns the code of the error that ends a stream, or the type of its first message after `ready`."""
    message = json.loads(await socket.recv())
    if message["type"] == "ready":
        assert message["resumed"]
        message = json.loads(await socket.recv())
    return str(message.get("code", message["type"]))


@pytest.mark.parametrize("held", [False, True])
async def test_of_two_sockets_with_one_token_exactly_one_gets_the_session(serve: Serve, held: bool) -> None:
    url = serve(fakes.engine(), max_sessions=9)
    token, *_ = opened(url, 1)
    for _ in range(RACES):
        with ExitStack() as stack:
            if held:
                start(stack.enter_context(stream(url)), mode="all", resume_token=token)
            await race([url.replace("http", "ws")] * 2, token)


@pytest.mark.parametrize("held", [False, True])
async def test_of_two_replicas_with_one_token_exactly_one_gets_the_session(
    serve: Serve, tmp_path: Path, held: bool
) -> None:
    with redis_server(tmp_path) as redis_url, ExitStack() as stack:
        urls = [serve(fakes.engine(), redis_url=redis_url, **UNLIMITED) for _ in range(2)]
        tokens = [token for url in urls for token in opened(url, RACES // 2)]
        if held:
            for token in tokens:
                start(stack.enter_context(stream(urls[0])), mode="all", resume_token=token)
        addresses = [url.replace("http", "ws") for url in urls]
        await asyncio.gather(*(race(addresses, token) for token in tokens))


def resume_everywhere(url: str, tokens: Sequence[str]) -> None:
    """Resumes sessions at once, sends each a frame, and disconnects."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(stream(url)) for _ in tokens]
        for socket, token in zip(sockets, tokens, strict=True):
            send_message(socket, "start", mode="all", resume_token=token)
        for socket in sockets:
            ready = receive(socket)
            assert ready["resumed"], ready
            assert answers(socket, 1)[0]["seq"] == ready["last_seq"] + 1 > 3


def opened(url: str, number: int) -> list[str]:
    """Opens sessions, sends each some frames, and disconnects. Returns their tokens."""
    tokens = []
    for _ in range(number):
        with stream(url) as socket:
            tokens.append(start(socket, mode="all")["resume_token"])
            answers(socket, 4)
    return tokens


def test_sessions_survive_a_restart_of_redis_and_its_idle_timeout(serve: Serve, tmp_path: Path) -> None:
    with running_redis(tmp_path, idle_s=1) as redis:
        url = serve(fakes.engine(), redis_url=redis.url)
        tokens = opened(url, 6)
        fakes.pause(2.5)
        resume_everywhere(url, tokens)
        redis.stop()
        redis.start()
        resume_everywhere(url, tokens)
        redis.stop()
        resume_everywhere(url, tokens)


def test_no_frame_waits_for_a_redis_that_does_not_answer(serve: Serve, tmp_path: Path) -> None:
    with running_redis(tmp_path) as redis, tcp_proxy(redis.port) as proxy:
        url = serve(fakes.engine(), redis_url=f"redis://127.0.0.1:{proxy.port}/0")
        token, *_ = opened(url, 1)
        with stream(url) as camera, proxy.black_hole():
            start(camera, mode="all", resume_token=token)
            slowest = 0.0
            end = time.monotonic() + 3.0
            while time.monotonic() < end:
                began = time.monotonic()
                assert answers(camera, 1)[0]["type"] == "lanes"
                slowest = max(slowest, time.monotonic() - began)
                fakes.pause(0.03)
            assert slowest < 0.5, "a frame takes a few milliseconds, a try of Redis half a second"
            with stream(url) as other:
                began = time.monotonic()
                assert start(other, mode="all", resume_token=token)["resumed"]
                assert time.monotonic() - began < 5.0
                assert receive(camera)["code"] == "evicted"
                assert answers(other, 1)[0]["type"] == "lanes"
        resume_everywhere(url, [token])


def test_a_record_with_nonsense_starts_a_new_session(serve: Serve, tmp_path: Path) -> None:
    with redis_server(tmp_path) as redis_url, Redis.from_url(redis_url) as redis:
        one, other = (serve(fakes.engine(), redis_url=redis_url) for _ in range(2))
        token, *_ = opened(one, 1)
        key = f"lanestream:session:{hashlib.sha256(token.encode()).hexdigest()}"
        record = json.loads(redis.hget(key, "data"))  # type: ignore[arg-type]
        record["state"]["tracker"]["rows"] = [300.0, 300.0, 300.0]
        redis.hset(key, "data", json.dumps(record))
        with stream(other) as socket:
            assert not start(socket, mode="all", resume_token=token)["resumed"]
            assert ids(answers(socket, 1)[0]) == [1, 2]
