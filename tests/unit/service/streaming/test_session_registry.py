"""Sessions and their limits, without sockets; the time of day is a number."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

import fakes
import pytest

from lanestream.detection import answered
from lanestream.errors import BusyError, NoDetectorError, StoreError
from lanestream.images.decoding import ImageLimits
from lanestream.protocol import StartMessage
from lanestream.road.results import FrameResult
from lanestream.session import Session
from lanestream.streaming.caller import Caller
from lanestream.streaming.session_registry import OpenSession, SessionLimits, SessionRegistry
from lanestream.streaming.store import Entry, MemoryStore
from lanestream.workers.thread_pool import ThreadPool

ANN, BOB = Caller("ann", "ann"), Caller("bob", "bob")
RUNNER = ThreadPool(fakes.engine(), ImageLimits(), threads=1)


@dataclass
class Clock:
    now: float = 1e9

    def __call__(self) -> float:
        return self.now


class Broken(MemoryStore):
    """A store that can't be reached."""

    async def take(self, key: str, caller: str, owner: str) -> bytes | None:
        raise StoreError("gone")

    async def save(self, key: str, entry: Entry, ttl_s: float) -> bool:
        raise StoreError("gone")


class Counting(MemoryStore):
    """Counts what is saved."""

    saved = 0

    async def save(self, key: str, entry: Entry, ttl_s: float) -> bool:
        self.saved += 1
        return await super().save(key, entry, ttl_s)


def manager(store: MemoryStore | None = None, clock: Clock | None = None, **limits: float) -> SessionRegistry:
    return SessionRegistry(SessionLimits(**limits), store or MemoryStore(), clock or Clock())  # type: ignore[arg-type]


def follow(opened: OpenSession, timestamp: float) -> FrameResult:
    assert isinstance(opened.camera, Session)
    return answered(opened.camera.follow(fakes.picture(), timestamp))


async def started(sessions: SessionRegistry, caller: Caller = ANN, token: str | None = None) -> OpenSession:
    return await sessions.start(RUNNER, caller, StartMessage(resume_token=token))


async def test_a_session_goes_on_where_it_was_on_another_replica() -> None:
    store, clock = MemoryStore(), Clock()
    here, there = manager(store, clock), manager(store, clock)
    first = await started(here)
    for i in range(10):
        before = follow(first, 0.1 * i)
    first.last_seq, first.stream_s = 9, 3.5
    await here.close(first, for_good=False)
    clock.now += 20.0
    second = await started(there, token=first.token)
    assert (second.resumption, second.id, second.token) == ("resumed", first.id, first.token)
    assert (second.last_seq, second.stream_s, second.born) == (9, 23.5, first.born)
    assert second.camera.state == first.camera.state
    after = follow(second, 1.0)
    assert [lane.track_id for lane in after.lanes] == [lane.track_id for lane in before.lanes] == [1, 2]
    follow(first, 1.0)
    assert second.camera.state == first.camera.state, "to the last digit"
    assert [lane.age_s for lane in after.lanes] == [1.0, 1.0]


async def test_of_a_lost_replica_the_ids_that_it_may_have_given_are_not_given_again() -> None:
    store = MemoryStore()
    lost, other = manager(store), manager(store)
    first = await started(lost)
    follow(first, 0.0)
    lost.note(first)
    await asyncio.sleep(0.3)
    second = await started(other, token=first.token)
    assert second.resumption == "resumed"
    before, after = first.camera.state.tracker, second.camera.state.tracker
    assert after.tracks == before.tracks
    assert after.next_id > before.next_id


async def test_a_token_opens_its_callers_session_alone() -> None:
    sessions = manager()
    first = await started(sessions)
    await sessions.close(first, for_good=False)
    for caller, token in ((BOB, first.token), (ANN, "guessed")):
        other = await started(sessions, caller, token)
        assert (other.resumption, other.last_seq) == ("unknown", None)
        assert other.token not in (None, token), "a token that is not theirs never becomes theirs"
        assert other.id != first.id
    assert (await started(sessions, token=first.token)).resumption == "resumed"


async def test_a_new_socket_evicts_the_old_one_and_waits_for_it() -> None:
    sessions = manager()
    first = await started(sessions)
    told = asyncio.Event()
    first.on_evict = told.set
    resuming = asyncio.create_task(started(sessions, token=first.token))
    await told.wait()
    assert not resuming.done()
    first.last_seq = 5
    await sessions.close(first, for_good=False)
    second = await resuming
    assert (second.resumption, second.last_seq) == ("resumed", 5)
    assert len(sessions) == 1


async def test_who_was_evicted_elsewhere_learns_it_when_it_saves() -> None:
    store = MemoryStore()
    here, there = manager(store, save_s=0.0), manager(store)
    first = await started(here)
    told = asyncio.Event()
    first.on_evict = told.set
    second = await started(there, token=first.token)
    second.last_seq = 7
    here.note(first)
    await asyncio.wait_for(told.wait(), fakes.WAIT_S)
    await here.close(first, for_good=False)
    await there.close(second, for_good=False)
    assert (await started(there, token=first.token)).last_seq == 7, "the evicted one's state did no harm"


async def test_what_ended_for_good_or_grew_too_old_is_not_resumed() -> None:
    clock = Clock()
    sessions = manager(clock=clock, session_s=100.0)
    ended, old = await started(sessions), await started(sessions)
    await sessions.close(ended, for_good=True)
    await sessions.close(old, for_good=False)
    clock.now += 100.0
    assert sessions.age_s(old) == 100.0
    for gone in (ended, old):
        assert (await started(sessions, token=gone.token)).resumption == "unknown"


async def test_saving_waits_for_its_turn_and_for_the_frame_in_work() -> None:
    store = Counting()
    sessions = manager(store, save_s=0.1)
    opened = await started(sessions)
    for _ in range(50):
        sessions.note(opened)
        await asyncio.sleep(0)
    assert store.saved == 2, "the opening, and the first change"
    opened.working = True
    await asyncio.sleep(0.2)
    assert store.saved == 2, "in the middle of a frame there is nothing to be saved"
    opened.working = False
    sessions.note(opened)
    await asyncio.sleep(0.05)
    assert store.saved == 3
    await sessions.close(opened, for_good=False)
    assert store.saved == 4


async def test_the_last_change_is_saved_when_nothing_follows_it() -> None:
    store = MemoryStore()
    here, there = manager(store, save_s=0.1), manager(store)
    opened = await started(here)
    here.note(opened)
    await asyncio.sleep(0)
    opened.last_seq = 3
    here.note(opened)
    await asyncio.sleep(0.2)
    assert (await started(there, token=opened.token)).last_seq == 3


async def test_limits_count_sessions_in_all_and_by_caller() -> None:
    sessions = manager(sessions=3, sessions_per_caller=2)
    first = await started(sessions)
    with sessions.opened(RUNNER, ANN), pytest.raises(BusyError, match="2 sessions, which is the most for one"):
        await started(sessions)
    await started(sessions, BOB)
    await started(sessions)
    with pytest.raises(BusyError, match="all 3"):
        await started(sessions, BOB)
    await sessions.close(first, for_good=True)
    await started(sessions, BOB)


async def test_a_detector_that_is_not_there_takes_no_place() -> None:
    sessions = manager(sessions=1)
    with pytest.raises(NoDetectorError):
        await sessions.start(RUNNER, ANN, StartMessage(detector="regression"))
    await started(sessions)


async def test_without_its_store_the_service_goes_on(caplog: pytest.LogCaptureFixture) -> None:
    sessions = manager(Broken())
    first = await started(sessions)
    sessions.note(first)
    await sessions.close(first, for_good=False)
    assert (await started(sessions, token=first.token)).resumption == "unknown"
    assert len([record for record in caplog.records if "not saved" in record.message]) == 1


async def test_a_record_of_another_version_begins_a_new_session() -> None:
    store = MemoryStore()
    here, there = manager(store), manager(store)
    for data in (b"{}", b"\xff", b"[1]"):
        first = await started(here)
        assert first.key is not None
        await store.save(first.key, Entry("ann", first.owner, data), 60.0)
        assert (await started(there, token=first.token)).resumption == "unknown"


async def test_a_small_state_is_kept() -> None:
    store = MemoryStore()
    opened = await started(manager(store))
    for i in range(30):
        follow(opened, 0.1 * i)
    sessions = manager(store)
    await sessions.close(opened, for_good=False)
    assert opened.key is not None
    kept = await store.take(opened.key, "ann", "test")
    assert kept is not None
    assert len(kept) < 4096
