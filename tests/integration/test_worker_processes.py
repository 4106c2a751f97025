"""A service whose worker processes are killed under load, and what is left of one that is killed itself."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import fakes
import httpx
import psutil
from processes import service
from wsclient import receive, send_message, stream

CREDITS = 4


@dataclass
class Camera:
    """A client in mode `all` that keeps its credits in use until it is stopped, and hears all its answers."""

    url: str
    picture: bytes
    answers: list[dict[str, Any]] = field(default_factory=list)
    sent: int = 0
    stopped: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        with stream(self.url, mode="all") as socket:
            while not self.stopped.is_set() or len(self.answers) < self.sent:
                while self.sent < len(self.answers) + CREDITS and not self.stopped.is_set():
                    socket.send(self.picture)
                    self.sent += 1
                self.answers.append(receive(socket))
            send_message(socket, "end")
            assert receive(socket)["answered"] == sum(answer["type"] == "lanes" for answer in self.answers)


def wait_for(what: Callable[[], bool]) -> None:
    ends = time.monotonic() + 3 * fakes.WAIT_S
    while not what():
        assert time.monotonic() < ends
        time.sleep(0.02)


def workers(process: int) -> list[psutil.Process]:
    """The worker processes of a service, the oldest one first."""
    return sorted(psutil.Process(process).children(), key=lambda child: (child.create_time(), child.pid))


def test_a_worker_that_is_killed_loses_the_frames_it_had_and_nothing_else(road: bytes) -> None:
    with service(credits=CREDITS, processes=2) as (process, url):
        cameras = [Camera(url, road) for _ in range(3)]
        threads = [threading.Thread(target=camera.run) for camera in cameras]
        for thread in threads:
            thread.start()
        wait_for(lambda: all(len(camera.answers) > 5 for camera in cameras))
        victim = workers(process.pid)[0]
        victim.kill()
        wait_for(lambda: any(answer["type"] == "error" for camera in cameras for answer in camera.answers))
        assert httpx.get(f"{url}/readyz").is_success
        wait_for(lambda: "lane_workers 2.0" in httpx.get(f"{url}/metrics").text)
        assert victim.pid not in [worker.pid for worker in workers(process.pid)]
        before = [len(camera.answers) for camera in cameras]
        wait_for(lambda: all(len(camera.answers) > count + 5 for camera, count in zip(cameras, before, strict=True)))
        for camera in cameras:
            camera.stopped.set()
        for thread in threads:
            thread.join(fakes.WAIT_S)
            assert not thread.is_alive()
    for camera in cameras:
        assert [answer["seq"] for answer in camera.answers] == list(range(camera.sent)), "each is answered once"
        lanes = [answer for answer in camera.answers if answer["type"] == "lanes"]
        assert {error["code"] for error in camera.answers if error["type"] == "error"} <= {"worker_lost"}
        # What is known of a camera was never in the worker's keeping alone.
        assert {tuple(lane["track_id"] for lane in answer["lanes"]) for answer in lanes[3:]} == {
            tuple(lane["track_id"] for lane in lanes[3]["lanes"])
        }
        assert lanes[3]["lanes"]
    lost = sum(answer["type"] == "error" for camera in cameras for answer in camera.answers)
    assert 1 <= lost <= 2, "one frame in work, and one that was handed over"


def test_the_service_tells_of_its_workers_and_a_killed_one_leaves_none() -> None:
    with service(processes=2) as (process, url):
        told = dict(
            line.rsplit(" ", 1)
            for line in httpx.get(f"{url}/metrics").text.splitlines()
            if line.startswith("lane_workers")
        )
        assert told["lane_workers"] == "2.0"
        assert float(told["lane_workers_resident_memory_bytes"]) > 1e8
        assert float(told["lane_workers_cpu_seconds_total"]) > 0.1
        left = workers(process.pid)
        assert len(left) == 2
        process.kill()
        process.wait(fakes.WAIT_S)
        wait_for(lambda: not any(worker.is_running() for worker in left))


def test_a_service_may_do_without() -> None:
    with service(processes=0) as (process, url):
        assert not workers(process.pid)
        assert "lane_workers 0.0" in httpx.get(f"{url}/metrics").text
        assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).is_success
