"""Sessions that outlive their sockets, over real sockets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import pytest
from redisserver import redis_server
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
                # The other replica notices at its next save, and evicts its socket.
                errors = [message for message in answers(socket, 1) if message["type"] == "error"] or [receive(socket)]
                assert errors[0]["code"] == "evicted"
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
