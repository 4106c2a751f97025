"""What a store of sessions promises, of both kinds; Redis is a real one."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from redisserver import redis_server

from lanestream.errors import SettingsError, StoreError
from lanestream.streaming.redis_store import RedisStore
from lanestream.streaming.store import Entry, MemoryStore, SessionStore


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with redis_server(tmp_path_factory.mktemp("redis")) as url:
        yield url


@pytest.fixture(params=["memory", "redis"])
async def store(request: pytest.FixtureRequest) -> AsyncIterator[SessionStore]:
    made: SessionStore = (
        MemoryStore() if request.param == "memory" else RedisStore(request.getfixturevalue("redis_url"))
    )
    yield made
    await made.close()


@pytest.fixture
def key(request: pytest.FixtureRequest) -> str:
    return request.node.name


async def test_what_was_saved_is_taken_by_its_caller_alone(store: SessionStore, key: str) -> None:
    assert await store.save(key, Entry("ann", "one", b"\x00state\xff"), 60.0)
    assert await store.take(key, "bob", "two") is None
    assert await store.take("another", "ann", "two") is None
    assert await store.take(key, "ann", "two") == b"\x00state\xff"


async def test_who_lost_a_session_can_write_and_remove_it_no_more(store: SessionStore, key: str) -> None:
    await store.save(key, Entry("ann", "one", b"a"), 60.0)
    assert await store.save(key, Entry("ann", "one", b"b"), 60.0)
    assert await store.take(key, "ann", "two") == b"b"
    assert not await store.save(key, Entry("ann", "one", b"late"), 60.0)
    await store.forget(key, "one")
    assert await store.save(key, Entry("ann", "two", b"c"), 60.0)
    assert await store.take(key, "ann", "three") == b"c"
    await store.forget(key, "three")
    assert await store.take(key, "ann", "four") is None


async def test_a_stranger_who_tries_takes_nothing_over(store: SessionStore, key: str) -> None:
    await store.save(key, Entry("ann", "one", b"a"), 60.0)
    await store.take(key, "bob", "thief")
    assert await store.save(key, Entry("ann", "one", b"b"), 60.0)


async def test_entries_end(store: SessionStore, key: str) -> None:
    await store.save(key, Entry("ann", "one", b"a"), 0.05)
    await asyncio.sleep(0.15)
    assert await store.take(key, "ann", "two") is None
    assert await store.save(key, Entry("bob", "three", b"c"), 60.0), "the key is free again"


async def test_memory_is_bounded_and_the_oldest_give_way() -> None:
    store = MemoryStore(most=3)
    for name in "abcd":
        await store.save(name, Entry("ann", "one", name.encode()), 60.0)
        await store.save("a", Entry("ann", "one", b"a"), 60.0)
    assert [await store.take(name, "ann", "two") for name in "abcd"] == [b"a", None, b"c", b"d"]


async def test_a_redis_that_is_not_there_is_told_as_that() -> None:
    store = RedisStore("redis://127.0.0.1:1/0")
    with pytest.raises(StoreError, match="Redis can't be used"):
        await store.take("key", "ann", "one")
    with pytest.raises(StoreError):
        await store.save("key", Entry("ann", "one", b"a"), 1.0)
    with pytest.raises(StoreError):
        await store.forget("key", "one")
    await store.close()


def test_a_url_that_is_none_is_told_without_what_it_holds() -> None:
    with pytest.raises(SettingsError, match="URL of Redis") as caught:
        RedisStore("http://:secret@here:1")
    assert "secret" not in str(caught.value)


async def test_two_replicas_never_both_own_a_session(redis_url: str, tmp_path: Path) -> None:
    stores = [RedisStore(redis_url) for _ in range(4)]
    await stores[0].save("shared", Entry("ann", "0", b"x"), 60.0)
    for _ in range(20):
        await asyncio.gather(*(store.take("shared", "ann", str(i)) for i, store in enumerate(stores)))
        saved = [await store.save("shared", Entry("ann", str(i), b"x"), 60.0) for i, store in enumerate(stores)]
        assert sum(saved) == 1
    for store in stores:
        await store.close()
