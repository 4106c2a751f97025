"""Live cameras on real sockets: MJPEG over HTTP and RTSP over TCP and UDP, which end, stall, fail and come back."""

from __future__ import annotations

import json
import logging
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import av
import fakes
import numpy as np
import pytest
from cameras import Camera, MjpegCamera, RtspCamera, jpeg, part

from lanestream import cli
from lanestream.errors import CameraLostError, SourceError
from lanestream.local import LocalEngine
from lanestream_client import LaneClient, SourceFrame, open_source, video_sources
from lanestream_client.sinks import video_sink

Run = Callable[..., tuple[int, str, str]]

PAGE = Path(__file__).parents[2] / "docs" / "client.md"
JPEGS = [part(jpeg(number)) for number in range(12)]


@pytest.fixture(autouse=True)
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a silent camera stall after a second."""
    monkeypatch.setattr(video_sources, "_NETWORK_TIMEOUT_S", 1.0)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Runs `lanestream stream` in this process with a fake engine: (exit code, output, errors)."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["lanestream", "stream", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        output, errors = capsys.readouterr()
        assert "Traceback" not in output + errors
        return int(caught.value.code or 0), output, errors

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LocalEngine, "load", lambda *_: LocalEngine(fakes.engine()))
    return call


def read(camera: Camera, reconnect_s: float = 0.0, **options: object) -> tuple[list[SourceFrame], str, list[str]]:
    """Returns the frames of a camera until it is lost, the error then, and the notices before."""
    notices: list[str] = []
    frames: list[SourceFrame] = []
    with open_source(camera.url, reconnect_s=reconnect_s, notify=notices.append, **options) as source:
        assert source.live
        with pytest.raises(CameraLostError) as caught:
            frames.extend(source.frames)
        assert source.counts.reconnects == (frames[-1].reconnects if frames else 0)
    return frames, str(caught.value), notices


def steps(frames: Sequence[SourceFrame]) -> list[float]:
    """Returns the times between frames in seconds."""
    return np.diff([frame.timestamp or 0.0 for frame in frames]).tolist()


@pytest.mark.parametrize("camera", [MjpegCamera(JPEGS), RtspCamera(12)], ids=["mjpeg", "rtsp"])
def test_a_camera_that_hangs_up_is_lost(run: Run, camera: Camera) -> None:
    with camera:
        code, output, errors = run(camera.url, "--reconnect-camera", 0, "--mode", "all")
    assert code == 3
    assert "12 frames: 12 answered" in output
    assert errors.startswith(f"error: {camera.url} ")
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    "camera", [MjpegCamera(JPEGS, stalls=True), RtspCamera(12, stalls=True)], ids=["mjpeg", "rtsp"]
)
def test_a_stall_says_that_it_is_one(camera: Camera) -> None:
    with camera:
        frames, error, _ = read(camera)
    assert 11 <= len(frames) <= 12
    assert error.startswith(f"{camera.url} stalled: no data for 1 s")


def test_a_camera_that_sends_nothing_to_decode_stalls() -> None:
    with MjpegCamera(JPEGS + [part(b"\xff\xd8 nothing")] * 200) as camera:
        frames, error, _ = read(camera)
    assert len(frames) == 12
    assert "stalled: it sends data, but no frame that can be decoded for 1 s" in error


@pytest.mark.parametrize(
    "camera", [MjpegCamera(JPEGS, JPEGS, [], JPEGS), RtspCamera(12, 12, 0, 12, 0)], ids=["mjpeg", "rtsp"]
)
def test_a_lost_camera_is_opened_again(run: Run, camera: Camera, tmp_path: Path) -> None:
    with camera:
        code, output, errors = run(
            camera.url, "--reconnect-camera", 4, "--mode", "all", "--jsonl", "lanes.jsonl", "--rtsp-transport", "tcp"
        )
    assert code == 3
    assert "36 frames: 36 answered" in output
    assert "the camera was opened again 2 times, with " in output
    lines = errors.splitlines()
    assert [line.startswith(f"{camera.url} ") for line in lines] == [True] * 5 + [False]
    assert all("opening it again, for up to 4 s" in line for line in lines[0:5:2])
    assert all("is back after" in line for line in lines[1:5:2])
    assert "and did not come back within 4 s" in lines[5]
    results = [json.loads(line) for line in (tmp_path / "lanes.jsonl").read_text().splitlines()]
    assert [line["seq"] for line in results] == list(range(36))
    assert [line.get("reconnects", 0) for line in results] == [0] * 12 + [1] * 12 + [2] * 12
    assert np.diff([line["timestamp"] for line in results]).min() > 0.0
    # The second attempt after the second outage is the first with a pause.
    assert results[24]["timestamp"] - results[23]["timestamp"] > 0.4


def test_a_stream_is_stopped_while_its_camera_is_lost() -> None:
    with MjpegCamera(JPEGS) as camera, open_source(camera.url, reconnect_s=60.0, notify=lambda _: None) as source:
        lost = threading.Timer(1.0, source.stop)
        lost.start()
        started = time.monotonic()
        assert len(list(source.frames)) == 12
        assert time.monotonic() - started < 0.5 * fakes.WAIT_S
        lost.join()


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_a_silent_camera_can_be_interrupted(run: Run, mode: str) -> None:
    with MjpegCamera(JPEGS, stalls=True) as camera:
        # Sent to the main thread, which waits for a frame that another thread reads.
        timer = threading.Timer(3.0, signal.pthread_kill, [threading.get_ident(), signal.SIGINT])
        timer.start()
        code, output, _ = run(camera.url, "--mode", mode)
        timer.join()
    assert code == 130
    assert "12 frames: " in output


def test_a_service_keeps_the_session_over_an_outage(url: str) -> None:
    with (
        MjpegCamera(JPEGS, JPEGS) as camera,
        open_source(camera.url, reconnect_s=1.0) as source,
        LaneClient(url) as client,
    ):
        stream = client.stream(source.frames, mode="all")
        results = []
        with pytest.raises(CameraLostError):
            results.extend(stream)
    assert [result.frame.seq for result in results] == list(range(24))
    ids = {tuple(lane.track_id for lane in result.lanes.lanes) for result in results[5:] if result.lanes is not None}
    assert len(ids) == 1


@pytest.mark.parametrize("fps", [15.0, 40.0])
def test_frames_without_a_clock_get_their_arrival(run: Run, tmp_path: Path, fps: float) -> None:
    with MjpegCamera([JPEGS[n % 12] for n in range(30)], fps=fps) as camera:
        frames, _, _ = read(camera)
    assert sum(steps(frames[9:])) == pytest.approx(camera.sent[29] - camera.sent[9], rel=0.15)
    with video_sink(tmp_path / "lanes.mp4", 25.0) as sink:
        assert sink is not None
        for frame in frames:
            sink.write(frame.image(), frame.timestamp)
    with av.open(str(tmp_path / "lanes.mp4")) as video:
        times = [frame.time or 0.0 for frame in video.decode(video=0)]
    assert times[-1] - times[9] == pytest.approx(camera.sent[29] - camera.sent[9], rel=0.15)
    with MjpegCamera(JPEGS, fps=fps) as camera:
        run(camera.url, "--reconnect-camera", 0, "--jsonl", "lanes.jsonl")
    assert {json.loads(line)["clock"] for line in (tmp_path / "lanes.jsonl").read_text().splitlines()} == {"arrival"}


def test_the_clock_of_an_rtsp_camera_is_used_unless_it_stands_still() -> None:
    with RtspCamera(40, fps=20.0) as camera:
        frames, _, _ = read(camera)
    assert {frame.clock for frame in frames[1:]} == {"source"}
    assert steps(frames)[2:] == pytest.approx([0.05] * (len(frames) - 3), abs=1e-3)
    with RtspCamera(40, fps=20.0, clock=0.0) as camera:
        frames, _, _ = read(camera)
    assert {frame.clock for frame in frames[3:]} == {"arrival"}
    assert np.diff([frame.timestamp or 0.0 for frame in frames]).min() > 0.0


@pytest.mark.parametrize("refusal", ["461 Unsupported Transport", "400 Bad Request", "500 Internal Server Error"])
def test_a_camera_that_only_knows_udp_is_read_over_udp(refusal: str) -> None:
    with RtspCamera(12, transports=["udp"], refusal=refusal) as camera:
        frames, _, _ = read(camera)
    assert len(frames) >= 11
    assert camera.setups == ["tcp", "udp"]


def test_a_camera_that_agrees_to_tcp_and_sends_nothing_is_read_over_udp() -> None:
    with RtspCamera(12, silent=["tcp"]) as camera:
        frames, _, _ = read(camera)
    assert len(frames) >= 11
    assert camera.setups == ["tcp", "udp"]


def test_the_transport_can_be_chosen(run: Run) -> None:
    for transport in ("tcp", "udp"):
        with RtspCamera(12) as camera:
            code, _, _ = run(camera.url, "--reconnect-camera", 0, "--rtsp-transport", transport)
            assert (code, camera.setups) == (3, [transport])
    with RtspCamera(12, transports=["udp"]) as camera:
        code, _, errors = run(camera.url, "--rtsp-transport", "tcp")
        assert (code, errors.startswith(f"error: can't open {camera.url}: ")) == (1, True)


@pytest.mark.parametrize("password", ["plain", "p#w", "p/w", "p?w", "p@w", "p#/?@w", "100%"])
def test_a_login_works_and_is_never_shown(run: Run, caplog: pytest.LogCaptureFixture, password: str) -> None:
    caplog.set_level(logging.DEBUG)
    for accepted in (password, "other"):
        with RtspCamera(12, 0, login=f"user:{accepted}") as camera:
            url = camera.url.replace("rtsp://", f"rtsp://user:{password}@")
            code, output, errors = run(url, "--reconnect-camera", 0.2, "--jsonl", "-")
        assert code == (3 if accepted == password else 1)
        assert password not in output + errors + caplog.text
        assert f"127.0.0.1:{camera.port}/live" in errors


def test_the_example_of_a_camera_works(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n([^`]*rtsp://.*?)```", PAGE.read_text(), re.DOTALL)
    with RtspCamera(12) as camera:
        code = code.replace("http://127.0.0.1:8000", url).replace("10.0.0.7/stream1", f"127.0.0.1:{camera.port}/live")
        with pytest.raises(CameraLostError, match="closed the stream"):
            exec(code.replace("reconnect_s=60.0", "reconnect_s=0.0"), {})  # noqa: S102
    assert " source left=" in capsys.readouterr().out


def test_a_login_in_the_parameters_is_never_shown(run: Run) -> None:
    with MjpegCamera(JPEGS) as camera:
        _, output, errors = run(f"{camera.url}?user=u&password=secret", "--reconnect-camera", 1)
    assert "secret" not in output + errors
    assert f"{camera.url}..." in errors


@pytest.mark.parametrize(
    "bad",
    [part(b""), part(b"nothing" * 50), part(jpeg()[:200]), part(b"hello", "text/plain"), part(b"") * 3],
    ids=["empty", "garbage", "cut", "text", "three"],
)
def test_a_bad_part_costs_its_frames(run: Run, bad: bytes) -> None:
    with MjpegCamera([*JPEGS[:6], bad, *JPEGS[6:]]) as camera:
        code, output, _ = run(camera.url, "--reconnect-camera", 0, "--mode", "all")
    assert code == 3
    assert "12 frames: 12 answered" in output
    assert f"the source lost {'3 damaged frames' if bad.count(b'--frame') == 3 else '1 damaged frame'}\n" in output


def test_a_recording_whose_server_dies_is_an_error() -> None:
    with RtspCamera(25, fps=25.0, duration=10.0) as camera, open_source(camera.url) as source:
        assert not source.live
        with pytest.raises(SourceError, match=r"ended after (0|1)\.\d of 10\.0 s"):
            list(source.frames)


class BreakingServer(Camera):
    """Serves the first half of a file of twice that size."""

    def __init__(self, data: bytes) -> None:
        super().__init__()
        self._data = data

    def serve(self, end: socket.socket, number: int) -> None:
        end.recv(65536)
        end.sendall(b"HTTP/1.1 200 OK\r\nContent-Type: video/mp4\r\nContent-Length: %d\r\n\r\n" % len(self._data))
        end.sendall(self._data[: len(self._data) // 2])


def test_a_download_that_breaks_off_is_an_error(tmp_path: Path) -> None:
    images = np.random.default_rng(1).integers(0, 255, (100, 120, 160, 3), np.uint8)
    with av.open(str(tmp_path / "a.mp4"), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("mpeg4", rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height = 160, 120
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
        container.mux(stream.encode(None))
    with BreakingServer((tmp_path / "a.mp4").read_bytes()) as server, open_source(server.url) as source:
        assert not source.live
        with pytest.raises(SourceError, match=r"ended after [12]\.\d of 4\.0 s|failed after \d+ frames"):
            list(source.frames)


def test_a_silent_camera_can_not_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        RtspCamera(0, stalls=True) as camera,
        pytest.raises(SourceError, match="stalled: no data for 1 s"),
        open_source(camera.url),
    ):
        pass
    assert camera.setups == ["tcp", "udp"]


def test_a_camera_is_reached_without_a_proxy_as_no_proxy_says(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        proxy = f"http://127.0.0.1:{unused.getsockname()[1]}"
    for name in ("http_proxy", "HTTP_PROXY"):
        monkeypatch.setenv(name, proxy)
    with MjpegCamera(JPEGS) as camera:
        assert len(read(camera)[0]) == 12
    with pytest.raises(SourceError, match=r"can't open http://camera\.test/live: connection refused") as caught:
        open_source("http://camera.test/live").__enter__()
    assert caught.value.hint == "check the camera and the proxy, or add the camera to NO_PROXY"
    monkeypatch.setenv("no_proxy", "10.0.0.0/8")
    options = [{"http_proxy": ""}], [{"http_proxy": ""}], [{}]
    urls = "http://u:p@10.0.0.7:8080/live", "https://10.0.0.8/live", "http://192.168.0.7/live"
    assert tuple(video_sources._options(url, "auto") for url in urls) == options
