"""SIGTERM under load: the service answers accepted frames, announces the stop and only then closes."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import fakes
import httpx
import pytest
from processes import service
from rawclient import PING, connect, frame, open_stream
from redisserver import redis_server
from websockets.exceptions import ConnectionClosed, InvalidStatus
from wsclient import receive, receive_close, send_message, stream

from lanestream.api import create_app
from lanestream.api.server import LanestreamServer, listen
from lanestream.settings import Settings

CREDITS = 4
STREAMS = 4


@dataclass
class CameraClient:
    """A client in mode `all` that uses all its credits until the service closes."""

    url: str
    started: threading.Barrier
    received: list[dict[str, object]] = field(default_factory=list)
    code: int | None = None

    def run(self) -> None:
        picture = fakes.image_file(width=640, height=360)
        with stream(self.url) as socket:
            send_message(socket, "start", mode="all")
            self.received.append(receive(socket))
            for _ in range(CREDITS):
                socket.send(picture)
            try:
                while True:
                    self.received.append(receive(socket))
                    if len(self.received) == CREDITS + 1:
                        self.started.wait(fakes.WAIT_S)
                    if self.received[-1]["type"] != "draining":
                        # The service may have closed by now; its earlier messages can still be received.
                        with suppress(ConnectionClosed):
                            socket.send(picture)
            except ConnectionClosed as closed:
                self.code = None if closed.rcvd is None else closed.rcvd.code

    def messages(self, kind: str) -> list[dict[str, object]]:
        return [message for message in self.received if message["type"] == kind]


def test_sigterm_under_load_leaves_no_accepted_frame_unanswered(tmp_path: Path) -> None:
    with redis_server(tmp_path) as redis_url, service(credits=CREDITS, redis_url=redis_url) as (process, url):
        started = threading.Barrier(STREAMS + 1)
        cameras = [CameraClient(url, started) for _ in range(STREAMS)]
        threads = [threading.Thread(target=camera.run) for camera in cameras]
        for thread in threads:
            thread.start()
        started.wait(3 * fakes.WAIT_S)
        process.send_signal(signal.SIGTERM)
        for thread in threads:
            thread.join(3 * fakes.WAIT_S)
        assert process.wait(fakes.WAIT_S) in (0, -signal.SIGTERM)
        assert process.stderr is not None
        log = process.stderr.read()
        counts = re.findall(r"(\d+) frames, (\d+) answered, (\d+) failed, (\d+) dropped", log)
        assert len(counts) == STREAMS
        for frames, answered, failed, dropped in ((int(n) for n in count) for count in counts):
            assert frames == answered + failed
            assert dropped == 0
        for camera in cameras:
            assert camera.code == 1012
            (draining,) = camera.messages("draining")
            assert draining["resume_token"] == camera.messages("ready")[0]["resume_token"]
            replies = [message for message in camera.received if message["type"] in ("lanes", "error")]
            assert [reply["seq"] for reply in replies] == list(range(len(replies))), (
                "replies come in order, and none is missing"
            )
            assert {error["code"] for error in camera.messages("error")} <= {"draining"}
        replied = sorted(
            sum(message["type"] in ("lanes", "error") for message in camera.received) for camera in cameras
        )
        assert replied == sorted(int(count[0]) for count in counts), "every accepted frame was answered"
        with service(redis_url=redis_url) as (_, other):
            for camera in cameras:
                with stream(other) as socket:
                    send_message(socket, "start", mode="all", resume_token=camera.messages("ready")[0]["resume_token"])
                    ready = receive(socket)
                    assert ready["resumed"]
                    assert ready["last_seq"] == camera.messages("lanes")[-1]["seq"]


def test_a_draining_service_refuses_new_work_and_finishes_accepted_frames() -> None:
    network = fakes.GatedModel()
    app = create_app(fakes.engine(network), Settings(), None)
    listener = listen("127.0.0.1", 0)
    server = LanestreamServer(app, Settings())
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    with stream(url) as socket:
        send_message(socket, "start", mode="all")
        receive(socket)
        socket.send(fakes.image_file())
        network.wait_for_a_frame()
        server.should_exit = True
        assert receive(socket)["type"] == "draining"
        socket.send(fakes.image_file())
        assert httpx.get(f"{url}/healthz").is_success
        refused = httpx.get(f"{url}/readyz")
        assert (refused.status_code, refused.json()["code"]) == (503, "draining")
        assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).status_code == 503
        with pytest.raises(InvalidStatus) as denied, stream(url):
            pass
        assert json.loads(denied.value.response.body or b"")["code"] == "draining"
        network.let_through()
        assert (receive(socket)["type"], receive(socket)["code"]) == ("lanes", "draining")
        assert receive_close(socket)[0] == 1012
    thread.join(fakes.WAIT_S)
    assert not thread.is_alive()


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT, signal.SIGTERM])
def test_each_signal_drains(number: signal.Signals) -> None:
    # Whoever runs the tests in the background may have made them ignore SIGHUP.
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with service() as (process, url), stream(url, mode="all") as socket:
        socket.send(fakes.image_file(width=640, height=360))
        signal.signal(signal.SIGHUP, before)
        assert receive(socket)["type"] == "lanes"
        process.send_signal(number)
        assert receive(socket)["type"] == "draining"
        assert receive_close(socket)[0] == 1012
        assert process.wait(fakes.WAIT_S) in (0, -number)


def test_a_second_interrupt_ends_the_service_at_once_and_without_a_traceback() -> None:
    with service(drain_s=600) as (process, url), stream(url, mode="all") as socket:
        process.send_signal(signal.SIGINT)
        assert receive(socket)["type"] == "draining"
        process.send_signal(signal.SIGINT)
        process.wait(fakes.WAIT_S)
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()


def test_clients_that_never_read_do_not_delay_the_stop() -> None:
    with service(drain_s=0.5) as (process, url), ExitStack() as stack:
        for _ in range(3):
            silent = stack.enter_context(connect(url, read_buffer=4096))
            open_stream(silent)
            silent.sendall(2000 * frame(PING, bytes(125)))
        process.send_signal(signal.SIGTERM)
        assert process.wait(fakes.WAIT_S) in (0, -signal.SIGTERM)


def test_a_service_that_still_loads_its_networks_stops_at_once() -> None:
    command = [sys.executable, "-m", "lanestream.cli", "serve", "--port", "0", "--provider", "cpu"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        log = next(line for line in process.stderr if "loading the networks" in line)
        process.send_signal(signal.SIGTERM)
        log += process.stderr.read()
        assert process.wait(fakes.WAIT_S) == -signal.SIGTERM
        assert ": ready" not in log
        assert "Traceback" not in log
