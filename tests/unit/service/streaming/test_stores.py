"""The contract of session stores, checked for every store; Redis is a real server."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from redisserver import redis_server

from lanestream.errors import SettingsError, StoreError
from lanestream.streaming.redis_store import RedisStore
from lanestream.streaming.store import MemoryStore, SessionStore, StoredSession
from lanestream.streaming.stores import open_store


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
    assert await store.save(key, StoredSession("ann", "one", b"\x00state\xff"), 60.0)
    assert await store.take_over(key, "bob", "two") is None
    assert await store.take_over("another", "ann", "two") is None
    assert await store.take_over(key, "ann", "two") == b"\x00state\xff"


async def test_a_previous_owner_can_neither_save_nor_delete_a_session(store: SessionStore, key: str) -> None:
    await store.save(key, StoredSession("ann", "one", b"a"), 60.0)
    assert await store.save(key, StoredSession("ann", "one", b"b"), 60.0)
    assert await store.take_over(key, "ann", "two") == b"b"
    assert not await store.save(key, StoredSession("ann", "one", b"late"), 60.0)
    await store.delete(key, "one")
    assert await store.save(key, StoredSession("ann", "two", b"c"), 60.0)
    assert await store.take_over(key, "ann", "three") == b"c"
    await store.delete(key, "three")
    assert await store.take_over(key, "ann", "four") is None


async def test_a_failed_take_over_does_not_change_the_owner(store: SessionStore, key: str) -> None:
    await store.save(key, StoredSession("ann", "one", b"a"), 60.0)
    await store.take_over(key, "bob", "thief")
    assert await store.save(key, StoredSession("ann", "one", b"b"), 60.0)


async def test_sessions_expire(store: SessionStore, key: str) -> None:
    await store.save(key, StoredSession("ann", "one", b"a"), 0.05)
    await asyncio.sleep(0.15)
    assert await store.take_over(key, "ann", "two") is None
    assert await store.save(key, StoredSession("bob", "three", b"c"), 60.0), "the key is free again"


async def test_memory_is_bounded_and_the_oldest_sessions_are_deleted() -> None:
    store = MemoryStore(max_sessions=3)
    for name in "abcd":
        await store.save(name, StoredSession("ann", "one", name.encode()), 60.0)
        await store.save("a", StoredSession("ann", "one", b"a"), 60.0)
    assert [await store.take_over(name, "ann", "two") for name in "abcd"] == [b"a", None, b"c", b"d"]


async def test_an_unreachable_redis_is_reported() -> None:
    store = RedisStore("redis://127.0.0.1:1/0")
    with pytest.raises(StoreError, match="Redis can't be used"):
        await store.take_over("key", "ann", "one")
    with pytest.raises(StoreError):
        await store.save("key", StoredSession("ann", "one", b"a"), 1.0)
    with pytest.raises(StoreError):
        await store.delete("key", "one")
    await store.close()


def test_an_invalid_url_is_reported_without_its_password() -> None:
    with pytest.raises(SettingsError, match="redis_url is not a valid Redis URL") as caught:
        RedisStore("http://:secret@here:1")
    assert "secret" not in str(caught.value)


async def test_two_replicas_never_both_own_a_session(redis_url: str, tmp_path: Path) -> None:
    stores = [RedisStore(redis_url) for _ in range(4)]
    await stores[0].save("shared", StoredSession("ann", "0", b"x"), 60.0)
    for _ in range(20):
        await asyncio.gather(*(store.take_over("shared", "ann", str(i)) for i, store in enumerate(stores)))
        saved = [await store.save("shared", StoredSession("ann", str(i), b"x"), 60.0) for i, store in enumerate(stores)]
        assert sum(saved) == 1
    for store in stores:
        await store.close()
