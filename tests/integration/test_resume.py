"""Sessions that outlive their sockets, over real ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import pytest
from redisserver import redis_server
from talking import closed, heard, stream, tell
from websockets.sync.client import ClientConnection

Serve = Callable[..., str]


def opened(socket: ClientConnection, **start: Any) -> dict[str, Any]:
    tell(socket, "start", **start)
    ready = heard(socket)
    assert ready["type"] == "ready", ready
    return ready


def answers(socket: ClientConnection, frames: int) -> list[dict[str, Any]]:
    told = []
    for _ in range(frames):
        socket.send(fakes.image_file())
        told.append(heard(socket))
    return told


def ids(answer: dict[str, Any]) -> list[int]:
    return [lane["track_id"] for lane in answer["lanes"]]


def test_a_session_goes_on_over_another_socket(url: str) -> None:
    with stream(url) as socket:
        first = opened(socket, mode="all", session="front-camera")
        assert (first["session"], first["resumed"], first["last_seq"]) == ("front-camera", False, None)
        before = answers(socket, 4)[-1]
    with stream(url) as socket:
        second = opened(socket, mode="all", resume_token=first["resume_token"])
        assert (second["session"], second["resumed"], second["last_seq"]) == ("front-camera", True, 3)
        assert second["resume_token"] == first["resume_token"]
        after = answers(socket, 1)[0]
    assert after["seq"] == 4
    assert after["timestamp"] > before["timestamp"]
    assert ids(after) == ids(before) == [1, 2]
    assert after["lanes"][0]["age_s"] > before["lanes"][0]["age_s"]


def test_ids_go_on_only_in_a_resumed_session(url: str) -> None:
    with stream(url) as socket:
        token = opened(socket, mode="all")["resume_token"]
        answers(socket, 4)
        tell(socket, "end")
        assert heard(socket)["type"] == "summary"
        assert closed(socket)[0] == 1000
    with stream(url) as socket:
        again = opened(socket, mode="all", resume_token=token)
        assert not again["resumed"], "an ended session is over"
        assert again["resume_token"] != token
        assert answers(socket, 1)[0]["seq"] == 0


def test_a_new_socket_evicts_the_old_one(url: str) -> None:
    with stream(url) as old, stream(url) as new:
        token = opened(old, mode="all")["resume_token"]
        answers(old, 3)
        assert opened(new, mode="all", resume_token=token)["resumed"]
        told = heard(old)
        assert (told["code"], told["fatal"]) == ("evicted", True)
        assert closed(old)[0] == 4001
        assert ids(answers(new, 1)[0]) == [1, 2]


def test_a_frame_in_work_is_finished_before_the_session_moves(serve: Serve) -> None:
    network = fakes.GatedNetwork()
    place = serve(fakes.engine(network))
    with stream(place) as old, stream(place) as new:
        token = opened(old, mode="all")["resume_token"]
        old.send(fakes.image_file())
        network.wait_for_a_frame()
        tell(new, "start", mode="all", resume_token=token)
        network.let_through(9)
        ready = heard(new)
        assert (ready["resumed"], ready["last_seq"]) == (True, 0)
        assert answers(new, 1)[0]["seq"] == 1


def test_two_replicas_share_their_sessions_through_redis(serve: Serve, tmp_path: Path) -> None:
    with redis_server(tmp_path) as redis_url:
        one, other = (serve(fakes.engine(), redis_url=redis_url) for _ in range(2))
        with stream(one) as socket:
            first = opened(socket, mode="all")
            before = answers(socket, 5)[-1]
        with stream(other) as socket:
            second = opened(socket, mode="all", resume_token=first["resume_token"])
            assert (second["session"], second["resumed"], second["last_seq"]) == (first["session"], True, 4)
            assert ids(answers(socket, 1)[0]) == ids(before)
            with stream(one) as third:
                assert opened(third, mode="all", resume_token=first["resume_token"])["resumed"]
                # The other replica finds out when it next saves, and lets go.
                told = [message for message in answers(socket, 1) if message["type"] == "error"] or [heard(socket)]
                assert told[0]["code"] == "evicted"
                assert answers(third, 1)[0]["type"] == "lanes"


def test_a_session_can_be_resumed_only_for_a_while(serve: Serve) -> None:
    place = serve(fakes.engine(), resume_s=1.0)
    with stream(place) as socket:
        ready = opened(socket)
        assert ready["limits"]["resume_s"] == 1.0
    fakes.pause(1.1)
    with stream(place) as socket:
        assert not opened(socket, resume_token=ready["resume_token"])["resumed"]


@pytest.mark.parametrize("limits", [{"handshake_s": 0.2}, {"idle_s": 0.2}])
def test_a_silent_stream_is_closed_and_can_be_resumed(serve: Serve, limits: dict[str, float]) -> None:
    place = serve(fakes.engine(), **limits)
    with stream(place) as socket:
        token = opened(socket, mode="all")["resume_token"] if "idle_s" in limits else None
        told = heard(socket)
        assert (told["code"], told["fatal"]) == ("idle", True)
        assert closed(socket)[0] == 4002
    if token is not None:
        with stream(place) as socket:
            assert opened(socket, mode="all", resume_token=token)["resumed"]


def test_a_stream_that_works_is_not_silent(serve: Serve) -> None:
    network = fakes.GatedNetwork()
    with stream(serve(fakes.engine(network), idle_s=0.2)) as socket:
        opened(socket, mode="all")
        socket.send(fakes.image_file())
        network.wait_for_a_frame()
        fakes.pause(0.5)
        network.let_through()
        assert heard(socket)["type"] == "lanes"
        assert heard(socket)["code"] == "idle"


def test_a_session_has_a_longest_life(serve: Serve) -> None:
    place = serve(fakes.engine(), session_s=0.5)
    with stream(place) as socket:
        token = opened(socket)["resume_token"]
        told = heard(socket)
        assert (told["code"], told["fatal"]) == ("session_too_old", True)
        assert closed(socket)[0] == 4003
    with stream(place) as socket:
        assert not opened(socket, resume_token=token)["resumed"]


def test_too_many_frames_a_second_are_refused_one_by_one(serve: Serve) -> None:
    with stream(serve(fakes.engine(), frames_per_s=0.01)) as socket:
        opened(socket, mode="all")
        told = answers(socket, 4)
    assert [message.get("code") for message in told] == [None] + ["too_fast"] * 3
    assert [message["seq"] for message in told] == list(range(4))
    assert not any(message.get("fatal") for message in told)
