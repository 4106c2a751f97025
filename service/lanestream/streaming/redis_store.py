"""Sessions in Redis, so that any replica can resume them. Frames never wait for Redis."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

from lanestream.errors import SettingsError, StoreError, needs_extra

with needs_extra("cluster"):
    from redis.asyncio import Redis
    from redis.exceptions import RedisError

if TYPE_CHECKING:
    from lanestream.streaming.store import StoredSession

_PREFIX: Final = "lanestream:session:"
_TIMEOUT_S: Final = 1.0

# Redis runs each script atomically, so two replicas can't both become the owner of a session.
_TAKE_OVER: Final = """
local session = redis.call('HMGET', KEYS[1], 'caller', 'data')
if session[1] ~= ARGV[1] then return false end
redis.call('HSET', KEYS[1], 'owner', ARGV[2])
return session[2]
"""
_SAVE: Final = """
local owner = redis.call('HGET', KEYS[1], 'owner')
if owner and owner ~= ARGV[2] then return 0 end
redis.call('HSET', KEYS[1], 'caller', ARGV[1], 'owner', ARGV[2], 'data', ARGV[3])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
return 1
"""
_DELETE: Final = """
if redis.call('HGET', KEYS[1], 'owner') == ARGV[1] then redis.call('DEL', KEYS[1]) end
return 1
"""


class RedisStore:
    """Keeps sessions in the Redis at `url`; connects on first use. Raises SettingsError if `url` is invalid."""

    def __init__(self, url: str) -> None:
        try:
            self._redis = Redis.from_url(url, socket_timeout=_TIMEOUT_S, socket_connect_timeout=_TIMEOUT_S)
        except ValueError:
            # The text of this error may contain the password.
            raise SettingsError(
                "redis_url is not a valid Redis URL",
                "use redis://host:6379/0, or rediss://name:password@host:6379/0 with special characters of the password"
                " percent-encoded",
            ) from None
        self._take_over = self._redis.register_script(_TAKE_OVER)
        self._save = self._redis.register_script(_SAVE)
        self._delete = self._redis.register_script(_DELETE)

    async def take_over(self, key: str, caller: str, owner: str) -> bytes | None:
        """See SessionStore."""
        async with _store_errors():
            data: bytes | None = await self._run(self._take_over, key, caller, owner)
        return data

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        """See SessionStore."""
        async with _store_errors():
            ttl_ms = round(1e3 * ttl_s)
            return bool(await self._run(self._save, key, session.caller, session.owner, session.data, ttl_ms))

    async def delete(self, key: str, owner: str) -> None:
        """See SessionStore."""
        async with _store_errors():
            await self._run(self._delete, key, owner)

    async def close(self) -> None:
        """Closes the connections."""
        await self._redis.aclose()

    @staticmethod
    async def _run(script: Any, key: str, *arguments: str | bytes | int) -> Any:
        return await script(keys=[_PREFIX + key], args=list(arguments))


@asynccontextmanager
async def _store_errors() -> AsyncIterator[None]:
    """Turns errors of Redis and of the network into StoreError."""
    try:
        yield
    except (RedisError, OSError, TimeoutError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise StoreError(f"Redis can't be used: {reason}", "check the setting redis_url and the Redis server") from None
