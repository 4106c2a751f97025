"""Worker processes without a service around them: real processes, fake networks."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import fakes
import loading
import psutil
import pytest

from lanestream.engine import Engine
from lanestream.errors import (
    ImageError,
    LanestreamError,
    NoDetectorError,
    WorkerLostError,
    documented_errors,
    error_from_code,
)
from lanestream.images.decoding import ImageLimits
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame
from lanestream.workers.ipc import Setup, packed, receive
from lanestream.workers.pool import Places, WorkerPool
from lanestream.workers.process_pool import ProcessPool, usual_processes
from lanestream.workers.thread_pool import ThreadPool
from lanestream.workers.worker_main import portable

LIMITS = ImageLimits()
LOG: dict[str, Any] = {"version": 1}


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes find the engines that tests load."""
    tests = Path(__file__).parents[3]
    more = [str(tests), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(more))


def frame(data: bytes | None = None, timestamp: float = 0.0) -> EncodedFrame:
    return EncodedFrame(fakes.image_file() if data is None else data, timestamp, time.monotonic())


@asynccontextmanager
async def started(load: Callable[[], Engine], processes: int = 1, **more: Any) -> AsyncIterator[ProcessPool]:
    runner = await ProcessPool.started(Setup(load, LIMITS, 1, LOG), processes, **more)
    try:
        yield runner
    finally:
        await runner.close()


async def lanes(runner: WorkerPool, frames: int) -> list[object]:
    camera = runner.open_camera()
    results = []
    for number in range(frames):
        async with runner.turn():
            processed = await runner.run(camera, frame(timestamp=0.1 * number))
        results.append([(lane.track_id, lane.curve, lane.covariance.tolist()) for lane in processed.result.lanes])
    return [*results, camera.state]


async def test_lanes_and_memory_are_those_of_threads_to_the_last_digit() -> None:
    threads = ThreadPool(fakes.engine(), LIMITS, threads=2)
    async with started(fakes.engine, 2) as processes:
        assert len(processes.pids) == 2
        told = await asyncio.gather(*(lanes(processes, 6) for _ in range(3)))
    assert told == [await lanes(threads, 6)] * 3
    await threads.close()


async def test_what_is_offered_is_what_the_workers_have() -> None:
    async with started(fakes.two_detectors) as runner:
        assert [offer.detector for offer in runner.offers.all] == ["candidates", "regression"]
        assert runner.offers.chosen("regression").network.name == "other 2"
        processed = await runner.run(runner.open_camera(detector="regression"), frame())
        assert len(processed.result.lanes) == 1
    async with started(fakes.engine) as runner:
        with pytest.raises(NoDetectorError, match="there is no detector regression here"):
            runner.open_camera(detector="regression")


async def test_errors_come_back_and_leave_the_camera_as_it_was() -> None:
    reports: list[object] = []
    async with started(fakes.engine, observe=reports.append) as runner:
        camera = runner.open_camera()
        await runner.run(camera, frame())
        before = camera.state
        with pytest.raises(ImageError, match="it looks like text") as refused:
            await runner.run(camera, frame(b"hello, this is text"))
        assert refused.value.hint
        with pytest.raises(RuntimeError, match="RuntimeError: a detector's own mistake") as mistake:
            await runner.run(camera, frame(fakes.image_file(shade=255)))
        assert "in finish" in "".join(mistake.value.__notes__)
        assert camera.state == before
        assert (await runner.run(camera, frame(timestamp=0.1))).result.lanes[0].track_id == 1
    assert len(reports) == 3


async def test_a_worker_that_ends_loses_its_frame_alone_and_is_replaced() -> None:
    async with started(loading.deadly) as runner:
        camera = runner.open_camera()
        (first,) = runner.pids
        before = camera.state
        with pytest.raises(WorkerLostError):
            await runner.run(camera, frame())
        assert camera.state == before
        while not runner.works:
            with pytest.raises(WorkerLostError):
                await runner.run(camera, frame())
            await asyncio.sleep(0.05)
        (second,) = runner.pids
        assert second != first
        assert not psutil.pid_exists(first)


async def test_a_worker_that_hangs_is_ended_and_replaced(caplog: pytest.LogCaptureFixture) -> None:
    async with started(fakes.engine, patience_s=1.0) as runner:
        camera = runner.open_camera()
        (first,) = runner.pids
        os.kill(first, signal.SIGSTOP)
        with pytest.raises(WorkerLostError):
            await runner.run(camera, frame())
        assert not psutil.pid_exists(first)
        assert "a worker process has been at a frame for 1 s; it is ended" in caplog.text
        while not runner.works:
            await asyncio.sleep(0.05)
        os.kill(*runner.pids, 0)  # another one, and it lives
        assert runner.pids != (first,)


async def test_a_service_that_was_suspended_goes_on_with_the_same_workers() -> None:
    async with started(fakes.engine, patience_s=1.0) as runner:
        camera = runner.open_camera()
        (first,) = runner.pids
        os.kill(first, signal.SIGSTOP)
        answer = asyncio.create_task(runner.run(camera, frame()))
        await asyncio.sleep(0.05)
        time.sleep(1.5)  # the event loop is as suspended as the worker
        os.kill(first, signal.SIGCONT)
        assert (await answer).result.lanes
        assert runner.pids == (first,)


async def test_a_deadline_holds_in_the_worker_too() -> None:
    async with started(fakes.engine) as runner:
        late = EncodedFrame(fakes.image_file(), 0.0, time.monotonic(), deadline=time.monotonic() - 1.0)
        with pytest.raises(LanestreamError, match="waited too long"):
            await runner.run(runner.open_camera(), late)


@pytest.mark.parametrize(
    ("load", "told"),
    [
        (loading.missing, "no model file at x"),
        (loading.broken, "OSError: the disk is broken"),
        (loading.silent, "ended while it started: 3"),
    ],
)
@pytest.mark.parametrize("processes", [1, 2])
async def test_what_can_not_be_loaded_is_told_and_no_process_stays(
    load: Callable[[], Engine], told: str, processes: int
) -> None:
    with pytest.raises((LanestreamError, RuntimeError), match=told):
        await ProcessPool.started(Setup(load, LIMITS, 1, LOG), processes)
    assert not [child for child in psutil.Process().children() if "worker_process" in " ".join(child.cmdline())]


@pytest.mark.parametrize(
    ("there", "memory", "provider", "expected"),
    [
        (3, None, "cpu", 3),
        (64, None, "openvino", 8),
        (4, 4e9, "cpu", 4),
        (4, 1.2e9, "cpu", 2),
        (4, 2e8, "cpu", 1),
        (4, None, "cuda", 1),
    ],
)
def test_a_process_for_each_processor_where_there_is_memory(
    monkeypatch: pytest.MonkeyPatch, there: int, memory: float | None, provider: str, expected: int
) -> None:
    monkeypatch.setattr("lanestream.workers.process_pool.processors", lambda: there)
    monkeypatch.setattr("lanestream.workers.process_pool.memory_limit", lambda: memory)
    offer = Capabilities.of(fakes.engine().pipelines).chosen()
    assert (
        usual_processes(Capabilities([replace(offer, network=replace(offer.network, provider=provider))])) == expected
    )


async def test_as_many_processes_as_are_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lanestream.workers.process_pool.usual_processes", lambda _: 3)
    asked: list[int] = []
    runner = await ProcessPool.started(Setup(fakes.engine, LIMITS, 1, LOG), None, lambda n: asked.append(n) or 2)
    assert (len(runner.pids), asked) == (3, [3])
    await runner.close()


async def test_workers_end_with_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    async with started(fakes.engine, 2) as runner:
        for pid in runner.pids:
            for number in (signal.SIGINT, signal.SIGTERM):
                os.kill(pid, number)
        assert await lanes(runner, 2), "signals for the whole group are the service's to answer"
        pids = runner.pids
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_all_errors_of_ours_travel() -> None:
    here, there = socket.socketpair()
    with here, there:
        for code in documented_errors():
            here.sendall(packed(portable(error_from_code(code, "what was wrong", "what to do"))))
            error = receive(there)
            assert (error.code, error.message, error.hint) == (code, "what was wrong", "what to do")


def test_places() -> None:
    assert Places.of(1, 3) == Places(all=4, fresh=1, crowd=2)
    assert Places.of(2, 1) == Places(all=4, fresh=2, crowd=2)
