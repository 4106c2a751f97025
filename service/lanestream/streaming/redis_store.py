"""Sessions in Redis, so that any replica can take one over. Redis is never waited for while a frame is on its way."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

from lanestream.errors import SettingsError, StoreError, needs_extra

with needs_extra("cluster"):
    from redis.asyncio import Redis
    from redis.exceptions import RedisError

if TYPE_CHECKING:
    from lanestream.streaming.store import Entry

_PREFIX: Final = "lanestream:session:"
_TIMEOUT_S: Final = 1.0

# Each runs as a whole, so that two replicas can't both believe that they own a session.
_TAKE: Final = """
local entry = redis.call('HMGET', KEYS[1], 'caller', 'data')
if entry[1] ~= ARGV[1] then return false end
redis.call('HSET', KEYS[1], 'owner', ARGV[2])
return entry[2]
"""
_SAVE: Final = """
local owner = redis.call('HGET', KEYS[1], 'owner')
if owner and owner ~= ARGV[2] then return 0 end
redis.call('HSET', KEYS[1], 'caller', ARGV[1], 'owner', ARGV[2], 'data', ARGV[3])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
return 1
"""
_FORGET: Final = """
if redis.call('HGET', KEYS[1], 'owner') == ARGV[1] then redis.call('DEL', KEYS[1]) end
return 1
"""


class RedisStore:
    """Entries in the Redis at `url`. Raises SettingsError where that is no URL of one; connects when first used."""

    def __init__(self, url: str) -> None:
        try:
            self._redis = Redis.from_url(url, socket_timeout=_TIMEOUT_S, socket_connect_timeout=_TIMEOUT_S)
        except ValueError:
            # Of which the text may have the password in it.
            raise SettingsError(
                "the URL of Redis is none",
                "redis://host:6379/0, or rediss://name:password@host:6379/0 with the password's odd characters as %XX",
            ) from None
        self._take = self._redis.register_script(_TAKE)
        self._save = self._redis.register_script(_SAVE)
        self._forget = self._redis.register_script(_FORGET)

    async def take(self, key: str, caller: str, owner: str) -> bytes | None:
        """See SessionStore."""
        async with _reaching():
            data: bytes | None = await self._run(self._take, key, caller, owner)
        return data

    async def save(self, key: str, entry: Entry, ttl_s: float) -> bool:
        """See SessionStore."""
        async with _reaching():
            return bool(await self._run(self._save, key, entry.caller, entry.owner, entry.data, round(1e3 * ttl_s)))

    async def forget(self, key: str, owner: str) -> None:
        """See SessionStore."""
        async with _reaching():
            await self._run(self._forget, key, owner)

    async def close(self) -> None:
        """Closes the connections."""
        await self._redis.aclose()

    @staticmethod
    async def _run(script: Any, key: str, *arguments: str | bytes | int) -> Any:
        return await script(keys=[_PREFIX + key], args=list(arguments))


@asynccontextmanager
async def _reaching() -> AsyncIterator[None]:
    try:
        yield
    except (RedisError, OSError, TimeoutError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StoreError(f"Redis can't be used: {reason}", "check the setting redis_url and the server there") from None
