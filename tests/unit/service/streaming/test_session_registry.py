"""Sessions and their limits, without sockets; clocks are numbers where time matters."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import math
import time
from base64 import b64decode, b64encode
from collections.abc import AsyncIterator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

import fakes
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lanestream.errors import BusyError, EvictedError, NoDetectorError, StoreError, TooOldError
from lanestream.images.decoding import ImageLimits
from lanestream.messages import ProcessedFrame, lanes_message
from lanestream.protocol import StartMessage
from lanestream.road.results import FrameResult
from lanestream.session import Session, SessionOptions
from lanestream.streaming.session_registry import Caller, OpenSession, SessionLimits, SessionRegistry
from lanestream.streaming.store import MemoryStore, SessionStore, StoredSession, TakenSession
from lanestream.tracking.road_filter import OWN, ROAD
from lanestream.workers.thread_pool import ThreadPool

ANN, BOB = Caller("ann", "ann"), Caller("bob", "bob")
POOL = ThreadPool(fakes.engine(), ImageLimits(), threads=1)
DAY_S = 86_400.0


@dataclass
class Clock:
    now: float = 1e9

    def __call__(self) -> float:
        return self.now


@dataclass
class Machine:
    """The clocks of a machine. Its monotonic clock began at some time of its own."""

    clock: Clock = field(default_factory=lambda: Clock(5000.0))
    wall_clock: Clock = field(default_factory=Clock)

    def advance(self, seconds: float) -> None:
        self.clock.now += seconds
        self.wall_clock.now += seconds


class UnreachableStore(MemoryStore):
    """Fails until it is repaired."""

    works = False

    def _check(self) -> None:
        if not self.works:
            raise StoreError("unreachable")

    async def take_over(self, key: str, caller: str, owner: str) -> TakenSession | None:
        self._check()
        return await super().take_over(key, caller, owner)

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        self._check()
        return await super().save(key, session, ttl_s)

    async def check(self) -> None:
        self._check()


class SharedStore(MemoryStore):
    """A store that several registries of a test share. Every operation suspends once, as those of a network do."""

    shared: Final = True  # type: ignore[misc]

    async def take_over(self, key: str, caller: str, owner: str) -> TakenSession | None:
        await asyncio.sleep(0)
        return await super().take_over(key, caller, owner)

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        await asyncio.sleep(0)
        return await super().save(key, session, ttl_s)


class CountingStore(MemoryStore):
    """Counts how often sessions are saved."""

    saved = 0

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        self.saved += 1
        return await super().save(key, session, ttl_s)


def make_registry(
    store: SessionStore | None = None, machine: Machine | None = None, **limits: float
) -> SessionRegistry:
    of_machine = machine or Machine(Clock(time.monotonic()))
    clock = time.monotonic if machine is None else of_machine.clock
    usual = SessionLimits(**limits)  # type: ignore[arg-type]
    return SessionRegistry(usual, store or MemoryStore(), clock=clock, wall_clock=of_machine.wall_clock)


@asynccontextmanager
async def replicas(number: int, store: SessionStore) -> AsyncIterator[list[SessionRegistry]]:
    """Yields registries that share a store."""
    registries = [make_registry(store) for _ in range(number)]
    for registry in registries:
        registry.begin()
    try:
        yield registries
    finally:
        for registry in registries:
            await registry.stop()


def process_frame(session: OpenSession, timestamp: float) -> FrameResult:
    assert isinstance(session.handle, Session)
    return fakes.engine().process(session.handle, fakes.picture(), timestamp)


# The numbers of a filter of two boundaries: its mean and half of its covariance.
SIZE: Final = ROAD + 2 * OWN
NUMBERS: Final = SIZE + SIZE * (SIZE + 1) // 2


def encoded(numbers: NDArray[np.float64]) -> str:
    """Returns the numbers of a filter as a record has them."""
    return b64encode(numbers.astype("<f4").tobytes()).decode()


def valid_record() -> dict[str, Any]:
    """Returns a record as JSON has it, of a session with two confirmed tracks."""

    async def make() -> bytes:
        store, machine = MemoryStore(), Machine()
        registry = make_registry(store, machine)
        session = await start(registry)
        for i in range(4):
            process_frame(session, 0.04 * i)
        session.last_seq = 3
        await registry.close(session, resumable=True)
        assert session.key is not None
        taken = await store.take_over(session.key, "ann", "test")
        assert taken is not None
        return taken.data

    with ThreadPoolExecutor(1) as thread:  # the caller may run an event loop
        record: dict[str, Any] = json.loads(thread.submit(asyncio.run, make()).result())
    return record


async def resume_record(text: str) -> OpenSession:
    """Resumes the session whose stored record is `text`."""
    store = MemoryStore()
    key = hashlib.sha256(b"token").hexdigest()
    await store.save(key, StoredSession("ann", "ann", "another replica", text.encode()), 60.0)
    return await start(make_registry(store), token="token")  # noqa: S106


def paths(value: object) -> Iterator[tuple[str | int, ...]]:
    """Returns the path of every value inside a value of JSON."""
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in inside:
        yield (key,)
        yield from ((key, *path) for path in paths(child))


def at(value: Any, path: tuple[str | int, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def replace_at(record: Any, path: tuple[str | int, ...], value: object) -> None:
    at(record, path[:-1])[path[-1]] = value


async def close(registry: SessionRegistry, session: OpenSession) -> OpenSession:
    await registry.close(session, resumable=True)
    return session


def close_if_evicted(registry: SessionRegistry, session: OpenSession) -> asyncio.Event:
    """Closes a session as its socket does when it is evicted. The event is set when it is notified."""
    evicted, tasks = asyncio.Event(), []

    def on_evict() -> None:
        tasks.append(asyncio.create_task(registry.close(session, resumable=True)))
        evicted.set()

    session.on_evict = on_evict
    return evicted


async def race(registries: Sequence[SessionRegistry], token: str | None) -> OpenSession:
    """Resumes a session from two sockets at the same instant. Returns it when the other socket was evicted."""

    async def resume(registry: SessionRegistry) -> tuple[OpenSession | None, asyncio.Event]:
        try:
            session = await start(registry, token=token)
        except EvictedError:
            evicted = asyncio.Event()
            evicted.set()
            return None, evicted
        assert session.resumed
        return session, close_if_evicted(registry, session)

    sockets = await asyncio.gather(*map(resume, registries))
    tasks = [asyncio.create_task(evicted.wait()) for _, evicted in sockets]
    done, waiting = await asyncio.wait(tasks, timeout=fakes.WAIT_S, return_when=asyncio.FIRST_COMPLETED)
    assert (len(done), len(waiting)) == (1, 1), "exactly one of them lost"
    for task in waiting:
        task.cancel()
    (winner,) = [session for session, evicted in sockets if session is not None and not evicted.is_set()]
    return winner


async def start(registry: SessionRegistry, caller: Caller = ANN, token: str | None = None) -> OpenSession:
    return await registry.start(POOL, caller, StartMessage(resume_token=token))


async def test_another_replica_resumes_a_session_exactly() -> None:
    store, here, there = MemoryStore(), Machine(), Machine(Clock(77.0))
    one, other = make_registry(store, here), make_registry(store, there)
    first = await start(one)
    for i in range(10):
        before = process_frame(first, 0.1 * i)
    first.last_seq, first.stream_s = 9, 3.5
    here.advance(4.0)
    await one.close(first, resumable=True)
    there.advance(24.0)
    second = await start(other, token=first.token)
    assert (second.resume_outcome, second.id, second.token) == ("resumed", first.id, first.token)
    assert (second.last_seq, second.stream_s, second.age_s) == (9, 27.5, 24.0)
    assert second.handle.state == first.handle.state
    after = process_frame(second, 1.0)
    assert [lane.track_id for lane in after.lanes] == [lane.track_id for lane in before.lanes] == [1, 2]
    process_frame(first, 1.0)
    assert second.handle.state == first.handle.state, "exactly, to the last digit"
    assert [lane.age_s for lane in after.lanes] == [1.0, 1.0]


async def test_ids_that_a_crashed_replica_may_have_assigned_are_not_assigned_again() -> None:
    store = MemoryStore()
    crashed, other = make_registry(store), make_registry(store)
    first = await start(crashed)
    process_frame(first, 0.0)
    crashed.schedule_save(first)
    await asyncio.sleep(0.3)
    second = await start(other, token=first.token)
    assert second.resume_outcome == "resumed"
    before, after = first.handle.state.tracker, second.handle.state.tracker
    assert after.tracks == before.tracks
    assert after.next_id > before.next_id


async def test_a_token_resumes_only_sessions_of_its_caller() -> None:
    registry = make_registry()
    first = await start(registry)
    await registry.close(first, resumable=True)
    for caller, token in ((BOB, first.token), (ANN, "guessed")):
        other = await start(registry, caller, token)
        assert (other.resume_outcome, other.last_seq) == ("unknown", None)
        assert other.token not in (None, token), "a token from a client never becomes the token of a new session"
        assert other.id != first.id
    assert (await start(registry, token=first.token)).resume_outcome == "resumed"


async def test_a_new_socket_evicts_the_old_one_and_waits_for_it() -> None:
    registry = make_registry()
    first = await start(registry)
    evicted = asyncio.Event()
    first.on_evict = evicted.set
    resuming = asyncio.create_task(start(registry, token=first.token))
    await evicted.wait()
    assert not resuming.done()
    first.last_seq = 5
    await registry.close(first, resumable=True)
    second = await resuming
    assert (second.resume_outcome, second.last_seq) == ("resumed", 5)
    assert len(registry) == 1


async def test_a_session_resumed_on_another_replica_is_evicted_at_its_next_save() -> None:
    store = MemoryStore()
    one, other = make_registry(store, save_s=0.0), make_registry(store)
    first = await start(one)
    evicted = asyncio.Event()
    first.on_evict = evicted.set
    second = await start(other, token=first.token)
    second.last_seq = 7
    one.schedule_save(first)
    await asyncio.wait_for(evicted.wait(), fakes.WAIT_S)
    await one.close(first, resumable=True)
    await other.close(second, resumable=True)
    assert (await start(other, token=first.token)).last_seq == 7, "the evicted session did not overwrite the state"


async def test_an_ended_or_too_old_session_is_not_resumed() -> None:
    machine = Machine()
    registry = make_registry(machine=machine, session_s=50.0)
    ended, old = await start(registry), await start(registry)
    await registry.close(ended, resumable=False)
    await registry.close(old, resumable=True)
    machine.advance(50.0)
    assert registry.life_s_left(old) == 0.0
    for session in (ended, old):
        assert (await start(registry, token=session.token)).resume_outcome == "unknown"


async def test_a_session_has_a_maximum_age() -> None:
    machine = Machine()
    registry = make_registry(machine=machine, session_s=10.0)
    session = await start(registry)
    machine.advance(9.9)
    registry.check_age(session)
    machine.advance(0.1)
    with pytest.raises(TooOldError, match="maximum age of 10 s"):
        registry.check_age(session)


async def test_a_session_grows_old_over_all_its_replicas() -> None:
    store, here, there = MemoryStore(), Machine(), Machine(Clock(77.0))
    one, other = make_registry(store, here, session_s=60.0), make_registry(store, there, session_s=60.0)
    first = await start(one)
    here.advance(30.0)
    await one.close(first, resumable=True)
    there.advance(40.0)
    second = await start(other, token=first.token)
    assert other.life_s_left(second) == 20.0


@pytest.mark.parametrize("step_s", [25 * 3600.0, -25 * 3600.0])
async def test_a_step_of_the_time_of_day_ends_no_session_of_this_process(step_s: float) -> None:
    machine = Machine()
    registry = make_registry(machine=machine, session_s=DAY_S)
    first = await start(registry)
    first.stream_s = 8.0
    machine.advance(1.0)
    machine.wall_clock.now += step_s
    registry.check_age(first)
    await registry.close(first, resumable=True)
    machine.advance(2.0)
    machine.wall_clock.now -= 2.0 * step_s
    second = await start(registry, token=first.token)
    assert (second.resume_outcome, second.age_s, second.stream_s) == ("resumed", 3.0, 11.0)


@pytest.mark.parametrize(("step_s", "elapsed_s"), [(25 * 3600.0, 50.0), (-25 * 3600.0, 0.0)])
async def test_the_clock_of_another_replica_may_be_wrong(step_s: float, elapsed_s: float) -> None:
    store, here, there = MemoryStore(), Machine(), Machine()
    one, other = (make_registry(store, machine, resume_s=20.0, idle_s=30.0) for machine in (here, there))
    first = await start(one)
    first.stream_s = 8.0
    await one.close(first, resumable=True)
    there.wall_clock.now += step_s
    second = await start(other, token=first.token)
    assert (second.resume_outcome, second.age_s, second.stream_s) == ("resumed", elapsed_s, 8.0 + elapsed_s)


async def test_saves_are_limited_in_rate_and_never_happen_during_a_frame() -> None:
    store = CountingStore()
    registry = make_registry(store, save_s=0.1)
    session = await start(registry)
    for _ in range(50):
        registry.schedule_save(session)
        await asyncio.sleep(0)
    assert store.saved == 2, "at the start, and after the first change"
    session.processing = True
    await asyncio.sleep(0.2)
    assert store.saved == 2, "the state is inconsistent while a frame is processed"
    session.processing = False
    registry.schedule_save(session)
    await asyncio.sleep(0.05)
    assert store.saved == 3
    await registry.close(session, resumable=True)
    assert store.saved == 4


async def test_the_last_change_is_saved_even_if_nothing_follows_it() -> None:
    store = MemoryStore()
    one, other = make_registry(store, save_s=0.1), make_registry(store)
    session = await start(one)
    one.schedule_save(session)
    await asyncio.sleep(0)
    session.last_seq = 3
    one.schedule_save(session)
    await asyncio.sleep(0.2)
    assert (await start(other, token=session.token)).last_seq == 3


async def test_sessions_are_limited_in_total_and_per_caller() -> None:
    registry = make_registry(sessions=3, sessions_per_caller=2)
    first = await start(registry)
    with registry.temporary(POOL, ANN), pytest.raises(BusyError, match="2 sessions, the limit for one caller"):
        await start(registry)
    await start(registry, BOB)
    await start(registry)
    with pytest.raises(BusyError, match="all 3"):
        await start(registry, BOB)
    await registry.close(first, resumable=False)
    await start(registry, BOB)


async def test_a_detector_that_is_not_loaded_opens_no_session() -> None:
    registry = make_registry(sessions=1)
    with pytest.raises(NoDetectorError):
        await registry.start(POOL, ANN, StartMessage(), SessionOptions(detector="regression"))
    await start(registry)


async def test_sessions_work_without_a_reachable_store(caplog: pytest.LogCaptureFixture) -> None:
    registry = make_registry(UnreachableStore())
    first = await start(registry)
    registry.schedule_save(first)
    await registry.close(first, resumable=True)
    assert (await start(registry, token=first.token)).resume_outcome == "unknown"
    assert len([record for record in caplog.records if "not saved" in record.message]) == 1


async def test_failures_of_the_store_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    store, failures, clock = UnreachableStore(), [], Clock()
    registry = SessionRegistry(SessionLimits(), store, clock=clock, on_store_failure=lambda: failures.append(None))
    assert registry.store_reachable
    first = await start(registry)
    assert (registry.store_reachable, len(failures)) == (False, 1)
    store.works = True
    clock.now += 2.1
    await registry.close(first, resumable=True)
    assert (registry.store_reachable, len(failures)) == (True, 1)
    assert [getattr(record, "event", None) for record in caplog.records] == ["store_lost", "store_restored"]


async def test_a_store_that_fails_now_and_then_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    store, clock = UnreachableStore(), Clock()
    registry = SessionRegistry(SessionLimits(), store, clock=clock)
    for i in range(100):
        store.works = i % 2 == 1
        await registry.close(await start(registry), resumable=True)
        clock.now += 0.25
        assert not registry.store_reachable
    assert [getattr(record, "event", None) for record in caplog.records] == ["store_lost"]


async def test_an_incompatible_record_starts_a_new_session() -> None:
    store = MemoryStore()
    one, other = make_registry(store), make_registry(store)
    of_version_0_10 = {"session": "x", "born": 1e9, "saved": 1e9, "stream_s": 0.0, "last_seq": None, "clean": True}
    too_large = json.dumps({"session": "x" * 1_000_000})
    for text in ("{}", "\udcff", "[1]", json.dumps({**of_version_0_10, "state": {}}), too_large):
        first = await start(one)
        assert first.key is not None
        record = StoredSession("ann", "ann", first.owner, text.encode(errors="surrogateescape"))
        await store.save(first.key, record, 60.0)
        assert (await start(other, token=first.token)).resume_outcome == "unknown"


async def test_a_stored_session_is_small() -> None:
    store = MemoryStore()
    session = await start(make_registry(store))
    for i in range(30):
        process_frame(session, 0.1 * i)
    await make_registry(store).close(session, resumable=True)
    assert session.key is not None
    taken = await store.take_over(session.key, "ann", "test")
    assert taken is not None
    assert len(taken.data) < 4096


async def test_the_clock_of_a_stream_goes_on_while_no_frames_come() -> None:
    store, machine = MemoryStore(), Machine()
    registry = make_registry(store, machine)
    first = await start(registry)
    first.stream_s = 2.0
    machine.advance(30.0)
    await registry.close(first, resumable=True)
    machine.advance(5.0)
    assert (await start(registry, token=first.token)).stream_s == 37.0


async def test_nothing_is_saved_after_the_last_record_of_a_closed_session() -> None:
    store = SharedStore()
    one, other = make_registry(store, save_s=0.01), make_registry(store)
    first = await start(one)
    process_frame(first, 0.0)
    one.schedule_save(first)
    one.schedule_save(first)
    await one.close(first, resumable=True)
    await asyncio.sleep(0.05)
    second = await start(other, token=first.token)
    assert second.handle.state.tracker.next_id == first.handle.state.tracker.next_id, "no ids were lost"
    await one.stop()
    await other.stop()


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("kind", [MemoryStore, SharedStore])
async def test_of_two_sockets_that_resume_at_the_same_time_one_gets_the_session(
    kind: type[MemoryStore], held: bool
) -> None:
    async with replicas(1, kind()) as (registry,):
        holder = await start(registry)
        for _ in range(50):
            if held:
                close_if_evicted(registry, holder)
            else:
                await registry.close(holder, resumable=True)
            holder = await race([registry, registry], holder.token)
            assert len(registry) == 1, "the loser keeps no session"


@pytest.mark.parametrize("held", [False, True])
async def test_of_two_replicas_one_gets_the_session(held: bool) -> None:
    async with replicas(2, SharedStore()) as registries:
        holders = [await start(registries[0]) for _ in range(50)]
        for holder in holders:
            if held:
                close_if_evicted(registries[0], holder)
            else:
                await registries[0].close(holder, resumable=True)
        await asyncio.gather(*(race(registries, holder.token) for holder in holders))
        await asyncio.sleep(0.1)
        assert sum(map(len, registries)) == len(holders)


async def test_the_latest_of_many_sockets_gets_the_session() -> None:
    async with replicas(1, SharedStore()) as (registry,):
        token = (await close(registry, await start(registry))).token
        outcomes = await asyncio.gather(*(start(registry, token=token) for _ in range(5)), return_exceptions=True)
        assert [type(outcome) for outcome in outcomes] == [EvictedError] * 4 + [OpenSession]
        assert isinstance(outcomes[-1], OpenSession)
        assert outcomes[-1].resumed
        assert len(registry) == 1


async def test_another_caller_with_the_token_disturbs_no_resume() -> None:
    async with replicas(1, SharedStore()) as (registry,):
        token = (await close(registry, await start(registry))).token
        mine, theirs = await asyncio.gather(start(registry, token=token), start(registry, BOB, token))
        assert (mine.resume_outcome, theirs.resume_outcome) == ("resumed", "unknown")


async def test_a_session_that_another_replica_takes_over_at_its_start_is_not_opened() -> None:
    class StolenStore(MemoryStore):
        async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
            await self.take_over(key, "ann", "another replica")
            return await super().save(key, session, ttl_s)

    store = StolenStore()
    registry = make_registry(store)
    token = (await close(registry, await start(registry))).token
    with pytest.raises(EvictedError, match="resumed over another socket"):
        await start(registry, token=token)
    assert len(registry) == 0


async def test_a_start_that_is_canceled_keeps_no_session() -> None:
    class SlowStore(MemoryStore):
        async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
            await asyncio.sleep(fakes.WAIT_S)
            return True

    registry = make_registry(SlowStore())
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.02):
            await start(registry)
    assert len(registry) == 0


async def test_a_session_without_frames_notices_that_another_replica_resumed_it() -> None:
    async with replicas(2, SharedStore()) as (one, other):
        first = await start(one)
        evicted = asyncio.Event()
        first.on_evict = evicted.set
        assert (await start(other, token=first.token)).resumed
        await asyncio.wait_for(evicted.wait(), fakes.WAIT_S)


async def test_open_sessions_are_saved_again_in_a_shared_store_that_lost_them() -> None:
    store = SharedStore()
    async with replicas(2, store) as (one, other):
        first = await start(one)
        await store.close()
        await asyncio.sleep(1.3)
        assert (await start(other, token=first.token)).resumed


async def test_a_shared_store_is_checked_without_sessions() -> None:
    class BrokenStore(UnreachableStore, SharedStore):
        pass

    store, machine = BrokenStore(), Machine()
    registry = make_registry(store, machine)
    registry.begin()
    try:
        await asyncio.sleep(0.1)
        assert not registry.store_reachable, "the store is checked at once, before the first stream"
        store.works = True
        machine.advance(2.1)
        await asyncio.sleep(1.3)
        assert registry.store_reachable
    finally:
        await registry.stop()


async def test_sessions_are_limited_in_rate_per_caller() -> None:
    machine = Machine()
    registry = make_registry(machine=machine)
    for i in range(400):
        session = await start(registry) if i % 2 else registry.open(POOL, ANN)
        await registry.close(session, resumable=True)
    for _ in range(3):
        with pytest.raises(BusyError, match="you opened more than 100 sessions per second"):
            await start(registry)
    with registry.temporary(POOL, ANN):
        assert (await start(registry, BOB)).caller == BOB
    assert (await start(registry, token=session.token)).resumed, "a resumed session is not a new one"
    with pytest.raises(BusyError):
        await start(registry, token="guessed")  # noqa: S106
    machine.advance(0.1)
    for _ in range(10):
        await close(registry, await start(registry))
    with pytest.raises(BusyError):
        await start(registry)


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        (("size",), [640, 0], "side of the images"),
        (("size",), [640, 480], "does not fit the size of the images"),
        (("size",), None, "does not fit the size of the images"),
        (("horizon",), 1.5, "horizon is 1.5; expected -2 to 0.98"),
        (("evidence",), -1.0, "evidence"),
        (("departure", "side"), "left", "a departure has a side exactly if"),
        (("departure", "right", "margin"), 1e7, "departure margin"),
        (("tracker", "lane_width"), 0.0, "lane_width is 0.0"),
        (("tracker", "next_id"), 1, "track_id is 1"),
        (("tracker", "next_id"), 10**40, "next_id is 1000"),
        (("tracker", "clock", "now"), -1.0, "clock is -1.0"),
        (("tracker", "frames"), -1, "frames"),
        (("tracker", "tracks"), "!", "not valid base 64"),
        (("tracker", "tracks"), "", "which are not those of 0 tracks"),
        (("tracker", "filter"), "AAAA", "has 3 bytes; expected a multiple of 4"),
        (("tracker", "filter"), encoded(np.full(NUMBERS, np.nan)), "not finite"),
        (("tracker", "filter"), encoded(np.append(np.zeros(SIZE), np.full(NUMBERS - SIZE, -1.0))), "negative variance"),
        (("tracker", "filter"), encoded(np.arange(float(NUMBERS))), "positive semidefinite"),
        (("scene", "thumbnail"), "AAAA", "has 3 bytes; expected 144"),
    ],
)
async def test_an_invalid_state_starts_over(
    path: tuple[str | int, ...], value: object, reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    record = valid_record()
    replace_at(record["state"], path, value)
    session = await resume_record(json.dumps(record))
    assert (session.resume_outcome, session.last_seq) == ("unknown", None)
    process_frame(session, 0.0)
    (warning,) = [record.getMessage() for record in caplog.records]
    assert reason in warning
    assert "\n" not in warning


NONSENSE = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -(10**30), 2**63, 1e308, -1e308, 5e-324, 0.0, -1.0])
    | st.floats()
    | st.text(max_size=8)
    | st.lists(st.floats(), max_size=4)
)


def changed(value: object) -> st.SearchStrategy[object]:
    """Returns values to replace `value` of a record with: nonsense, or almost right."""
    if isinstance(value, str) and len(value) == len(encoded(np.zeros(NUMBERS))):
        numbers, every = np.frombuffer(b64decode(value), "<f4").astype(float), np.arange(NUMBERS)
        factors = st.just(0.0) | st.floats(1e-12, 1e12) | st.floats(width=32)
        return NONSENSE | st.tuples(st.lists(st.integers(0, NUMBERS - 1)), factors).map(
            lambda change: encoded(
                (numbers * np.where(np.isin(every, change[0] or every), change[1], 1.0)).clip(-3e38, 3e38)
            )
        )
    if isinstance(value, float):
        return NONSENSE | st.floats(0.0, 2.0).map(value.__mul__) | st.floats(-2.0, 2.0).map(value.__add__)
    if isinstance(value, int):
        return NONSENSE | st.sampled_from([value - 1, value + 1, 2 * value, -value])
    return NONSENSE


@given(st.data())
def test_a_record_with_nonsense_is_restored_or_starts_over(data: st.DataObject) -> None:
    record = valid_record()
    for _ in range(data.draw(st.integers(1, 2), "changes")):
        path = data.draw(st.sampled_from(list(paths(record))), "path")
        replace_at(record, path, data.draw(changed(at(record, path)), "value"))
    session = asyncio.run(resume_record(json.dumps(record)))
    for i in range(3):
        result = process_frame(session, session.stream_s + 0.04 * i)
        timing = dict.fromkeys(("decode", "propose", "queue", "infer", "track", "total"), 0.0)
        frame = ProcessedFrame((320, 180), replace(result, timing_ms=timing))
        lanes = lanes_message(frame, seq=(session.last_seq or 0) + 1, timestamp=session.stream_s).lanes
        assert all(math.isfinite(number) for lane in lanes for point in lane.points for number in point)
