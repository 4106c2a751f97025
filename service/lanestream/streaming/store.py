"""Where sessions are kept after their socket closes: in this process, or in Redis for all replicas.

A stored session has one owner at a time. Taking it over makes the caller its owner, and the previous owner can't write
it any more: a replica that has not noticed yet that its socket was evicted can do no harm.

To add a store, implement `SessionStore` in a module of its own and select it in `stores.py`.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

# Sessions take a few kilobytes each. Beyond this number the oldest ones are deleted.
_MAX_SESSIONS: Final = 4096


@dataclass(frozen=True)
class StoredSession:
    """A session's record, the identity of the caller it belongs to, and the owner who may write it."""

    caller: str
    owner: str
    data: bytes


class SessionStore(Protocol):
    """Keeps sessions for a limited time. Every method raises StoreError if the store can't be reached."""

    async def take_over(self, key: str, caller: str, owner: str) -> bytes | None:
        """Makes `owner` the owner of the session and returns its data; None if `caller` has no session of this key."""
        ...

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        """Keeps `session` for `ttl_s` seconds. Returns False and changes nothing if someone else owns it now."""
        ...

    async def delete(self, key: str, owner: str) -> None:
        """Deletes the session if `owner` still owns it."""
        ...

    async def close(self) -> None:
        """Closes connections."""
        ...


class MemoryStore:
    """Keeps sessions in this process. `clock` returns monotonic seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, max_sessions: int = _MAX_SESSIONS) -> None:
        self._clock = clock
        self._max_sessions = max_sessions
        self._sessions: OrderedDict[str, tuple[StoredSession, float]] = OrderedDict()

    async def take_over(self, key: str, caller: str, owner: str) -> bytes | None:
        """See SessionStore."""
        session = self._get(key)
        if session is None or session.caller != caller:
            return None
        self._sessions[key] = replace(session, owner=owner), self._sessions[key][1]
        return session.data

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        """See SessionStore."""
        saved = self._get(key)
        if saved is not None and saved.owner != session.owner:
            return False
        self._sessions[key] = session, self._clock() + ttl_s
        self._sessions.move_to_end(key)
        while len(self._sessions) > self._max_sessions:
            self._sessions.popitem(last=False)
        return True

    async def delete(self, key: str, owner: str) -> None:
        """See SessionStore."""
        saved = self._get(key)
        if saved is not None and saved.owner == owner:
            del self._sessions[key]

    async def close(self) -> None:
        """Deletes all sessions."""
        self._sessions.clear()

    def _get(self, key: str) -> StoredSession | None:
        session, expires = self._sessions.get(key, (None, 0.0))
        if session is not None and expires <= self._clock():
            del self._sessions[key]
            return None
        return session
