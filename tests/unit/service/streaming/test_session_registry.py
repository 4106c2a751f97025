"""Sessions and their limits, without sockets; the time of day is a number."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import fakes
import pytest

from lanestream.errors import BusyError, NoDetectorError, StoreError, TooOldError
from lanestream.images.decoding import ImageLimits
from lanestream.protocol import StartMessage
from lanestream.road.results import FrameResult
from lanestream.session import Session
from lanestream.streaming.session_registry import Caller, OpenSession, SessionLimits, SessionRegistry
from lanestream.streaming.store import MemoryStore, StoredSession
from lanestream.workers.thread_pool import ThreadPool

ANN, BOB = Caller("ann", "ann"), Caller("bob", "bob")
POOL = ThreadPool(fakes.engine(), ImageLimits(), threads=1)


@dataclass
class Clock:
    now: float = 1e9

    def __call__(self) -> float:
        return self.now


class UnreachableStore(MemoryStore):
    async def take_over(self, key: str, caller: str, owner: str) -> bytes | None:
        raise StoreError("unreachable")

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        raise StoreError("unreachable")


class CountingStore(MemoryStore):
    """Counts how often sessions are saved."""

    saved = 0

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        self.saved += 1
        return await super().save(key, session, ttl_s)


def make_registry(store: MemoryStore | None = None, clock: Clock | None = None, **limits: float) -> SessionRegistry:
    return SessionRegistry(SessionLimits(**limits), store or MemoryStore(), clock or Clock())  # type: ignore[arg-type]


def process_frame(session: OpenSession, timestamp: float) -> FrameResult:
    assert isinstance(session.handle, Session)
    return fakes.engine().process(session.handle, fakes.picture(), timestamp)


async def start(registry: SessionRegistry, caller: Caller = ANN, token: str | None = None) -> OpenSession:
    return await registry.start(POOL, caller, StartMessage(resume_token=token))


async def test_another_replica_resumes_a_session_exactly() -> None:
    store, clock = MemoryStore(), Clock()
    one, other = make_registry(store, clock), make_registry(store, clock)
    first = await start(one)
    for i in range(10):
        before = process_frame(first, 0.1 * i)
    first.last_seq, first.stream_s = 9, 3.5
    await one.close(first, resumable=True)
    clock.now += 20.0
    second = await start(other, token=first.token)
    assert (second.resume_outcome, second.id, second.token) == ("resumed", first.id, first.token)
    assert (second.last_seq, second.stream_s, second.born) == (9, 23.5, first.born)
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
    clock = Clock()
    registry = make_registry(clock=clock, session_s=100.0)
    ended, old = await start(registry), await start(registry)
    await registry.close(ended, resumable=False)
    await registry.close(old, resumable=True)
    clock.now += 100.0
    assert registry.life_s_left(old) == 0.0
    for session in (ended, old):
        assert (await start(registry, token=session.token)).resume_outcome == "unknown"


async def test_a_session_has_a_maximum_age() -> None:
    clock = Clock()
    registry = make_registry(clock=clock, session_s=10.0)
    session = await start(registry)
    clock.now += 9.9
    registry.check_age(session)
    clock.now += 0.1
    with pytest.raises(TooOldError, match="maximum age of 10 s"):
        registry.check_age(session)


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
        await registry.start(POOL, ANN, StartMessage(detector="regression"))
    await start(registry)


async def test_sessions_work_without_a_reachable_store(caplog: pytest.LogCaptureFixture) -> None:
    registry = make_registry(UnreachableStore())
    first = await start(registry)
    registry.schedule_save(first)
    await registry.close(first, resumable=True)
    assert (await start(registry, token=first.token)).resume_outcome == "unknown"
    assert len([record for record in caplog.records if "not saved" in record.message]) == 1


async def test_an_incompatible_record_starts_a_new_session() -> None:
    store = MemoryStore()
    one, other = make_registry(store), make_registry(store)
    for data in (b"{}", b"\xff", b"[1]"):
        first = await start(one)
        assert first.key is not None
        await store.save(first.key, StoredSession("ann", first.owner, data), 60.0)
        assert (await start(other, token=first.token)).resume_outcome == "unknown"


async def test_a_stored_session_is_small() -> None:
    store = MemoryStore()
    session = await start(make_registry(store))
    for i in range(30):
        process_frame(session, 0.1 * i)
    await make_registry(store).close(session, resumable=True)
    assert session.key is not None
    data = await store.take_over(session.key, "ann", "test")
    assert data is not None
    assert len(data) < 4096
