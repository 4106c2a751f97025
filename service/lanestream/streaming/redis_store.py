"""Sessions in Redis, so that any replica can resume them. Frames never wait for Redis.

Redis knows which replica owns a session, and a `MemoryStore` which socket of this replica does. That store also holds a
copy of every session that this replica saved, so a session can be resumed here while Redis can't be reached, and after
a restart of Redis that lost its record.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

from lanestream.errors import SettingsError, StoreError, needs_extra, one_line
from lanestream.streaming.store import MemoryStore, TakenSession

with needs_extra("redis"):
    from redis.asyncio import Redis
    from redis.asyncio.retry import Retry
    from redis.backoff import ExponentialBackoff
    from redis.exceptions import ReadOnlyError, RedisError, ResponseError

if TYPE_CHECKING:
    from lanestream.streaming.store import StoredSession

_PREFIX: Final = "lanestream:session:"
# The time limits of an operation with all its retries, of one after a failure, and of a single try.
_TIMEOUT_S: Final = 1.0
_SHORT_TIMEOUT_S: Final = 0.5
_TRY_S: Final = 0.45
_RETRIES: Final = 3
# The least and the longest wait before a retry.
_BACKOFF_S: Final = (0.01, 0.1)
# A connection that was unused for this long is tested before its next use.
_HEALTH_CHECK_S: Final = 10
# Connections of one replica. Redis accepts 10,000 in all, and a replica may save all its sessions at the same moment.
_CONNECTIONS: Final = 16
# After a failure, operations fail at once for this long instead of waiting for their own time limits.
_PAUSE_S: Final = 1.0
# A session that was saved to check Redis expires after this many milliseconds.
_CHECK_TTL_MS: Final = 10_000

# Redis runs each script atomically, so two replicas can't both become the owner of a session. A script may run twice,
# because an operation is retried if its answer was lost; the second run changes nothing and has the same answer.
#
# Returns nil if Redis has no such session, an empty list if it may not be taken over, else the replica that wrote the
# data, and the data.
_TAKE_OVER: Final = """
local session = redis.call('HMGET', KEYS[1], 'caller', 'writer', 'data')
if not session[1] then return false end
if session[1] ~= ARGV[1] or not session[3] then return {} end
redis.call('HSET', KEYS[1], 'owner', ARGV[2])
return {session[2], session[3]}
"""
_SAVE: Final = """
local owner = redis.call('HGET', KEYS[1], 'owner')
if owner and owner ~= ARGV[2] then return 0 end
redis.call('HSET', KEYS[1], 'caller', ARGV[1], 'owner', ARGV[2], 'writer', ARGV[2], 'data', ARGV[3])
redis.call('PEXPIRE', KEYS[1], ARGV[4])
return 1
"""
# The rest stays until it expires, so that no replica takes its own copy for a session that Redis has lost.
_DELETE: Final = """
if redis.call('HGET', KEYS[1], 'owner') == ARGV[1] then redis.call('HDEL', KEYS[1], 'data') end
return 1
"""


class RedisStore:
    """Keeps sessions in the Redis at `url`; connects on first use. Raises SettingsError if `url` is invalid.

    An operation ends within a second, whatever Redis and the network do. `clock` returns monotonic seconds.
    """

    name: Final = "redis"
    shared: Final = True

    def __init__(self, url: str, clock: Callable[[], float] = time.monotonic) -> None:
        base, cap = _BACKOFF_S
        # Connections through a Unix socket have no such option.
        keepalive = {} if url.startswith("unix:") else {"socket_keepalive": True}
        try:
            self._redis = Redis.from_url(
                url,
                socket_timeout=_TRY_S,
                socket_connect_timeout=_TRY_S,
                health_check_interval=_HEALTH_CHECK_S,
                retry=Retry(ExponentialBackoff(cap=cap, base=base), _RETRIES),
                # After a failover, old connections lead to what is now a replica, and new ones to the primary.
                retry_on_error=[ReadOnlyError],
                **keepalive,
            )
        except ValueError:
            # The text of this error may contain the password.
            raise SettingsError(
                "redis_url is not a valid Redis URL",
                "use redis://host:6379/0, or rediss://name:password@host:6379/0 with special characters of the password"
                " percent-encoded",
            ) from None
        self._connections = asyncio.Semaphore(_CONNECTIONS)
        self._clock = clock
        self._replica = secrets.token_hex(8)
        self._copies = MemoryStore(clock)
        self._paused_until = -math.inf
        self._take_over = self._redis.register_script(_TAKE_OVER)
        self._save = self._redis.register_script(_SAVE)
        self._delete = self._redis.register_script(_DELETE)

    async def take_over(self, key: str, caller: str, owner: str) -> TakenSession | None:
        """See SessionStore. Raises StoreError only if this replica has no copy of the session either."""
        try:
            # It is worth a try even after a failure: another replica may have continued the session.
            async with self._operation(_SHORT_TIMEOUT_S if self._paused else _TIMEOUT_S):
                answer = await self._run(self._take_over, key, caller, self._replica)
        except StoreError:
            copy = await self._copies.take_over(key, caller, owner)
            if copy is None:
                raise
            return TakenSession(copy.data, latest=False)
        if answer == []:
            return None
        copy = await self._copies.take_over(key, caller, owner)
        if answer is None:
            return None if copy is None else TakenSession(copy.data, latest=False)
        writer, data = answer
        if copy is not None and writer == self._replica.encode():
            # The copy is at least as new: it was saved even if Redis could not be reached.
            return copy
        await self._copies.delete(key, owner)
        return TakenSession(data)

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        """See SessionStore. This replica keeps a copy even if Redis can't be reached."""
        if not await self._copies.save(key, session, ttl_s):
            return False
        self._check_pause()
        async with self._operation():
            ttl_ms = round(1e3 * ttl_s)
            kept = bool(await self._run(self._save, key, session.caller, self._replica, session.data, ttl_ms))
        if not kept:
            await self._copies.delete(key, session.owner)
        return kept

    async def delete(self, key: str, owner: str) -> None:
        """See SessionStore."""
        if self._copies.owner(key) not in (None, owner):
            return
        await self._copies.delete(key, owner)
        self._check_pause()
        async with self._operation():
            await self._run(self._delete, key, self._replica)

    async def check(self) -> None:
        """See SessionStore. Saves a session that nobody has: a Redis that answers may still refuse to write."""
        self._check_pause()
        async with self._operation():
            await self._run(self._save, f"check:{self._replica}", "", self._replica, b"", _CHECK_TTL_MS)

    async def close(self) -> None:
        """Closes the connections and deletes the copies."""
        await self._copies.close()
        with suppress(RedisError, OSError, TimeoutError):
            async with asyncio.timeout(_TIMEOUT_S):
                await self._redis.aclose()

    @property
    def _paused(self) -> bool:
        return self._clock() < self._paused_until

    def _check_pause(self) -> None:
        """Raises StoreError if an operation failed a moment ago."""
        if self._paused:
            raise StoreError("Redis can't be used: it failed a moment ago", "check the Redis server")

    @asynccontextmanager
    async def _operation(self, timeout_s: float = _TIMEOUT_S) -> AsyncIterator[None]:
        """Turns errors of Redis and of the network into StoreError, and waits for `timeout_s` seconds at most."""
        try:
            async with asyncio.timeout(timeout_s), self._connections:
                yield
        except (RedisError, OSError, TimeoutError) as error:
            # A Redis that refuses an operation answers, so the next one will not have to wait either.
            if not isinstance(error, ResponseError):
                self._paused_until = self._clock() + _PAUSE_S
            reason = one_line(error) or f"no answer within {timeout_s:g} s"
            raise StoreError(
                f"Redis can't be used: {reason}", "check the setting redis_url and the Redis server"
            ) from None
        self._paused_until = -math.inf

    @staticmethod
    async def _run(script: Any, key: str, *arguments: str | bytes | int) -> Any:
        return await script(keys=[_PREFIX + key], args=list(arguments))
