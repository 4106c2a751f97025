"""A service whose worker processes are killed under load, and one that is killed itself."""

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
    """A client in mode `all` that uses all its credits until it is stopped, and receives every reply."""

    url: str
    picture: bytes
    replies: list[dict[str, Any]] = field(default_factory=list)
    sent: int = 0
    stopped: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        with stream(self.url, mode="all") as socket:
            while not self.stopped.is_set() or len(self.replies) < self.sent:
                while self.sent < len(self.replies) + CREDITS and not self.stopped.is_set():
                    # By the camera's own clock, so that the tracks survive the delays of a busy machine.
                    send_message(socket, "frame", timestamp=0.1 * self.sent)
                    socket.send(self.picture)
                    self.sent += 1
                self.replies.append(receive(socket))
            send_message(socket, "end")
            assert receive(socket)["answered"] == sum(reply["type"] == "lanes" for reply in self.replies)


def wait_until(condition: Callable[[], bool]) -> None:
    ends = time.monotonic() + 3 * fakes.WAIT_S
    while not condition():
        assert time.monotonic() < ends
        time.sleep(0.02)


def workers(process: int) -> list[psutil.Process]:
    """Returns the worker processes of a service, oldest first."""
    return sorted(psutil.Process(process).children(), key=lambda child: (child.create_time(), child.pid))


def test_a_killed_worker_loses_only_the_frames_it_had(road: bytes) -> None:
    with service(credits=CREDITS, processes=2) as (process, url):
        cameras = [Camera(url, road) for _ in range(3)]
        threads = [threading.Thread(target=camera.run) for camera in cameras]
        for thread in threads:
            thread.start()
        wait_until(lambda: all(len(camera.replies) > 5 for camera in cameras))
        victim = workers(process.pid)[0]
        victim.suspend()
        time.sleep(0.5)  # it certainly has frames by now
        victim.kill()
        wait_until(lambda: any(reply["type"] == "error" for camera in cameras for reply in camera.replies))
        assert httpx.get(f"{url}/readyz").is_success
        wait_until(lambda: "lane_workers 2.0" in httpx.get(f"{url}/metrics").text)
        assert victim.pid not in [worker.pid for worker in workers(process.pid)]
        before = [len(camera.replies) for camera in cameras]
        wait_until(lambda: all(len(camera.replies) > count + 5 for camera, count in zip(cameras, before, strict=True)))
        for camera in cameras:
            camera.stopped.set()
        for thread in threads:
            thread.join(fakes.WAIT_S)
            assert not thread.is_alive()
    for camera in cameras:
        assert [reply["seq"] for reply in camera.replies] == list(range(camera.sent)), "each frame has one reply"
        lanes = [reply for reply in camera.replies if reply["type"] == "lanes"]
        assert {error["code"] for error in camera.replies if error["type"] == "error"} <= {"worker_lost"}
        # The service keeps the state of each session, so the tracks continue in another worker.
        assert {tuple(lane["track_id"] for lane in reply["lanes"]) for reply in lanes[3:]} == {
            tuple(lane["track_id"] for lane in lanes[3]["lanes"])
        }
        assert lanes[3]["lanes"]
    lost = sum(reply["type"] == "error" for camera in cameras for reply in camera.replies)
    assert lost == 1, "the frame that was being processed; one that waited in the worker went to the other one"


def test_metrics_describe_the_workers_and_a_killed_service_leaves_none() -> None:
    with service(processes=2) as (process, url):
        metrics = dict(
            line.rsplit(" ", 1)
            for line in httpx.get(f"{url}/metrics").text.splitlines()
            if line.startswith("lane_workers")
        )
        assert metrics["lane_workers"] == "2.0"
        assert float(metrics["lane_workers_resident_memory_bytes"]) > 1e8
        assert float(metrics["lane_workers_cpu_seconds_total"]) > 0.1
        left = workers(process.pid)
        assert len(left) == 2
        process.kill()
        process.wait(fakes.WAIT_S)
        wait_until(lambda: not any(worker.is_running() for worker in left))


def test_a_service_whose_workers_hang_ends_soon_and_leaves_none() -> None:
    with service(processes=2) as (process, _):
        left = workers(process.pid)
        for worker in left:
            worker.suspend()
        process.terminate()
        process.wait(5.0)
        assert not any(worker.is_running() for worker in left)


def test_a_service_can_run_without_worker_processes() -> None:
    with service(processes=0) as (process, url):
        assert not workers(process.pid)
        assert "lane_workers 0.0" in httpx.get(f"{url}/metrics").text
        assert httpx.post(f"{url}/v1/detect", content=fakes.image_file()).is_success
