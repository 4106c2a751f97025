"""The JavaScript client in Chromium and in Node, with real services in other processes."""

from __future__ import annotations

import base64
import json
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import processes
import pytest
from jsruntimes import Chromium, Node, Runtime
from redisserver import redis_server

from lanestream.keys import new_key

Outcomes = list[Any]


@pytest.fixture(scope="session")
def frames_folder(road_frames: list[bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for index, frame in enumerate(road_frames):
        (folder / f"{index:04}.jpg").write_bytes(frame)
    return folder


@pytest.fixture(scope="session")
def frames_json(road_frames: list[bytes]) -> str:
    return json.dumps([base64.b64encode(frame).decode() for frame in road_frames])


@pytest.fixture
def chromium(request: pytest.FixtureRequest, frames_json: str) -> Chromium:
    return Chromium(request.getfixturevalue("page"), frames_json)


@pytest.fixture(params=["node", "chromium"])
def runtime(request: pytest.FixtureRequest, frames_folder: Path) -> Runtime:
    return Node(frames_folder) if request.param == "node" else request.getfixturevalue("chromium")


def track_ids(outcomes: Outcomes) -> list[set[int]]:
    """Returns the ids of the boundaries in each answer."""
    return [set(outcome[1]) for outcome in outcomes if isinstance(outcome, list)]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
        return port


def test_single_images(runtime: Runtime, service: str, console_errors: list[str]) -> None:
    result = runtime.start("detect", service).result()
    lanes = result["all"]["lanes"]
    assert len(lanes) >= 2
    assert all(lane["ground"] for lane in lanes)
    assert result["all"]["horizon"] == pytest.approx(0.4 * 360, abs=20)
    assert {lane["kind"] for lane in result["edges"]["lanes"]} <= {"road_edge"}
    assert (result["refused"]["code"], result["refused"]["httpStatus"]) == ("bad_image", 415)
    assert (result["wrong"]["code"], result["wrong"]["httpStatus"]) == ("bad_message", 422)
    assert "candidates" in result["detectors"]
    assert result["bottom"] == pytest.approx(lanes[0]["line"]["bottom"], abs=0.1)
    console_errors.clear()  # Chromium logs the two responses with an error


def test_mode_all_answers_every_frame(runtime: Runtime, service: str) -> None:
    result = runtime.start("streamAll", service, count=30).result()
    assert [outcome[0] for outcome in result["outcomes"]] == list(range(30))
    assert result["answers"] == list(range(30))
    assert len(set.intersection(*track_ids(result["outcomes"])[5:])) >= 2
    summary = result["summary"]
    assert summary.pop("duration_s") > 0
    assert summary == {"frames": 30, "answered": 30, "failed": 0, "dropped": 0, "lost": 0}
    assert result["states"] == [["open", None, ""], ["ended", None, ""]]
    assert (result["lastSeq"], result["state"], result["errors"]) == (29, "ended", [])


@pytest.mark.parametrize("runtime", ["node"], indirect=True)
def test_credits_are_respected(runtime: Runtime) -> None:
    with processes.service(credits=1) as (_, url):
        result = runtime.start("streamAll", url, count=20).result()
    assert result["answers"] == list(range(20))
    assert result["errors"] == []


def test_mode_latest_drops_frames_but_not_the_newest(runtime: Runtime, service: str) -> None:
    result = runtime.start("streamLatest", service).result()
    outcomes = result["outcomes"]
    # All that came before the stream was open were replaced by the one after them.
    assert outcomes[:50] == [None] * 50
    answered = [outcome[0] for outcome in outcomes if outcome]
    assert answered[-1] == 100
    assert result["read"] == [50, *answered]
    assert result["dropped"] == result["summary"]["dropped"] == outcomes.count(None)
    assert result["summary"]["frames"] == 101
    assert result["ready"]["mode"] == "latest"


def test_a_malformed_image_fails_alone(runtime: Runtime, service: str) -> None:
    result = runtime.start("streamAll", service, count=10, junk=[3, 7]).result()
    failed = [seq for seq, outcome in enumerate(result["outcomes"]) if outcome == "bad_image"]
    assert failed == [3, 7]
    assert result["answers"] == [0, 1, 2, 4, 5, 6, 8, 9]
    assert [(error["seq"], error["fatal"]) for error in result["errors"]] == [(3, False), (7, False)]
    assert (result["summary"]["answered"], result["summary"]["failed"]) == (8, 2)
    assert result["reconnects"] == 0


def test_200_frames_over_a_connection_that_breaks_three_times(runtime: Runtime, service: str) -> None:
    result = runtime.start("streamAll", service, count=200, breakAfter=[40, 90, 150]).result()
    outcomes = result["outcomes"]
    answered = [outcome[0] for outcome in outcomes if outcome != "lost"]
    lost = [seq for seq, outcome in enumerate(outcomes) if outcome == "lost"]
    assert sorted(answered + lost) == list(range(200))
    assert result["answers"] == answered == sorted(answered)
    # The session had processed them when their answers were on their way.
    assert len(lost) <= 3 * 8
    assert result["reconnects"] == 3
    summary = result["summary"]
    assert (summary["frames"], summary["answered"], summary["lost"]) == (200, len(answered), len(lost))
    assert [state[:2] for state in result["states"][1:3]] == [["reconnecting", None], ["open", True]]
    assert len(set.intersection(*track_ids(outcomes)[5:])) >= 2


@pytest.mark.parametrize(("runtime", "mode"), [("node", "all"), ("chromium", "latest")], indirect=["runtime"])
def test_a_killed_service_that_comes_back_has_a_new_session(
    runtime: Runtime, console_errors: list[str], mode: str
) -> None:
    port = free_port()
    with processes.service(port) as (process, url):
        scenario = runtime.start("streamUntilStopped", url, mode=mode, options={"reconnectS": 60})
        scenario.wait_for("answer", 10)
        process.kill()
        scenario.wait_for(["reconnecting", None])
    with processes.service(port):
        scenario.wait_for(["open", False])
        scenario.wait_for("answer", 5)
        scenario.stop()
        result = scenario.result()
    assert result["reconnects"] == 1
    assert result["ready"]["resumed"] is False
    assert result["summary"]["lost"] == 0
    if mode == "all":
        assert [outcome[0] for outcome in result["outcomes"]] == list(range(len(result["outcomes"])))
    console_errors.clear()  # Chromium logs each handshake that fails


@pytest.mark.parametrize(
    ("runtime", "how"),
    [("node", signal.SIGTERM), ("chromium", signal.SIGTERM), ("chromium", signal.SIGKILL)],
    indirect=["runtime"],
)
def test_track_ids_survive_the_end_of_a_replica(
    runtime: Runtime, tmp_path: Path, console_errors: list[str], how: signal.Signals
) -> None:
    with (
        redis_server(tmp_path) as redis_url,
        processes.service(redis_url=redis_url) as (first, first_url),
        processes.service(redis_url=redis_url, allowed_origins=first_url) as (_, second_url),
    ):
        scenario = runtime.start("streamUntilStopped", [first_url, second_url], mode="all")
        scenario.wait_for("answer", 20)
        first.send_signal(how)
        if how == signal.SIGTERM:
            scenario.wait_for("draining")
        scenario.wait_for(["open", True])
        scenario.wait_for("answer", 5)
        scenario.stop()
        result = scenario.result()
    ids = track_ids(result["outcomes"])
    assert len(ids[19] & ids[-1]) >= 2
    assert result["summary"]["frames"] == len(result["outcomes"])
    assert {outcome for outcome in result["outcomes"] if isinstance(outcome, str)} <= {"lost"}
    console_errors.clear()


@pytest.fixture(scope="module")
def key_service() -> Iterator[tuple[str, str]]:
    key, stored = new_key("camera")
    with processes.service(api_keys=stored) as (_, url):
        yield url, key


def test_a_wrong_key_is_explained(runtime: Runtime, key_service: tuple[str, str], console_errors: list[str]) -> None:
    url, _ = key_service
    for options, message in (({"apiKey": "wrong"}, "unknown"), ({}, "required")):
        result = runtime.start("fail", url, options=options).result()
        for error in (result["frame"], result["end"], result["detect"], result["errors"][0]):
            assert (error["code"], error["httpStatus"]) == ("unauthorized", 401)
            assert message in error["message"]
            assert error["hint"]
        assert result["state"] == "failed"
        assert len(result["states"]) == 1
    console_errors.clear()


def test_tokens(runtime: Runtime, key_service: tuple[str, str]) -> None:
    url, key = key_service
    headers = {"Authorization": f"Bearer {key}"}
    tokens = [httpx.post(f"{url}/v1/tokens", headers=headers).json()["token"] for _ in range(2)]
    result = runtime.start("streamWithTokens", url, tokens=tokens).result()
    assert result["used"] == 2
    assert [result["first"][0], result["second"][0]] == [0, 1]
    assert result["states"][-2] == ["open", True, ""]


def test_a_service_that_is_not_there(runtime: Runtime, service: str, console_errors: list[str]) -> None:
    gone = f"http://127.0.0.1:{free_port()}"
    result = runtime.start("fail", gone, page_url=service, options={"reconnectS": 0.5}).result()
    assert result["frame"]["code"] == "connection_failed"
    assert "can't be reached" in result["frame"]["message"]
    assert result["states"][0][:2] == ["connecting", None]
    assert result["state"] == "failed"
    console_errors.clear()


def test_an_evicted_stream_does_not_come_back(runtime: Runtime, service: str) -> None:
    result = runtime.start("evict", service).result()
    assert result["resumed"] is True
    assert (result["failed"], result["state"], result["reconnects"]) == ("evicted", "failed", 0)


def test_a_restart_keeps_the_tracks(runtime: Runtime, service: str) -> None:
    result = runtime.start("restart", service).result()
    assert result["states"][1:3] == [
        ["reconnecting", None, "the stream was restarted with other options"],
        ["open", True, ""],
    ]
    before, after = track_ids(result["before"]), track_ids(result["after"])
    assert after
    assert len(before[-1] & after[-1]) >= 2
    assert result["errors"] == [] or {error["code"] for error in result["errors"]} == {"lost"}


def test_options_that_are_not_valid_end_the_stream_at_once(runtime: Runtime, service: str) -> None:
    result = runtime.start("badStart", service).result()
    assert (result["end"]["code"], result["state"]) == ("bad_message", "failed")
    assert "horizon" in result["end"]["message"]


def test_a_page_of_another_origin_learns_what_to_check(
    chromium: Chromium, service: str, key_service: tuple[str, str], console_errors: list[str]
) -> None:
    page_url, _ = key_service
    result = chromium.start("fail", service, page_url=page_url, options={"reconnectS": 0.5}).result()
    assert result["frame"]["code"] == "connection_failed"
    assert f"LANESTREAM_ALLOWED_ORIGINS has {page_url}" in result["frame"]["hint"]
    console_errors.clear()


def test_a_page_of_an_allowed_origin(chromium: Chromium, service: str) -> None:
    with processes.service(allowed_origins=service) as (_, url):
        result = chromium.start("streamAll", url, page_url=service, count=5).result()
    assert result["answers"] == list(range(5))
