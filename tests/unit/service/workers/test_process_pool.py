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
from functools import partial
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
    NotReadyError,
    WorkerLostError,
    documented_errors,
    error_from_code,
)
from lanestream.images.decoding import ImageLimits
from lanestream.messages import ProcessedFrame
from lanestream.protocol import CameraModel
from lanestream.road.results import DepartureEvent
from lanestream.session import SessionOptions
from lanestream.tracking.departure import VehicleMotion
from lanestream.workers.admission import Slot
from lanestream.workers.capabilities import Capabilities
from lanestream.workers.frame_worker import EncodedFrame
from lanestream.workers.ipc import WorkerSetup, encode_message, receive_message
from lanestream.workers.pool import WorkerEvent, WorkerPool
from lanestream.workers.process_pool import ProcessPool, RestartPolicy, default_processes
from lanestream.workers.thread_pool import ThreadPool
from lanestream.workers.worker_main import portable

LIMITS = ImageLimits()
LOG: dict[str, Any] = {"version": 1}
# Restarts without the pauses of real operation.
# A session that reports every boundary at once.
SINGLE = SessionOptions(single_image=True)
SOON = RestartPolicy(first_s=0.01, longest_s=0.05)


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
    pool = await ProcessPool.start(WorkerSetup(load, LIMITS, 1, LOG), processes, **{"restarts": SOON, **options})
    try:
        yield pool
    finally:
        await pool.close()


async def run(
    pool: WorkerPool, data: bytes | None = None, slot: Slot | None = None, timestamp: float = 0.0
) -> ProcessedFrame:
    """Processes one frame of a new session."""
    return await pool.run(pool.open_session(SINGLE), frame(data, timestamp), slot or Slot())


async def outcomes(pool: WorkerPool, frames: list[bytes]) -> list[type]:
    """Processes the frames at the same time, submitted in this order, and returns the types of their outcomes."""
    results = await asyncio.gather(*(run(pool, data) for data in frames), return_exceptions=True)
    return [type(result) for result in results]


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(3 * fakes.WAIT_S):
        while not condition():
            await asyncio.sleep(0.02)


def worker_processes() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "worker_main" in " ".join(child.cmdline())]


async def lanes(pool: WorkerPool, frames: int) -> list[object]:
    """Returns the lanes of each frame of a new session, and then its state."""
    session = pool.open_session()
    results: list[object] = []
    for number in range(frames):
        async with pool.admit("camera") as slot:
            processed = await pool.run(session, frame(timestamp=0.1 * number), slot)
        results.append([(lane.track_id, lane.curve, lane.covariance.tolist()) for lane in processed.result.lanes])
    return [*results, session.state]


async def test_lanes_and_states_are_exactly_those_of_threads() -> None:
    threads = ThreadPool(fakes.engine(), LIMITS, threads=2)
    async with started(fakes.engine, 2) as processes:
        assert len(processes.pids) == 2
        results = await asyncio.gather(*(lanes(processes, 6) for _ in range(3)))
    assert results == [await lanes(threads, 6)] * 3
    await threads.close()


async def departures(pool: WorkerPool) -> list[DepartureEvent]:
    """Returns the departures of a vehicle that leaves its lane, in a new session of `fakes.drifting_engine`."""
    session = pool.open_session(SessionOptions.of(None, None, CameraModel(height=1.4, field_of_view=62.0)))
    found: list[DepartureEvent] = []
    for number in range(80):
        motion = VehicleMotion(speed=30.0)
        encoded = EncodedFrame(fakes.image_file(), 0.04 * number, time.monotonic(), motion=motion)
        processed = await pool.run(session, encoded, Slot())
        found += [event for event in processed.result.events if isinstance(event, DepartureEvent)]
    return found


async def test_departures_are_the_same_as_in_threads() -> None:
    threads = ThreadPool(fakes.drifting_engine(), LIMITS, threads=1)
    async with started(fakes.drifting_engine) as processes:
        found = await departures(processes)
    assert [event.state for event in found] == ["warning", "crossed"]
    assert found == await departures(threads)
    await threads.close()


async def test_the_capabilities_are_those_of_the_workers() -> None:
    async with started(fakes.two_detectors) as pool:
        assert [info.detector for info in pool.capabilities.detectors] == ["candidates", "regression"]
        assert pool.capabilities.select("regression").model.name == "other 2"
        processed = await pool.run(
            pool.open_session(SessionOptions(detector="regression", single_image=True)), frame(), Slot()
        )
        assert len(processed.result.lanes) == 1
    async with started(fakes.engine) as pool:
        with pytest.raises(NoDetectorError, match="there is no detector regression here"):
            pool.open_session(SessionOptions(detector="regression"))


async def test_errors_are_raised_and_leave_the_session_as_it_was() -> None:
    reports: list[object] = []
    async with started(fakes.engine, observe=reports.append) as pool:
        session = pool.open_session(SINGLE)
        await pool.run(session, frame(), Slot())
        before = session.state
        with pytest.raises(ImageError, match="it looks like text") as refused:
            await pool.run(session, frame(b"hello, this is text"), Slot())
        assert refused.value.hint
        with pytest.raises(RuntimeError, match="RuntimeError: the detector failed") as failure:
            await pool.run(session, frame(fakes.image_file(shade=255)), Slot())
        assert "in detect" in "".join(failure.value.__notes__)
        assert session.state == before
        assert (await pool.run(session, frame(timestamp=0.1), Slot())).result.lanes[0].track_id == 1
    assert len(reports) == 3


async def test_a_worker_that_ends_loses_only_its_frame_and_is_replaced() -> None:
    async with started(loading.killing) as pool:
        session = pool.open_session()
        (first,) = pool.pids
        before = session.state
        with pytest.raises(WorkerLostError):
            await pool.run(session, frame(), Slot())
        assert session.state == before
        while not pool.works:
            with pytest.raises(NotReadyError):
                await pool.run(session, frame(), Slot())
            await asyncio.sleep(0.05)
        (second,) = pool.pids
        assert second != first
        assert not psutil.pid_exists(first)


async def test_a_worker_that_hangs_is_ended_and_replaced(caplog: pytest.LogCaptureFixture) -> None:
    async with started(fakes.engine, frame_s=1.0) as pool:
        (first,) = pool.pids
        os.kill(first, signal.SIGSTOP)
        with pytest.raises(WorkerLostError):
            await run(pool)
        assert "a worker process took more than 1 s for a frame and is killed" in caplog.text
        await until(lambda: pool.works)
        assert not psutil.pid_exists(first)
        os.kill(*pool.pids, 0)  # another process, which is alive
        assert pool.pids != (first,)


async def test_a_service_that_was_suspended_keeps_its_workers() -> None:
    async with started(fakes.engine, frame_s=1.0) as pool:
        session = pool.open_session(SINGLE)
        (first,) = pool.pids
        os.kill(first, signal.SIGSTOP)
        processed = asyncio.create_task(pool.run(session, frame(), Slot()))
        await asyncio.sleep(0.05)
        time.sleep(1.5)  # the event loop is as suspended as the worker
        os.kill(first, signal.SIGCONT)
        assert (await processed).result.lanes
        assert pool.pids == (first,)


async def test_a_deadline_applies_in_the_worker_too() -> None:
    async with started(fakes.engine) as pool:
        late = EncodedFrame(fakes.image_file(), 0.0, time.monotonic(), deadline=time.monotonic() - 1.0)
        with pytest.raises(LanestreamError, match="waited too long"):
            await pool.run(pool.open_session(), late, Slot())


async def test_a_frame_that_ends_its_worker_is_not_given_to_another_and_those_that_waited_are() -> None:
    events: list[WorkerEvent] = []
    async with started(loading.obeying, 2, observe_worker=events.append) as pool:
        killing, slow, other = map(loading.frame_that, (loading.kill_later, loading.sleep, loading.work))
        _, survivor = pool.pids
        # Each worker has two frames, and one thread.
        found = await outcomes(pool, [killing, slow, other, other])
        assert found == [WorkerLostError, ProcessedFrame, ProcessedFrame, ProcessedFrame]
        assert survivor in pool.pids
        await until(lambda: "replaced" in events)
    assert events == ["ended", "replaced"]


async def test_frames_that_waited_in_the_only_worker_are_refused_and_not_blamed() -> None:
    async with started(loading.obeying) as pool:
        found = await outcomes(pool, [loading.frame_that(loading.kill_later), fakes.image_file()])
    assert found == [WorkerLostError, NotReadyError]


async def test_frames_beside_one_that_hangs_are_not_blamed() -> None:
    async with started(loading.obeying, threads_of=lambda _: 2, frame_s=2.0) as pool:
        hanging, slow = map(loading.frame_that, (loading.hang, loading.sleep))
        # The second thread would need longer than the limit for all the others.
        first, *others = await outcomes(pool, [hanging] + [slow] * 14)
    assert first is WorkerLostError
    assert list(dict.fromkeys(others)) == [ProcessedFrame, NotReadyError]


async def test_each_thread_of_a_worker_may_have_begun_a_frame() -> None:
    async with started(loading.obeying, 2, threads_of=lambda _: 2) as pool:
        killing, hanging, slow = map(loading.frame_that, (loading.kill_later, loading.hang, loading.sleep))
        # The first, the third and the fifth frame go to the same worker.
        found = await outcomes(pool, [killing, slow, hanging, slow, slow, slow])
    assert found == [WorkerLostError, ProcessedFrame, WorkerLostError, ProcessedFrame, ProcessedFrame, ProcessedFrame]


async def test_a_frame_that_hangs_costs_only_its_camera(caplog: pytest.LogCaptureFixture) -> None:
    events: list[WorkerEvent] = []
    slot = Slot()
    async with started(loading.obeying, 2, frame_s=1.0, observe_worker=events.append) as pool:
        (first, second), hangs = pool.pids, loading.frame_that(loading.hang)
        hanging = asyncio.create_task(run(pool, hangs, slot))
        others = asyncio.create_task(outcomes(pool, [fakes.image_file()] * 4))
        with pytest.raises(WorkerLostError):
            await hanging
        assert await others == [ProcessedFrame] * 4
        assert "a worker process took more than 1 s for a frame and is killed" in caplog.text
        await until(lambda: "replaced" in events)
        assert not psutil.pid_exists(first)
        assert second in pool.pids
    assert events == ["hung", "replaced"]
    assert slot.cost_s == pytest.approx(1.0, abs=0.01)


async def test_the_time_limit_of_a_frame_begins_when_the_worker_begins_it() -> None:
    async with started(loading.obeying, frame_s=4 * loading.SLOW_S) as pool:
        assert await outcomes(pool, [loading.frame_that(loading.sleep)] * 7) == [ProcessedFrame] * 7


async def test_a_frame_that_hangs_is_noticed_although_its_camera_is_gone() -> None:
    events: list[WorkerEvent] = []
    async with started(loading.obeying, frame_s=0.5, observe_worker=events.append) as pool:
        hanging = asyncio.create_task(run(pool, loading.frame_that(loading.hang)))
        await asyncio.sleep(0.1)
        hanging.cancel()
        await until(lambda: "replaced" in events)
        assert (await run(pool)).result.lanes
    assert events == ["hung", "replaced"]


async def test_new_frames_avoid_a_worker_that_has_a_slow_frame() -> None:
    async with started(loading.obeying, 2, frame_s=60.0) as pool:
        hanging = asyncio.create_task(run(pool, loading.frame_that(loading.hang)))
        await asyncio.sleep(1.5)
        async with asyncio.timeout(fakes.WAIT_S):
            assert await outcomes(pool, [fakes.image_file()] * 5) == [ProcessedFrame] * 5
        assert not hanging.done()
        since = time.monotonic()
    assert time.monotonic() - since < 5.0, "a worker that hangs does not delay the end of the service"
    with pytest.raises(WorkerLostError):
        await hanging


async def test_a_worker_that_does_not_end_is_killed() -> None:
    async with started(loading.obeying) as pool:
        (first,) = pool.pids
        with pytest.raises(WorkerLostError):
            await run(pool, loading.frame_that(loading.stop_after_closing_the_socket))
        await until(lambda: pool.works)
        assert not psutil.pid_exists(first)
        os.kill(*pool.pids, signal.SIGSTOP)
        since = time.monotonic()
    assert time.monotonic() - since < 5.0
    assert not worker_processes()


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (loading.exit_the_thread, "SystemExit: 7"),
        (loading.recurse, "RecursionError: maximum recursion depth exceeded"),
        (loading.raise_what_cannot_be_sent, "Can't pickle"),
    ],
)
async def test_a_frame_is_answered_whatever_it_raises(act: Callable[[], None], message: str) -> None:
    async with started(loading.obeying) as pool:
        pids = pool.pids
        with pytest.raises(RuntimeError, match=message):
            await run(pool, loading.frame_that(act))
        assert (await run(pool)).result.lanes
        assert pool.pids == pids


async def test_a_frame_that_cannot_be_received_is_answered() -> None:
    async with started(fakes.engine) as pool:
        undecodable: Any = loading.Undecodable()
        with pytest.raises(RuntimeError, match="MemoryError: no memory is left"):
            await run(pool, undecodable)
        assert (await run(pool)).result.lanes


async def test_a_frame_is_charged_the_processor_time_that_it_took() -> None:
    async with started(loading.obeying) as pool:
        costs = []
        for act in (loading.sleep, loading.work, loading.work_and_fail, loading.kill_later):
            slot = Slot()
            await asyncio.gather(run(pool, loading.frame_that(act), slot), return_exceptions=True)
            costs.append(slot.cost_s / loading.SLOW_S)
    sleeping, working, failing, lost = costs
    assert sleeping < 0.5
    assert working >= 1.0
    assert failing >= 1.0
    assert lost >= 1.0


@pytest.mark.parametrize(
    ("load", "start_s", "message"),
    [
        (loading.out_of_memory, 60.0, "can't be started: MemoryError: no memory is left"),
        (loading.silent, 60.0, "can't be started: a worker process ended with status 3 while it started"),
        (loading.hanging, 3.0, "can't be started: a worker process was not ready after 3 s and was killed"),
    ],
)
async def test_a_worker_that_cannot_be_started_is_tried_again(
    load: Callable[[], Engine], start_s: float, message: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    events: list[WorkerEvent] = []
    loads = partial(loading.failing_once, load, tmp_path)
    async with started(loads, start_s=start_s, observe_worker=events.append) as pool:
        os.kill(*pool.pids, signal.SIGKILL)
        await until(lambda: "replaced" in events)
        assert (await run(pool)).result.lanes
        assert not pool.upkeep_failed
    assert list(dict.fromkeys(events)) == ["ended", "start_failed", "replaced"]
    assert message in caplog.text
    assert ("in out_of_memory" in caplog.text) == (load is loading.out_of_memory), "only unexpected: with a traceback"


async def test_the_first_start_has_a_time_limit_too() -> None:
    with pytest.raises(WorkerLostError, match=r"not ready after 0\.5 s and was killed"):
        await ProcessPool.start(WorkerSetup(loading.hanging, LIMITS, 1, LOG), start_s=0.5)
    assert not worker_processes()


def test_the_pause_before_a_restart_doubles_until_a_worker_has_lived_long_enough() -> None:
    policy, pauses = RestartPolicy(0.5, 3.0, 60.0), [0.0]
    for uptime_s in (59.0, 0.0, 10.0, 0.0, 0.0, 60.0, 0.0, 3600.0, 3600.0):
        pauses.append(policy.next_pause(pauses[-1], uptime_s))
    assert pauses[1:] == [0.5, 1.0, 2.0, 3.0, 3.0, 0.5, 1.0, 0.5, 0.5]


async def test_workers_that_start_and_end_again_are_restarted_ever_more_slowly(
    caplog: pytest.LogCaptureFixture,
) -> None:
    pauses: list[object] = []
    async with started(loading.obeying, restarts=RestartPolicy(0.01, 0.04)) as pool:
        while len(pauses) < 4:
            if pool.works:
                await asyncio.gather(run(pool, loading.frame_that(loading.kill)), return_exceptions=True)
            await asyncio.sleep(0.02)
            pauses = [record.args for record in caplog.records if "starts in" in record.msg]
    assert pauses == [(0.01,), (0.02,), (0.04,), (0.04,)]


async def test_an_upkeep_that_has_failed_is_noticed(caplog: pytest.LogCaptureFixture) -> None:
    def fail(event: WorkerEvent) -> None:
        raise RuntimeError(f"no one expects {event}")

    async with started(fakes.engine, observe_worker=fail) as pool:
        assert not pool.upkeep_failed
        os.kill(*pool.pids, signal.SIGKILL)
        await until(lambda: pool.upkeep_failed)
        (record,) = [each for each in caplog.records if each.levelname == "CRITICAL"]
        assert "no longer replaced" in record.getMessage()
        assert "no one expects ended" in str(record.exc_info)
    assert not pool.upkeep_failed


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
    assert not worker_processes()


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
            for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
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
