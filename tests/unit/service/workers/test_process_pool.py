"""Worker processes without a service around them: real processes, fake models."""

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
from lanestream.workers.ipc import WorkerSetup, encode_message, receive_message
from lanestream.workers.pool import WorkerPool
from lanestream.workers.process_pool import ProcessPool, default_processes
from lanestream.workers.thread_pool import ThreadPool
from lanestream.workers.worker_main import portable

LIMITS = ImageLimits()
LOG: dict[str, Any] = {"version": 1}


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets worker processes import the functions that load an engine."""
    tests = Path(__file__).parents[3]
    path = [str(tests), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))


def frame(data: bytes | None = None, timestamp: float = 0.0) -> EncodedFrame:
    return EncodedFrame(fakes.image_file() if data is None else data, timestamp, time.monotonic())


@asynccontextmanager
async def started(load: Callable[[], Engine], processes: int = 1, **options: Any) -> AsyncIterator[ProcessPool]:
    pool = await ProcessPool.start(WorkerSetup(load, LIMITS, 1, LOG), processes, **options)
    try:
        yield pool
    finally:
        await pool.close()


async def lanes(pool: WorkerPool, frames: int) -> list[object]:
    """Returns the lanes of each frame of a new session, and then its state."""
    session = pool.open_session()
    results: list[object] = []
    for number in range(frames):
        async with pool.admit():
            processed = await pool.run(session, frame(timestamp=0.1 * number))
        results.append([(lane.track_id, lane.curve, lane.covariance.tolist()) for lane in processed.result.lanes])
    return [*results, session.state]


async def test_lanes_and_states_are_exactly_those_of_threads() -> None:
    threads = ThreadPool(fakes.engine(), LIMITS, threads=2)
    async with started(fakes.engine, 2) as processes:
        assert len(processes.pids) == 2
        results = await asyncio.gather(*(lanes(processes, 6) for _ in range(3)))
    assert results == [await lanes(threads, 6)] * 3
    await threads.close()


async def test_the_capabilities_are_those_of_the_workers() -> None:
    async with started(fakes.two_detectors) as pool:
        assert [info.detector for info in pool.capabilities.detectors] == ["candidates", "regression"]
        assert pool.capabilities.select("regression").model.name == "other 2"
        processed = await pool.run(pool.open_session(detector="regression"), frame())
        assert len(processed.result.lanes) == 1
    async with started(fakes.engine) as pool:
        with pytest.raises(NoDetectorError, match="there is no detector regression here"):
            pool.open_session(detector="regression")


async def test_errors_are_raised_and_leave_the_session_as_it_was() -> None:
    reports: list[object] = []
    async with started(fakes.engine, observe=reports.append) as pool:
        session = pool.open_session()
        await pool.run(session, frame())
        before = session.state
        with pytest.raises(ImageError, match="it looks like text") as refused:
            await pool.run(session, frame(b"hello, this is text"))
        assert refused.value.hint
        with pytest.raises(RuntimeError, match="RuntimeError: the detector failed") as failure:
            await pool.run(session, frame(fakes.image_file(shade=255)))
        assert "in detect" in "".join(failure.value.__notes__)
        assert session.state == before
        assert (await pool.run(session, frame(timestamp=0.1))).result.lanes[0].track_id == 1
    assert len(reports) == 3


async def test_a_worker_that_ends_loses_only_its_frame_and_is_replaced() -> None:
    async with started(loading.killing) as pool:
        session = pool.open_session()
        (first,) = pool.pids
        before = session.state
        with pytest.raises(WorkerLostError):
            await pool.run(session, frame())
        assert session.state == before
        while not pool.works:
            with pytest.raises(WorkerLostError):
                await pool.run(session, frame())
            await asyncio.sleep(0.05)
        (second,) = pool.pids
        assert second != first
        assert not psutil.pid_exists(first)


async def test_a_worker_that_hangs_is_ended_and_replaced(caplog: pytest.LogCaptureFixture) -> None:
    async with started(fakes.engine, frame_s=1.0) as pool:
        session = pool.open_session()
        (first,) = pool.pids
        os.kill(first, signal.SIGSTOP)
        with pytest.raises(WorkerLostError):
            await pool.run(session, frame())
        assert not psutil.pid_exists(first)
        assert "a worker process took more than 1 s for a frame and is killed" in caplog.text
        while not pool.works:
            await asyncio.sleep(0.05)
        os.kill(*pool.pids, 0)  # another process, which is alive
        assert pool.pids != (first,)


async def test_a_service_that_was_suspended_keeps_its_workers() -> None:
    async with started(fakes.engine, frame_s=1.0) as pool:
        session = pool.open_session()
        (first,) = pool.pids
        os.kill(first, signal.SIGSTOP)
        processed = asyncio.create_task(pool.run(session, frame()))
        await asyncio.sleep(0.05)
        time.sleep(1.5)  # the event loop is as suspended as the worker
        os.kill(first, signal.SIGCONT)
        assert (await processed).result.lanes
        assert pool.pids == (first,)


async def test_a_deadline_applies_in_the_worker_too() -> None:
    async with started(fakes.engine) as pool:
        late = EncodedFrame(fakes.image_file(), 0.0, time.monotonic(), deadline=time.monotonic() - 1.0)
        with pytest.raises(LanestreamError, match="waited too long"):
            await pool.run(pool.open_session(), late)


@pytest.mark.parametrize(
    ("load", "message"),
    [
        (loading.missing, "no model file at x"),
        (loading.broken, "OSError: the disk is broken"),
        (loading.silent, "ended with status 3 while it started"),
    ],
)
@pytest.mark.parametrize("processes", [1, 2])
async def test_an_engine_that_cannot_be_loaded_is_an_error_and_no_process_is_left(
    load: Callable[[], Engine], message: str, processes: int
) -> None:
    with pytest.raises((LanestreamError, RuntimeError), match=message):
        await ProcessPool.start(WorkerSetup(load, LIMITS, 1, LOG), processes)
    assert not [child for child in psutil.Process().children() if "worker_main" in " ".join(child.cmdline())]


@pytest.mark.parametrize(
    ("available", "memory", "provider", "expected"),
    [
        (3, None, "cpu", 3),
        (64, None, "openvino", 8),
        (4, 4e9, "cpu", 4),
        (4, 1.2e9, "cpu", 2),
        (4, 2e8, "cpu", 1),
        (4, None, "cuda", 1),
    ],
)
def test_networks_on_the_cpu_get_a_process_for_each_processor_if_there_is_memory(
    monkeypatch: pytest.MonkeyPatch, available: int, memory: float | None, provider: str, expected: int
) -> None:
    monkeypatch.setattr("lanestream.workers.process_pool.processors", lambda: available)
    monkeypatch.setattr("lanestream.workers.process_pool.memory_limit", lambda: memory)
    info = Capabilities.of(fakes.engine()).select()
    capabilities = Capabilities((replace(info, model=replace(info.model, provider=provider)),))
    assert default_processes(capabilities) == expected


async def test_the_default_number_of_processes_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lanestream.workers.process_pool.default_processes", lambda _: 3)
    numbers: list[int] = []
    setup = WorkerSetup(fakes.engine, LIMITS, 1, LOG)
    pool = await ProcessPool.start(setup, None, lambda number: numbers.append(number) or 2)
    assert (len(pool.pids), numbers) == (3, [3])
    await pool.close()


async def test_workers_end_with_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    async with started(fakes.engine, 2) as pool:
        for pid in pool.pids:
            for number in (signal.SIGINT, signal.SIGTERM):
                os.kill(pid, number)
        assert await lanes(pool, 2), "signals to the whole process group are handled by the service"
        pids = pool.pids
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_every_documented_error_can_be_sent() -> None:
    here, there = socket.socketpair()
    with here, there:
        for code in documented_errors():
            here.sendall(encode_message(portable(error_from_code(code, "what was wrong", "what to do"))))
            error = receive_message(there)
            assert (error.code, error.message, error.hint) == (code, "what was wrong", "what to do")
