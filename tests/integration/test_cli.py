"""The command line: its output, its errors and its exit codes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import cv2
import fakes
import httpx
import numpy as np
import pytest
from scripted import ScriptedConnection, refused_url, scripted

from lanestream import cli
from lanestream.api.server import listen
from lanestream.engine import Engine
from lanestream.errors import UnauthorizedError
from lanestream.local import LocalCamera, LocalEngine
from lanestream.protocol import DepartureEventModel, LanesMessage, SummaryMessage, warning_message
from lanestream_client.sinks import video_sink

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Runs `lanestream` in this process and an empty folder, with a fake engine: (exit code, output, errors)."""

    def load(regressor: Path | None) -> Engine:
        return fakes.engine() if regressor == Path("none") else fakes.two_detectors()

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["lanestream", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        output, errors = capsys.readouterr()
        assert "Traceback" not in output + errors
        return int(caught.value.code or 0), output, errors

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        LocalEngine, "load", lambda _model, _provider, regressor, _threads: LocalEngine(load(regressor))
    )
    return call


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """A video of ten frames, 320 x 180."""
    with video_sink(tmp_path / "clip.mp4", 25.0) as sink:
        assert sink is not None
        for number in range(10):
            sink.write(np.full((180, 320, 3), 20 * number, np.uint8), number / 25.0)
    return tmp_path / "clip.mp4"


def read_lines(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_help_needs_no_extra() -> None:
    block_extras = (
        "import sys; sys.modules.update(dict.fromkeys(['cv2', 'av', 'numpy', 'onnxruntime', 'fastapi', 'torch']));"
    )
    script = f"{block_extras} from lanestream.cli import main; main()"
    shown = subprocess.run(
        [sys.executable, "-c", script, "--help"], capture_output=True, text=True, check=True, timeout=30
    )
    for name in (
        "serve",
        "key",
        "doctor",
        "batch",
        "detect",
        "stream",
        "scene",
        "data",
        "train",
        "export",
        "evaluate",
        "score",
    ):
        assert re.search(rf"^  {name}  +[A-Z].+\.$", shown.stdout, re.MULTILINE), f"{name} has a line of help"
    for arguments in (["detect", "x.jpg"], ["scene", "x.mp4"], ["doctor"], ["serve"]):
        refused = subprocess.run(
            [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False, timeout=30
        )
        assert refused.returncode == 1
        assert refused.stderr.startswith("error: this needs the package")
        assert "pip install 'lanestream[" in refused.stderr


def test_detect_reports_every_image_and_continues_after_a_bad_one(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    (folder / "10.jpg").write_bytes(fakes.image_file())
    (folder / "2.png").write_bytes(fakes.image_file(".png"))
    (folder / "3.jpg").write_bytes(b"not an image")
    code, output, errors = run("detect", folder, "--annotate", "drawn", "--jsonl", "lanes.jsonl")
    assert code == 1
    assert "3 frames: 2 answered, 0 dropped, 1 failed" in output
    assert "model fake 1 on cpu" in output
    assert errors == f"error: {folder}/3.jpg: not an image: it looks like text (JPEG, PNG or WebP are accepted)\n"
    assert [line["file"] for line in read_lines(tmp_path / "lanes.jsonl")] == [f"{folder}/2.png", f"{folder}/10.jpg"]
    assert sorted(path.name for path in (tmp_path / "drawn").iterdir()) == ["10.jpg.lanes.jpg", "2.png.lanes.jpg"]
    code, output, _ = run("detect", folder / "2.png")
    assert code == 0
    assert re.match(rf"{folder}/2.png: 2 boundaries, ego left and right, \d+\.\d ms\n", output)


def test_jpegs_without_an_end_marker_are_read_and_flagged(run: Run, tmp_path: Path, url: str) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(3):
        (folder / f"{number}.jpg").write_bytes(fakes.image_file()[: None if number == 0 else -2])
    text = "the JPEG has no end marker; if it was cut short, its last pixels are missing\n"
    code, output, errors = run("detect", folder)
    assert (code, "3 answered" in output) == (0, True)
    assert errors == f"warning: {folder}/1.jpg: {text}warning: {folder}/2.jpg: {text}"
    for where in ([], ["--url", url]):
        code, output, errors = run("stream", folder, *where)
        assert (code, "3 answered" in output) == (0, True)
        assert errors == f"warning: frame 1: {text}"  # once in a stream


def test_detect_writes_only_json_to_standard_output(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(fakes.image_file())
    code, output, errors = run("detect", "a.jpg", "--jsonl", "-")
    assert code == 0
    assert json.loads(output)["file"] == "a.jpg"
    assert "1 answered" in errors


def test_stream_in_process(run: Run, clip: Path, tmp_path: Path) -> None:
    code, output, errors = run("stream", clip, "--jsonl", "lanes.jsonl", "--video", "drawn.mp4")
    assert (code, errors) == (0, "")
    assert "10 frames: 10 answered, 0 dropped, 0 failed" in output
    assert "both ego boundaries in 100.0 %" in output
    assert [line["seq"] for line in read_lines(tmp_path / "lanes.jsonl")] == list(range(10))
    with av.open(str(tmp_path / "drawn.mp4")) as video:
        assert [round(25 * frame.time) for frame in video.decode(video=0)] == list(range(10))


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_stream_through_a_service(run: Run, clip: Path, url: str, mode: str) -> None:
    code, output, _ = run("stream", clip, "--url", url, "--mode", mode)
    assert code == 0
    assert "10 frames: 10 answered" in output
    assert "model fake 1 on cpu" in output


@pytest.mark.parametrize("remote", [False, True])
def test_a_preview_is_shown_beside_other_outputs(
    run: Run, clip: Path, url: str, monkeypatch: pytest.MonkeyPatch, remote: bool
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    where = ["--url", url] if remote else []
    code, output, errors = run("stream", clip, "--show", "--jsonl", "-", "--video", "a.mp4", *where)
    assert code == 0
    assert len(re.findall(r"^preview: http://127\.0\.0\.1:\d+/$", errors, re.MULTILINE)) == 1
    assert len(output.splitlines()) == 10
    assert Path("a.mp4").stat().st_size > 0


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="xdg-open opens pages on Linux only")
def test_a_preview_is_opened_where_there_is_a_display(
    run: Run, clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opener = tmp_path / "bin" / "xdg-open"
    opener.parent.mkdir()
    opener.write_text(f'#!/bin/sh\necho "$1" > {tmp_path}/part && mv {tmp_path}/part {tmp_path}/opened\n')
    opener.chmod(0o755)
    monkeypatch.setenv("PATH", f"{opener.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("DISPLAY", ":0")
    code, _, errors = run("stream", clip, "--show")
    assert code == 0
    for _ in range(int(fakes.WAIT_S / 0.05)):
        if (tmp_path / "opened").exists():
            break
        fakes.pause(0.05)
    assert (tmp_path / "opened").read_text().strip() == re.findall(r"preview: (\S+)", errors)[0]


def departing(seq: int) -> LanesMessage:
    """Returns the message for a frame, with a departure event in the sixth."""
    event = DepartureEventModel(state="warning", side="left", track_id=1, timestamp=0.2)
    return fakes.lanes(seq).model_copy(update={"timestamp": seq / 25.0, "events": [event] if seq == 5 else []})


@pytest.mark.parametrize("remote", [False, True])
def test_departures_are_recorded(run: Run, clip: Path, monkeypatch: pytest.MonkeyPatch, remote: bool) -> None:
    def answering(connection: ScriptedConnection) -> None:
        connection.open()
        while (seq := connection.receive_frame()) >= 0:
            connection.send(departing(seq))
        connection.send(SummaryMessage(frames=10, answered=10, failed=0, dropped=0, duration_s=0.4))

    monkeypatch.setattr(LocalCamera, "lanes", lambda _self, _image, seq, **_: departing(seq))
    camera = ["--camera-height", 1.4, "--field-of-view", 62]
    with scripted(*[answering] * remote) as script:
        where = ["--url", script.url] if remote else []
        code, output, errors = run("stream", clip, *camera, "--record-departures", 0.1, *where)
    assert (code, errors) == (0, "")
    assert output.splitlines()[-1] == "departure: departures/departure-000005-left.mp4"
    assert [line["seq"] for line in read_lines(Path("departures/departure-000005-left.jsonl"))] == [3, 4, 5, 6, 7, 8]
    with av.open("departures/departure-000005-left.mp4") as video:
        assert len(list(video.decode(video=0))) == 6


def test_a_warning_of_the_service_is_printed_once(run: Run, clip: Path) -> None:
    def warning(connection: ScriptedConnection) -> None:
        connection.open()
        connection.send_lanes(connection.receive_frame())
        connection.send(warning_message("timestamps_not_advancing", 0))
        connection.finish()

    with scripted(warning) as script:
        code, _, errors = run("stream", clip, "--url", script.url)
    assert code == 0
    assert errors.splitlines() == [
        "warning: the timestamps of the frames do not advance; send each frame's own capture time, on a clock that does"
        " not run backwards"
    ]


def test_a_stream_over_replicas_reports_a_lost_connection(run: Run, clip: Path) -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open()
        assert connection.receive_frame() == 0
        connection.break_off()

    def resumed(connection: ScriptedConnection) -> None:
        connection.open(session="cam-7", resumed=True, last_seq=0)
        connection.finish()

    with scripted(breaking, resumed) as script:
        code, output, errors = run("stream", clip, "--url", refused_url(), "--url", script.url, "--session", "cam-7")
    assert code == 0
    assert errors.splitlines() == [
        "reconnected after a lost connection: session cam-7 was resumed",
        "frame 0: the result of this frame was lost with the connection",
    ]
    assert "10 frames: 9 answered, 0 dropped, 0 failed, 1 lost; " in output
    assert "model m on cpu" in output
    assert [start["session"] for start in script.starts] == ["cam-7"] * 2


def test_a_stream_that_fails_prints_its_report_first(run: Run, clip: Path) -> None:
    def breaking(connection: ScriptedConnection) -> None:
        connection.open()
        connection.send_lanes(connection.receive_frame())
        assert connection.receive_frame() == 1
        connection.close(1012)

    with scripted(breaking) as script:
        code, output, errors = run("stream", clip, "--url", script.url, "--reconnect", "0")
    assert code == 1
    assert "1 answered, 0 dropped, 0 failed, " in output
    assert errors.splitlines()[-1] == "error: the service closed the stream with code 1012"


@pytest.mark.parametrize("given_as", ["option", "environment"])
def test_a_key_is_sent_and_not_printed(run: Run, clip: Path, monkeypatch: pytest.MonkeyPatch, given_as: str) -> None:
    if given_as == "environment":
        monkeypatch.setenv("LANESTREAM_API_KEY", "hidden-key")
    with scripted(UnauthorizedError("no such key", "ask for one")) as script:
        key = ["--api-key", "hidden-key"] if given_as == "option" else []
        code, output, errors = run("stream", clip, "--url", script.url, *key)
    assert (code, output, errors) == (1, "", "error: no such key (ask for one)\n")
    assert script.headers[0]["Authorization"] == "Bearer hidden-key"
    code, output, errors = run("stream", clip, "--url", script.url, "--api-key", "hidden key")
    assert (code, "the API key can't be sent" in errors, "hidden" in output + errors) == (1, True, False)


def test_a_key_in_the_environment_is_ignored_in_process(run: Run, clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_API_KEY", "hidden-key")
    assert run("stream", clip)[0] == 0


@pytest.mark.parametrize("options", [("--api-key", "k"), ("--reconnect", "1"), ("--session", "cam-7")])
def test_service_options_need_a_url(run: Run, clip: Path, options: tuple[str, str]) -> None:
    code, _, errors = run("stream", clip, *options)
    assert (code, "add --url" in errors) == (2, True)


@pytest.mark.parametrize(("detector", "count", "model"), [("candidates", 2, "fake 1"), ("regression", 1, "other 2")])
@pytest.mark.parametrize("remote", [False, True])
def test_the_detector_can_be_chosen(
    run: Run, clip: Path, both_url: str, detector: str, count: int, model: str, remote: bool
) -> None:
    where = ["--url", both_url] if remote else []
    code, output, _ = run("stream", clip, "--detector", detector, "--jsonl", "lanes.jsonl", *where)
    assert (code, f"model {model} on cpu" in output) == (0, True)
    assert [len(line["lanes"]) for line in read_lines(Path("lanes.jsonl"))] == [count] * 10
    Path("a.jpg").write_bytes(fakes.image_file())
    code, output, _ = run("detect", "a.jpg", "--detector", detector, *where)
    assert (code, f"model {model} on cpu" in output) == (0, True)
    assert f"a.jpg: {count} " in output


def test_a_detector_that_is_not_loaded_is_reported_in_one_line(run: Run, clip: Path, url: str) -> None:
    Path("a.jpg").write_bytes(fakes.image_file())
    message = r"error: there is no detector regression here \(ask for candidates\)"
    for where, end in ((["--url", url], r" \[request [0-9a-f]{16}\]\n"), (["--regressor", "none"], "\n")):
        for command in (["stream", clip], ["detect", "a.jpg"]):
            code, output, errors = run(*command, "--detector", "regression", *where)
            assert (code, output) == (1, "")
            assert re.fullmatch(message + end, errors)


def test_stream_of_a_folder_names_files_and_continues_after_a_bad_one(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for number in (1, 2, 10):
        (folder / f"{number}.jpg").write_bytes(fakes.image_file())
    (folder / "3.jpg").write_bytes(fakes.image_file()[:500])
    code, output, errors = run("stream", folder, "--fps", "20", "--jsonl", "lanes.jsonl", "--video", "drawn.mp4")
    assert code == 0
    assert "4 frames: 3 answered, 0 dropped, 1 failed" in output
    assert errors == "frame 2: the JPEG image is cut short: its end is missing\n"
    lines = read_lines(tmp_path / "lanes.jsonl")
    assert [(line["file"], line["type"]) for line in lines] == [
        ("1.jpg", "lanes"),
        ("2.jpg", "lanes"),
        ("3.jpg", "error"),
        ("10.jpg", "lanes"),
    ]
    assert [line.get("timestamp") for line in lines] == [0.0, 0.05, None, 0.15]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["stream", "none.mp4"], 1, "error: no such file or folder: none.mp4 ("),
        (["stream", "text.mp4"], 1, "error: can't open text.mp4: invalid data found when processing input ("),
        (["stream", "empty"], 1, "error: no images in the folder empty ("),
        (
            ["stream", "rtsp://user:secret@127.0.0.1:9/x"],
            1,
            "error: can't open rtsp://127.0.0.1:9/x: connection refused (",
        ),
        (
            ["stream", "clip.mp4", "--url", "http://127.0.0.1:9"],
            1,
            "error: can't reach the service at http://127.0.0.1:9: ",
        ),
        (["stream", "clip.mp4", "--url", "gopher://x"], 1, "error: 'gopher://x' is not a valid service URL ("),
        (["stream", "clip.mp4", "--url", "x", "--model", "m.onnx"], 2, "Usage:"),
        (["stream", "clip.mp4", "--video", "/dev/null/x.mp4"], 1, "error: can't write /dev/null/x.mp4: "),
        (["stream", "clip.mp4", "--jsonl", "/dev/null/x.jsonl"], 1, "error: can't write /dev/null/x.jsonl: "),
        (["stream", "clip.mp4", "--url", "x", "--regressor", "none"], 2, "Usage:"),
        (["stream", "clip.mp4", "--mode", "some"], 2, "Usage:"),
        (["stream", "clip.mp4", "--record-departures", "3"], 2, "Usage:"),
        (["stream", "clip.mp4", "--detector", "unknown"], 2, "Usage:"),
        (["stream", "clip.mp4", "--provider", "tpu"], 2, "Usage:"),
        (["stream"], 2, "Usage:"),
        (["detect", "none.jpg"], 1, "error: can't read none.jpg: no such file or directory"),
        (["detect", "empty"], 1, "error: no images in the folder empty ("),
        (["detect", "x.jpg", "--horizon", "2"], 2, "Usage:"),
        (["detect", "x.jpg", "--horizon", "-0.7"], 2, "Usage:"),
        (["scene", "/dev/null/x.mp4"], 1, "error: can't write /dev/null/x.mp4: "),
        (["scene", "x.mp4", "--size", "641x360"], 2, "Usage:"),
        (["serve", "--host", "no such host"], 1, "error: can't listen on no such host, port "),
        (["fly"], 2, "Usage:"),
    ],
)
def test_wrong_arguments_are_reported_in_one_line(
    run: Run, clip: Path, tmp_path: Path, arguments: list[str], code: int, message: str
) -> None:
    (tmp_path / "text.mp4").write_text("not a video")
    (tmp_path / "empty").mkdir()
    found, _, errors = run(*arguments)
    assert (found, errors[: len(message)]) == (code, message)
    assert code == 2 or errors.count("\n") == 1
    assert "secret" not in errors


def test_a_port_in_use_is_reported(run: Run) -> None:
    with listen("127.0.0.1", 0) as busy:
        port = busy.getsockname()[1]
        assert run("serve", "--port", port) == (
            1,
            "",
            f"error: port {port} on 127.0.0.1 is in use (choose another with --port)\n",
        )


def test_an_invalid_environment_variable_is_reported(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_PORT", "many")
    code, _, errors = run("serve")
    assert (code, errors.count("\n")) == (1, 1)
    assert errors.startswith("error: LANESTREAM_PORT = 'many': input should be a valid integer")


def test_settings_are_printed_without_their_secrets(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("lanestream.toml").write_text('redis_url = "redis://:hunter2@host/0"\nport = 8123\n')
    monkeypatch.setenv("LANESTREAM_TOKEN_SECRET", "signs tokens " * 4)
    monkeypatch.setenv("LANESTREAM_API_KEYS", f"camera-7:{'5ec7e7' * 10}0123")
    code, output, errors = run("serve", "--config", "lanestream.toml", "--host", "::1", "--print-config")
    assert (code, errors) == (0, "")
    lines = output.splitlines()
    for line in ('host = "::1"', "port = 8123", 'api_keys = ["camera-7:***"]', 'redis_url = "redis://***@host/0"'):
        assert line in lines
    assert "hunter2" not in output
    assert "signs tokens " * 4 not in output
    assert 'token_secret = "***"' in lines
    assert "5ec7e7" not in output


def test_an_invalid_url_is_reported_without_its_password(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_REDIS_URL", "redis://:secret/word@host:6379")
    code, _, errors = run("serve", "--port", "0")
    assert (code, errors.count("\n")) == (1, 1)
    assert errors.startswith("error: redis_url is not a valid Redis URL (")
    assert "secret" not in errors


def test_an_invalid_key_name_is_reported(run: Run) -> None:
    code, output, errors = run("key", "camera 7")
    assert (code, output) == (1, "")
    assert errors.startswith("error: 'camera 7' is not a valid name for a key (")


@pytest.mark.parametrize("option", ["--model", "--regressor"])
@pytest.mark.parametrize("name", ["model.onnx", "none.onnx"])
def test_an_invalid_model_ends_the_service(run: Run, tmp_path: Path, option: str, name: str) -> None:
    (tmp_path / "model.onnx").write_text("not a model")
    code, _, errors = run("serve", "--port", "0", option, name)
    assert code == 1
    assert errors.splitlines()[-1].startswith("error: ")
    assert name in errors.splitlines()[-1]


def test_the_regressor_can_be_set_by_an_environment_variable(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LANESTREAM_REGRESSOR", "none.onnx")
    code, _, errors = run("serve", "--port", "0")
    assert code == 1
    assert errors.splitlines()[-1].startswith("error: no model file at none.onnx (")


@pytest.fixture
def service() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Runs `lanestream serve` in another process; yields the process and its URL."""
    command = [sys.executable, "-m", "lanestream.cli", "serve", "--port", "0", "--provider", "cpu"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = next(line for line in process.stderr if "listening on" in line)
        try:
            yield process, line.split("listening on ")[1].split(",")[0]
        finally:
            process.kill()


def test_the_service_is_alive_before_it_is_ready_and_ends_cleanly(service: tuple[subprocess.Popen[str], str]) -> None:
    process, url = service
    statuses = [httpx.get(f"{url}/readyz").status_code]
    assert httpx.get(f"{url}/healthz").status_code == 200
    while statuses[-1] != 200:
        assert process.poll() is None
        statuses.append(httpx.get(f"{url}/readyz").status_code)
    assert set(statuses) <= {503, 200}
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=fakes.WAIT_S)
    assert process.returncode == 0
    assert "Traceback" not in errors


def test_an_interrupted_stream_prints_its_report(tmp_path: Path, real_engine: Engine) -> None:
    video = tmp_path / "long.mp4"
    with video_sink(video, 25.0) as sink:
        assert sink is not None
        image = cv2.imdecode(np.frombuffer(fakes.image_file(), np.uint8), cv2.IMREAD_COLOR)
        for number in range(500):
            sink.write(image, number / 25.0)
    # A shell makes background jobs ignore Ctrl-C, and so their child processes, such as this one.
    restore_interrupt = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{restore_interrupt}; from lanestream.cli import main; main()"]
    command += ["stream", str(video), "--jsonl", "/dev/stdout", "--video", "drawn.mp4"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, env=environment
    ) as process:
        assert process.stdout is not None
        for _ in range(10):  # each is written before its frame is drawn
            assert process.stdout.readline().startswith('{"type": "lanes"')
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "frames/s" in output
    assert "Traceback" not in errors
    with av.open(str(tmp_path / "drawn.mp4")) as drawn:
        assert sum(1 for _ in drawn.decode(video=0)) > 0


def test_a_closed_pipe_is_not_an_error(clip: Path) -> None:
    script = f'"{sys.executable}" -m lanestream.cli stream "{clip}" --jsonl - | head -n 1 | cut -c 1-16'
    done = subprocess.run(["/bin/sh", "-c", script], capture_output=True, text=True, check=True, timeout=30)
    assert done.stdout == '{"type": "lanes"\n'
    assert "Error" not in done.stderr
