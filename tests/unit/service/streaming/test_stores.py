"""The contract of session stores, checked for every store; Redis is a real server."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from redis.asyncio import Redis
from redisserver import redis_server, running_redis
from tcpproxy import tcp_proxy

from lanestream.errors import SettingsError, StoreError
from lanestream.streaming.redis_store import RedisStore
from lanestream.streaming.store import MemoryStore, SessionStore, StoredSession, TakenSession
from lanestream.streaming.stores import open_store

MOST_S = 4.0  # an operation takes at most a second; a busy machine adds to that


def session(caller: str, owner: str, data: bytes) -> StoredSession:
    return StoredSession(caller, caller, owner, data)


@asynccontextmanager
async def replicas(number: int, url: str) -> AsyncIterator[list[RedisStore]]:
    """Yields stores of as many replicas that share a Redis."""
    stores = [RedisStore(url) for _ in range(number)]
    try:
        yield stores
    finally:
        for store in stores:
            await store.close()


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with redis_server(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest.fixture(params=["memory", "redis"])
async def store(request: pytest.FixtureRequest) -> AsyncIterator[SessionStore]:
    opened = open_store(None if request.param == "memory" else request.getfixturevalue("redis_url"))
    yield opened
    await opened.close()


@pytest.fixture
def key(request: pytest.FixtureRequest) -> str:
    return request.node.name


async def test_only_the_caller_of_a_session_can_take_it_over(store: SessionStore, key: str) -> None:
    assert await store.save(key, session("ann", "one", b"\x00state\xff"), 60.0)
    assert await store.take_over(key, "bob", "two") is None
    assert await store.take_over("another", "ann", "two") is None
    assert await store.take_over(key, "ann", "two") == TakenSession(b"\x00state\xff")


async def test_a_previous_owner_can_neither_save_nor_delete_a_session(store: SessionStore, key: str) -> None:
    await store.save(key, session("ann", "one", b"a"), 60.0)
    assert await store.save(key, session("ann", "one", b"b"), 60.0)
    assert await store.take_over(key, "ann", "two") == TakenSession(b"b")
    assert not await store.save(key, session("ann", "one", b"late"), 60.0)
    await store.delete(key, "one")
    assert await store.save(key, session("ann", "two", b"c"), 60.0)
    assert await store.take_over(key, "ann", "three") == TakenSession(b"c")
    await store.delete(key, "three")
    assert await store.take_over(key, "ann", "four") is None


async def test_a_failed_take_over_does_not_change_the_owner(store: SessionStore, key: str) -> None:
    await store.save(key, session("ann", "one", b"a"), 60.0)
    await store.take_over(key, "bob", "thief")
    assert await store.save(key, session("ann", "one", b"b"), 60.0)


async def test_sessions_expire(store: SessionStore, key: str) -> None:
    await store.save(key, session("ann", "one", b"a"), 0.05)
    await asyncio.sleep(0.15)
    assert await store.take_over(key, "ann", "two") is None
    assert await store.save(key, session("bob", "three", b"c"), 60.0), "the key is free again"


async def test_a_reachable_store_answers(store: SessionStore) -> None:
    await store.check()
    assert (store.name, store.shared) in (("memory", False), ("redis", True))


async def taken(store: SessionStore, caller: str, keys: str) -> str:
    """Returns those of the keys whose sessions the store still has."""
    return "".join([key for key in keys if await store.take_over(key, caller, "other") is not None])


async def test_memory_is_bounded_and_the_oldest_sessions_are_deleted() -> None:
    store = MemoryStore(max_sessions=3)
    for name in "abcd":
        await store.save(name, session("ann", "one", name.encode()), 60.0)
        await store.save("a", session("ann", "one", b"a"), 60.0)
    assert await taken(store, "ann", "abcd") == "acd"


async def test_the_sessions_of_one_caller_push_out_none_of_another() -> None:
    store = MemoryStore(max_sessions=10)
    for key in "abc":
        await store.save(key, session("ann", "one", b""), 60.0)
    for key in range(100):
        await store.save(str(key), session("bob", "one", b""), 60.0)
    assert await taken(store, "ann", "abc") == "abc"
    assert await taken(store, "bob", "0123456") == ""
    assert await store.take_over("99", "bob", "other") is not None
    for key in "uvwxyz":
        await store.save(key, session("eve", "one", b""), 60.0)
    assert await taken(store, "ann", "abc") == "abc", "whoever has most sessions loses one"
    assert await taken(store, "eve", "uvwxyz") in ("vwxyz", "wxyz")


async def test_callers_that_share_an_identity_are_counted_by_host() -> None:
    store = MemoryStore(max_sessions=4)
    await store.save("mine", StoredSession("anyone", "192.0.2.1", "one", b""), 60.0)
    for key in "abcdef":
        await store.save(key, StoredSession("anyone", "192.0.2.2", "one", b""), 60.0)
    assert await store.take_over("mine", "anyone", "two") is not None


async def test_expired_sessions_do_not_count() -> None:
    now = [0.0]
    store = MemoryStore(lambda: now[0], max_sessions=3)
    await store.save("a", session("ann", "one", b""), 60.0)
    for key in "xy":
        await store.save(key, session("bob", "one", b""), 10.0)
    await store.save("a", session("ann", "one", b""), 60.0)
    now[0] = 20.0
    for key in "bc":
        await store.save(key, session("ann", "one", b""), 60.0)
    assert await taken(store, "ann", "abc") == "abc"


async def test_an_unreachable_redis_is_reported() -> None:
    async with replicas(1, "redis://127.0.0.1:1/0") as (store,):
        with pytest.raises(StoreError, match="Redis can't be used"):
            await store.take_over("key", "ann", "one")
        for operation in (
            store.save("key", session("ann", "one", b"a"), 1.0),
            store.delete("key", "one"),
            store.check(),
        ):
            with pytest.raises(StoreError, match="failed a moment ago"):
                await operation


def test_an_invalid_url_is_reported_without_its_password() -> None:
    with pytest.raises(SettingsError, match="redis_url is not a valid Redis URL") as caught:
        RedisStore("http://:secret@here:1")
    assert "secret" not in str(caught.value)


async def test_two_replicas_never_both_own_a_session(redis_url: str) -> None:
    async with replicas(4, redis_url) as stores:
        await stores[0].save("shared", session("ann", "0", b"x"), 60.0)
        for _ in range(20):
            await asyncio.gather(*(store.take_over("shared", "ann", str(i)) for i, store in enumerate(stores)))
            saved = [await store.save("shared", session("ann", str(i), b"x"), 60.0) for i, store in enumerate(stores)]
            assert sum(saved) == 1


async def test_a_session_returns_from_another_replica_as_it_was_there(redis_url: str, key: str) -> None:
    async with replicas(2, redis_url) as (one, other):
        await one.save(key, session("ann", "a", b"1"), 60.0)
        assert await other.take_over(key, "ann", "b") == TakenSession(b"1")
        assert await other.save(key, session("ann", "b", b"2"), 60.0)
        assert await one.take_over(key, "ann", "c") == TakenSession(b"2")
        assert not await other.save(key, session("ann", "b", b"late"), 60.0)
        assert await one.save(key, session("ann", "c", b"3"), 60.0)


async def test_what_a_lost_answer_repeats_changes_nothing(redis_url: str, key: str) -> None:
    async with replicas(2, redis_url) as (one, other):
        for _ in range(2):
            assert await one.save(key, session("ann", "a", b"1"), 60.0)
        for _ in range(2):
            assert await other.take_over(key, "ann", "b") == TakenSession(b"1")
        assert await other.save(key, session("ann", "b", b"2"), 60.0)
        for _ in range(2):
            # The copy of the first replica is out of date, also when Redis has already noted the new owner.
            assert await one.take_over(key, "ann", "c") == TakenSession(b"2")
        for _ in range(2):
            await one.delete(key, "c")
        assert await one.take_over(key, "ann", "d") is None


async def test_an_ended_session_is_not_restored_from_a_copy(redis_url: str, key: str) -> None:
    async with replicas(2, redis_url) as (one, other):
        await one.save(key, session("ann", "a", b"1"), 60.0)
        await other.take_over(key, "ann", "b")
        await other.save(key, session("ann", "b", b"2"), 60.0)
        await other.delete(key, "b")
        assert await one.take_over(key, "ann", "c") is None


async def test_a_copy_is_deleted_when_another_replica_owns_the_session(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path) as redis:
        async with replicas(2, redis.url) as (one, other):
            await one.save(key, session("ann", "a", b"1"), 60.0)
            await other.take_over(key, "ann", "b")
            assert not await one.save(key, session("ann", "a", b"2"), 60.0)
            redis.stop()
            with pytest.raises(StoreError):
                await one.take_over(key, "ann", "c")


async def test_a_replica_resumes_its_sessions_without_redis(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path) as redis:
        async with replicas(1, redis.url) as (store,):
            await store.save(key, session("ann", "a", b"1"), 60.0)
            redis.stop()
            with pytest.raises(StoreError):
                await store.take_over(key, "bob", "thief")
            assert await store.take_over(key, "ann", "b") == TakenSession(b"1", latest=False)
            with pytest.raises(StoreError):
                await store.save(key, session("ann", "b", b"2"), 60.0)
            assert not await store.save(key, session("ann", "a", b"late"), 60.0)
            redis.start()
            assert await store.take_over(key, "ann", "c") == TakenSession(b"2", latest=False)
            assert await store.save(key, session("ann", "c", b"3"), 60.0)
            assert await store.take_over(key, "ann", "d") == TakenSession(b"3")


async def test_what_redis_missed_is_not_lost(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path) as redis, tcp_proxy(redis.port) as proxy:
        async with replicas(2, f"redis://127.0.0.1:{proxy.port}/0") as (store, other):
            await store.save(key, session("ann", "a", b"1"), 60.0)
            with proxy.black_hole(), pytest.raises(StoreError):
                await store.save(key, session("ann", "a", b"2"), 60.0)
            assert await store.take_over(key, "ann", "b") == TakenSession(b"2"), "Redis knows of no other replica"
            assert await store.save(key, session("ann", "b", b"3"), 60.0), (
                "and does not take the replica for another one"
            )
            assert await other.take_over(key, "ann", "c") == TakenSession(b"3")


async def test_scripts_are_loaded_again_after_a_restart_of_redis(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path) as redis:
        async with replicas(2, redis.url) as (one, other):
            for data in (b"1", b"2"):
                assert await one.save(key, session("ann", "a", data), 60.0)
                assert await other.take_over(key, "ann", "b") == TakenSession(data)
                await other.delete(key, "b")
                redis.stop()
                redis.start()


async def test_connections_that_redis_closed_are_opened_again(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path, idle_s=1) as redis:
        async with replicas(2, redis.url) as (one, other):
            for _ in range(2):
                saves = [one.save(f"{key}{i}", session("ann", "a", b"1"), 60.0) for i in range(8)]
                assert all(await asyncio.gather(*saves))
                assert await other.take_over(key + "0", "ann", "b") == TakenSession(b"1")
                assert await one.take_over(key + "0", "ann", "a") is not None
                await asyncio.sleep(2.2)


async def test_no_operation_waits_long_for_a_redis_that_does_not_answer(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path) as redis, tcp_proxy(redis.port) as proxy:
        async with replicas(1, f"redis://127.0.0.1:{proxy.port}/0") as (store,):
            await store.save(key, session("ann", "a", b"1"), 60.0)
            with proxy.black_hole():
                began = time.monotonic()
                with pytest.raises(StoreError, match="Redis can't be used"):
                    await store.save(key, session("ann", "a", b"2"), 60.0)
                assert time.monotonic() - began < MOST_S
                began = time.monotonic()
                for _ in range(100):
                    with pytest.raises(StoreError, match="failed a moment ago"):
                        await store.save(key, session("ann", "a", b"3"), 60.0)
                assert time.monotonic() - began < 0.5
                began = time.monotonic()
                assert await store.take_over(key, "ann", "b") == TakenSession(b"3", latest=False)
                assert time.monotonic() - began < MOST_S
            await asyncio.sleep(1.0)
            assert await store.save(key, session("ann", "b", b"4"), 60.0)


async def test_a_redis_that_refuses_is_asked_again(tmp_path: Path, key: str) -> None:
    with running_redis(tmp_path) as redis:
        async with replicas(1, redis.url) as (store,), Redis.from_url(redis.url) as client:
            await client.set(f"lanestream:session:{key}", "not a session")
            for _ in range(2):
                with pytest.raises(StoreError, match="WRONGTYPE"):
                    await store.save(key, session("ann", "a", b"1"), 60.0)
            await store.check()


async def test_a_replica_saves_any_number_of_sessions_over_few_connections(redis_url: str, key: str) -> None:
    async with replicas(1, redis_url) as (store,), Redis.from_url(redis_url) as client:
        before = (await client.info("clients"))["connected_clients"]
        saved = await asyncio.gather(
            *(store.save(f"{key}-{number}", session("ann", "one", b"state"), 60.0) for number in range(200))
        )
        opened = (await client.info("clients"))["connected_clients"] - before
    assert all(saved)
    assert 1 <= opened <= 16
