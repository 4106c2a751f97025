"""Streams over real sockets, message by message."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fakes
import httpx
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from wsclient import receive, receive_close, send_message, stream, wait_until_read, wait_until_released

from lanestream.api import websocket
from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.errors import WorkerLostError
from lanestream.road.view import Image
from lanestream.workers.thread_pool import ThreadPool

Serve = Callable[..., str]
README = Path(__file__).parents[2] / "README.md"


def test_the_five_lines_of_the_readme(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "road.jpg").write_bytes(fakes.image_file())
    section = README.read_text().partition("## A client in five lines")[2]
    code = re.findall(r"```python\n(.*?)```", section, re.DOTALL)[0]
    assert len([line for line in code.splitlines() if line]) <= 5
    code = code.replace("ws://127.0.0.1:8000", url.replace("http", "ws")).replace("road.jpg", f"{tmp_path}/road.jpg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # the five lines do not close the file
        exec(code, {})  # noqa: S102
    assert [lane["position"] for lane in json.loads(capsys.readouterr().out)["lanes"]] == [-1, 1]


@pytest.mark.parametrize(
    ("offered", "selected"), [(None, None), (["lanestream.v1"], "lanestream.v1"), (["other"], None)]
)
def test_the_subprotocol_is_selected_if_it_is_offered(url: str, offered: Any, selected: str | None) -> None:
    with connect(f"{url.replace('http', 'ws')}/v1/stream", subprotocols=offered) as socket:
        assert socket.subprotocol == selected
        assert socket.protocol.extensions == [], "compression is offered and must be declined"


def test_ready_reports_the_network_and_the_limits(url: str) -> None:
    with stream(url) as socket:
        send_message(socket, "start", mode="all")
        ready = receive(socket)
    assert len(ready.pop("session")) == 16
    assert len(ready.pop("resume_token")) >= 32
    assert ready == {
        "type": "ready",
        "resumed": False,
        "last_seq": None,
        "mode": "all",
        "detector": "candidates",
        "model": "fake 1",
        "provider": "cpu",
        "limits": {
            "max_bytes": 200_000,
            "max_pixels": 4096 * 2304,
            "credits": 8,
            "frames_per_s": 240.0,
            "bytes_per_s": 256e6,
            "idle_s": 60.0,
            "session_s": 86_400.0,
            "resume_s": 60.0,
        },
    }


def test_missing_numbers_and_times_are_assigned(url: str) -> None:
    with stream(url, mode="all") as socket:
        for announced in ({}, {"seq": 7, "timestamp": 3.5}, {"timestamp": -2.0}, {"seq": 3}):
            if announced:
                send_message(socket, "frame", **announced)
            socket.send(fakes.image_file())
        messages = [receive(socket) for _ in range(5)]
    # The times run backwards, which is warned of.
    answers = [message for message in messages if message["type"] == "lanes"]
    assert [answer["seq"] for answer in answers] == [0, 7, 8, 3]
    assert [answer["timestamp"] for answer in answers[1:3]] == [3.5, -2.0]
    assert all(0.0 <= answers[i]["timestamp"] < 60.0 for i in (0, 3)), "seconds since the stream was opened"


@pytest.mark.parametrize(
    ("timestamps", "code"),
    [
        ([1000.0, 1040.0, 1080.0, 1120.0, 1160.0, 1200.0], "timestamps_in_milliseconds"),
        ([1.0, 1.0, 1.0, 1.04], "timestamps_not_advancing"),
        ([2.0, 1.0, 0.5], "timestamps_not_advancing"),
    ],
)
def test_implausible_timestamps_are_warned_of_once(
    serve: Serve, monkeypatch: pytest.MonkeyPatch, timestamps: list[float], code: str
) -> None:
    logged: list[str] = []
    monkeypatch.setattr(websocket._log, "warning", lambda text, *values, **_: logged.append(text % values))
    url = serve(fakes.engine())
    with stream(url, mode="all") as socket:
        for timestamp in timestamps:
            send_message(socket, "frame", timestamp=timestamp)
            socket.send(fakes.image_file())
        send_message(socket, "end")
        answers = []
        while not answers or answers[-1]["type"] != "summary":
            answers.append(receive(socket))
    assert [answer["seq"] for answer in answers if answer["type"] == "lanes"] == list(range(len(timestamps)))
    (warning,) = [answer for answer in answers if answer["type"] == "warning"]
    assert warning["code"] == code
    assert logged == [warning["message"]]
    metrics = httpx.get(f"{url}/metrics").text
    assert f'lane_timestamp_warnings_total{{code="{code}"}} 1.0' in metrics


def test_departures_are_reported_with_a_camera(serve: Serve) -> None:
    """The vehicle drifts to the right at half a meter per second; the same with its indicator on is intended."""
    camera = {"height": 1.4, "field_of_view": 62.0}
    options: list[tuple[dict[str, Any], dict[str, Any]]] = [
        ({}, {}),
        ({}, {"speed": 30.0, "indicator": "right"}),
        ({}, {"speed": 3.0}),
        ({"least_speed": 2.0}, {"speed": 3.0}),
    ]
    warned = []
    for departure, motion in options:
        url = serve(fakes.drifting_engine())
        with stream(url, mode="all", camera=camera, departure=departure) as socket:
            answers = []
            for frame in range(80):
                send_message(socket, "frame", timestamp=0.04 * frame, **motion)
                socket.send(fakes.image_file())
                answers.append(receive(socket))
        assert answers[40]["departure"]["state"] == "none"
        assert answers[60]["ego"]["lateral_speed"] == pytest.approx(0.5, abs=0.1)
        events = [event for answer in answers for event in answer["events"] if event["type"] == "departure"]
        assert {event["side"] for event in events} <= {"right"}
        warned.append([event["state"] for event in events])
    assert warned == [["warning", "crossed"], [], [], ["warning", "crossed"]]


def test_end_answers_the_frames_held_then_sends_the_summary_and_closes(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network)), mode="all") as socket:
        for _ in range(3):
            socket.send(fakes.image_file())
        socket.send(b"no image")
        send_message(socket, "end")
        wait_until_read(socket)
        network.let_through(3)
        assert [receive(socket)["seq"] for _ in range(4)] == [0, 1, 2, 3]
        summary = receive(socket)
        assert summary.pop("duration_s") >= 0.0
        assert summary == {"type": "summary", "frames": 4, "answered": 3, "failed": 1, "dropped": 0}
        assert receive_close(socket) == (1000, "")


def test_a_stream_may_end_without_a_frame(url: str) -> None:
    with stream(url) as socket:
        send_message(socket, "end")
        assert receive(socket)["frames"] == 0
        assert receive_close(socket)[0] == 1000


BAD_FRAMES = [
    b"",
    b"some text, sent as a frame",
    fakes.image_file()[:2000],
    fakes.image_file()[:200] + bytes([255, 7]) * 300 + fakes.image_file()[800:],
    fakes.image_file(".png", 1, 1),
    fakes.image_file(".png", 8000, 1200, 0),
    fakes.image_file(shade=255),
]
BAD_CODES = ["bad_image"] * 5 + ["image_too_large", "internal"]


def test_an_invalid_frame_affects_no_other_frame(url: str) -> None:
    with stream(url, mode="all") as socket:
        for seq, (data, code) in enumerate(zip(BAD_FRAMES, BAD_CODES, strict=True)):
            socket.send(data)
            error = receive(socket)
            assert (error["type"], error["seq"], error["code"], error["fatal"]) == ("error", seq, code, False)
        socket.send(fakes.image_file())
        assert receive(socket)["seq"] == len(BAD_FRAMES)


BAD_TEXTS = [
    "",
    "hello",
    "[]",
    "{}",
    '{"type": "stop"}',
    '{"type": "start", "mode": "some"}',
    '{"type": "start", "horizon": 1.5}',
    '{"type": "start", "horizon": -0.61}',
    '{"type": "start", "detector": "guesses"}',
    '{"type": "start", "speed": 1}',
    '{"type": "frame", "seq": -1}',
    '{"type": "frame", "seq": 9007199254740992}',
    '{"type": "frame", "timestamp": 1e400}',
    '{"type": "frame", "timestamp": 1e300}',
    '{"type": "frame", "timestamp": NaN}',
    '{"type": "frame", "speed": -1}',
    '{"type": "frame", "speed": 400}',
    '{"type": "frame", "speed": NaN}',
    '{"type": "frame", "indicator": "both"}',
    '{"type": "start", "departure": {"vehicle_width": 9}}',
    '{"type": "start", "departure": {"warning_s": -1}}',
    '{"type": "start", "departure": {"lateness": 1}}',
    "[" * 65_000,
    json.dumps({"type": "start", "a\nkey": 1}),
    json.dumps({"type": "start", "k" * 65_000: 1}),
    json.dumps({"type": "start"} | {f"k{number}": 1 for number in range(5000)}),
    json.dumps({"type": "a\nkind" * 9000}),
]


def test_an_invalid_text_message_is_reported_and_has_no_effect(url: str) -> None:
    with stream(url) as socket:
        for text in BAD_TEXTS:
            socket.send(text)
            error = receive(socket)
            assert (error["type"], error["code"], error["fatal"]) == ("error", "bad_message", False)
            assert error["message"]
            assert "\n" not in error["message"]
            assert len(error["message"]) < 400, "the invalid message is not quoted in full"
        socket.send(fakes.image_file())
        assert receive(socket)["seq"] == 0


@pytest.mark.parametrize(
    ("start", "expected", "positions"),
    [
        ({}, ("candidates", "fake 1"), [-1, 1]),
        ({"detector": "candidates"}, ("candidates", "fake 1"), [-1, 1]),
        ({"detector": None}, ("candidates", "fake 1"), [-1, 1]),
        ({"detector": "regression"}, ("regression", "other 2"), [-1]),
    ],
)
def test_the_requested_detector_is_used(
    both_url: str, start: dict[str, Any], expected: tuple[str, str], positions: list[int]
) -> None:
    with stream(both_url) as socket:
        send_message(socket, "start", mode="all", **start)
        ready = receive(socket)
        assert (ready["detector"], ready["model"]) == expected
        socket.send(fakes.image_file())
        assert [lane["position"] for lane in receive(socket)["lanes"]] == positions


def test_a_detector_that_is_not_loaded_is_reported_and_has_no_effect(url: str) -> None:
    with stream(url) as socket:
        send_message(socket, "start", mode="all", detector="regression")
        refused = receive(socket)
        assert (refused["type"], refused["code"], refused["fatal"]) == ("error", "no_detector", False)
        assert (refused["message"], refused["hint"]) == ("there is no detector regression here", "ask for candidates")
        send_message(socket, "start", mode="all", detector="candidates")
        assert receive(socket)["type"] == "ready"
        send_message(socket, "start", detector="regression")
        socket.send(fakes.image_file())
        assert [receive(socket)[key] for key in ("code", "seq")] == ["no_detector", 0]
    with stream(url) as socket:
        send_message(socket, "start", detector="regression")
        socket.send(fakes.image_file())
        assert receive(socket)["code"] == "no_detector"
        assert len(receive(socket)["lanes"]) == 2, "a first image opens the stream with the defaults"


def test_the_only_detector_is_the_default(serve: Serve) -> None:
    with stream(serve(fakes.left_engine())) as socket:
        send_message(socket, "start", detector="candidates")
        assert receive(socket)["hint"] == "ask for regression"
        send_message(socket, "start")
        assert receive(socket)["detector"] == "regression"


def test_a_message_that_is_not_allowed_is_reported(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network))) as socket:
        socket.send(fakes.image_file())
        send_message(socket, "start")
        assert "already open" in receive(socket)["message"]
        send_message(socket, "end")
        send_message(socket, "end")
        assert "after `end`" in receive(socket)["message"]
        socket.send(fakes.image_file())
        assert "after `end`" in receive(socket)["message"]
        network.let_through()
        assert receive(socket)["type"] == "lanes"
        assert receive(socket)["frames"] == 1


def test_an_overrun_in_mode_all_ends_the_stream(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network), credits=2), mode="all") as socket:
        for _ in range(3):
            socket.send(fakes.image_file())
        error = receive(socket)
        network.let_through()
        assert (error["type"], error["code"], error["fatal"]) == ("error", "overrun", True)
        assert receive_close(socket) == (1008, error["message"])


def test_an_answer_renews_the_credit(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network), credits=1), mode="all") as socket:
        network.let_through(50)
        for seq in range(50):
            socket.send(fakes.image_file())
            assert receive(socket)["seq"] == seq


def test_newer_frames_replace_waiting_ones_in_mode_latest(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network))) as socket:
        socket.send(fakes.image_file())
        network.wait_for_a_frame()
        for _ in range(5):
            socket.send(fakes.image_file())
        wait_until_read(socket)
        network.let_through(2)
        answers = [receive(socket) for _ in range(2)]
        assert [(answer["seq"], answer["dropped"]) for answer in answers] == [(0, 4), (5, 4)]
        send_message(socket, "end")
        assert receive(socket)["dropped"] == 4


def test_pings_are_answered_while_the_network_runs(serve: Serve) -> None:
    network = fakes.GatedModel()
    with stream(serve(fakes.engine(network))) as socket:
        for _ in range(20):
            socket.send(fakes.image_file())
        network.wait_for_a_frame()
        assert socket.ping().wait(fakes.WAIT_S)
        network.let_through(2)


def test_an_image_above_the_size_limit_fails_and_a_far_larger_one_closes_the_socket(url: str) -> None:
    with stream(url, mode="all") as socket:
        socket.send(bytes(200_001))
        error = receive(socket)
        assert (error["code"], error["seq"], error["fatal"]) == ("image_too_large", 0, False)
        socket.send(fakes.image_file())
        assert receive(socket)["seq"] == 1
        socket.send(bytes(400_001))
        assert receive_close(socket)[0] == 1009


def test_an_image_may_be_fragmented(url: str) -> None:
    image = fakes.image_file()
    with stream(url, mode="all") as socket:
        socket.send([image[:100], b"", image[100:200], image[200:]])
        assert receive(socket)["type"] == "lanes"


def test_a_text_message_that_is_not_utf_8_ends_the_stream(url: str) -> None:
    with stream(url, mode="all") as socket:
        socket.send(b"\xff\xfe", text=True)
        assert receive_close(socket)[0] == 1007


def test_a_stream_above_the_limit_is_refused_until_another_ends(serve: Serve) -> None:
    url = serve(fakes.engine(), max_sessions=1)
    with stream(url, mode="all") as first:
        with stream(url) as second:
            second.send(fakes.image_file())
            error = receive(second)
            assert (error["code"], error["fatal"]) == ("busy", True)
            assert receive_close(second)[0] == 1013
        send_message(first, "end")
        assert receive(first)["type"] == "summary"
        with stream(url, mode="all"):
            pass


def test_a_client_that_disconnects_during_a_frame_releases_its_session(serve: Serve) -> None:
    network = fakes.GatedModel()
    url = serve(fakes.engine(network), max_sessions=1)
    with stream(url, mode="all") as socket:
        socket.send(fakes.image_file())
        network.wait_for_a_frame()
    network.let_through(2)
    wait_until_released(url)
    with stream(url) as second:
        second.send(fakes.image_file())
        assert receive(second)["type"] == "lanes"


def test_a_stream_is_refused_while_the_network_is_being_loaded(serve: Serve) -> None:
    with pytest.raises(InvalidStatus) as refused, stream(serve()):
        pass
    assert refused.value.response.status_code == 503
    assert json.loads(refused.value.response.body)["code"] == "not_ready"


def test_streams_with_different_detectors_run_concurrently(both_url: str) -> None:
    with stream(both_url, mode="all") as one, stream(both_url, mode="all", detector="regression") as other:
        for seq in range(6):
            one.send(fakes.image_file())
            other.send(fakes.image_file())
            for socket, tracks in ((one, [1, 2]), (other, [1])):
                answer = receive(socket)
                assert answer["seq"] == seq
                assert [lane["track_id"] for lane in answer["lanes"]] == tracks


def test_streams_do_not_affect_each_other(url: str) -> None:
    small, large = fakes.image_file(), fakes.image_file(width=640, height=360)
    with stream(url, mode="all") as one, stream(url, mode="all", horizon=0.3) as other:
        for seq in range(6):
            one.send(small)
            other.send(large)
            for socket, width, horizon in ((one, 320, 0.4 * 180), (other, 640, 0.3 * 360)):
                answer = receive(socket)
                assert (answer["seq"], answer["width"]) == (seq, width)
                assert answer["horizon"] == pytest.approx(horizon, abs=0.5), "half a pixel of a resized image"
                assert [lane["track_id"] for lane in answer["lanes"]] == [1, 2]


class LosingDetector(fakes.FakeDetector):
    """Reports dark frames as the cause of the loss of a worker process."""

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        if image.mean() < 10.0:
            raise WorkerLostError("the process that had the frame has ended")
        return super().detect(image, context, infer)


def test_a_stream_whose_frames_cost_several_workers_is_ended_for_good(serve: Serve) -> None:
    url = serve(fakes.engine(detector=LosingDetector()))
    with stream(url) as socket:
        send_message(socket, "start", mode="all")
        token = receive(socket)["resume_token"]
        for shade in (0, 128, 0):
            socket.send(fakes.image_file(shade=shade))
        answers = [receive(socket) for _ in range(3)]
        assert [answer.get("code", "lanes") for answer in answers] == ["worker_lost", "lanes", "worker_lost"]
        assert not any(answer.get("fatal") for answer in answers)
        socket.send(fakes.image_file(shade=0))
        last = receive(socket)
        assert (last["code"], last["fatal"]) == ("worker_lost", True)
        assert receive_close(socket)[0] == 1013
    with stream(url) as socket:
        send_message(socket, "start", resume_token=token)
        assert receive(socket)["resumed"] is False


def test_a_service_that_can_no_longer_replace_its_workers_says_that_it_needs_a_restart(
    serve: Serve, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = serve(fakes.engine())
    assert httpx.get(f"{url}/healthz").status_code == 200
    monkeypatch.setattr(ThreadPool, "upkeep_failed", True)
    response = httpx.get(f"{url}/healthz")
    assert (response.status_code, response.json()["code"]) == (503, "not_ready")
