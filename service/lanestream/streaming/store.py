"""Where sessions are kept after their socket closes: in this process, or in Redis for all replicas.

A stored session has one owner at a time. Taking it over makes the caller its owner, and the previous owner can't write
it any more: a replica that has not noticed yet that its socket was evicted can do no harm.

To add a store, implement `SessionStore` in a module of its own and select it in `stores.py`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

# Sessions take a few kilobytes each. Beyond this number, the caller with most of them loses its oldest.
_MAX_SESSIONS: Final = 4096


@dataclass(frozen=True)
class StoredSession:
    """A session's record, the identity of the caller it belongs to, and the owner who may write it.

    `quota` is the name that the caller's sessions are counted under.
    """

    caller: str
    quota: str
    owner: str
    data: bytes


@dataclass(frozen=True)
class TakenSession:
    """The data of a session that was taken over. If not `latest`, another replica may have continued the session."""

    data: bytes
    latest: bool = True


class SessionStore(Protocol):
    """Keeps sessions for a limited time. A method that needs the store raises StoreError if it can't be reached."""

    @property
    def name(self) -> str:
        """The name of this kind of store."""
        ...

    @property
    def shared(self) -> bool:
        """Whether other replicas can take over the sessions in it."""
        ...

    async def take_over(self, key: str, caller: str, owner: str) -> TakenSession | None:
        """Makes `owner` the owner of the session and returns its data; None if `caller` has no session of this key."""
        ...

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        """Keeps `session` for `ttl_s` seconds. Returns False and changes nothing if someone else owns it now."""
        ...

    async def delete(self, key: str, owner: str) -> None:
        """Deletes the session if `owner` still owns it."""
        ...

    async def check(self) -> None:
        """Checks that the store can be reached and that it accepts sessions."""
        ...

    async def close(self) -> None:
        """Closes connections."""
        ...


class MemoryStore:
    """Keeps sessions in this process. `clock` returns monotonic seconds.

    If there are `max_sessions`, a new one replaces the oldest one of the caller that has most: a caller that opens many
    sessions can't push out those of others.
    """

    name: Final = "memory"
    shared: Final = False

    def __init__(self, clock: Callable[[], float] = time.monotonic, max_sessions: int = _MAX_SESSIONS) -> None:
        self._clock = clock
        self._max_sessions = max_sessions
        # Dictionaries keep their order: what was saved longest ago comes first in each of them.
        self._sessions: dict[str, tuple[StoredSession, float]] = {}
        self._keys_by_quota: dict[str, dict[str, None]] = {}

    async def take_over(self, key: str, caller: str, owner: str) -> TakenSession | None:
        """See SessionStore."""
        session = self._get(key)
        if session is None or session.caller != caller:
            return None
        self._sessions[key] = replace(session, owner=owner), self._sessions[key][1]
        return TakenSession(session.data)

    async def save(self, key: str, session: StoredSession, ttl_s: float) -> bool:
        """See SessionStore."""
        if self.owner(key) not in (None, session.owner):
            return False
        self._remove(key)
        self._make_room()
        self._sessions[key] = session, self._clock() + ttl_s
        keys = self._keys_by_quota.pop(session.quota, {})
        keys[key] = None
        self._keys_by_quota[session.quota] = keys
        return True

    async def delete(self, key: str, owner: str) -> None:
        """See SessionStore."""
        if self.owner(key) == owner:
            self._remove(key)

    async def check(self) -> None:
        """Returns: memory can always be reached."""

    async def close(self) -> None:
        """Deletes all sessions."""
        self._sessions.clear()
        self._keys_by_quota.clear()

    def owner(self, key: str) -> str | None:
        """Returns the owner of the session; None if the session is unknown."""
        session = self._get(key)
        return None if session is None else session.owner

    def _get(self, key: str) -> StoredSession | None:
        session, expires = self._sessions.get(key, (None, 0.0))
        if session is not None and expires <= self._clock():
            self._remove(key)
            return None
        return session

    def _make_room(self) -> None:
        """Removes the expired sessions among the oldest ones, and one more if the store is still full."""
        while self._sessions:
            key, (_, expires) = next(iter(self._sessions.items()))
            if expires > self._clock():
                break
            self._remove(key)
        if len(self._sessions) >= self._max_sessions:
            most = max(self._keys_by_quota, key=lambda quota: len(self._keys_by_quota[quota]))
            self._remove(next(iter(self._keys_by_quota[most])))

    def _remove(self, key: str) -> None:
        session, _ = self._sessions.pop(key, (None, 0.0))
        if session is None:
            return
        keys = self._keys_by_quota[session.quota]
        del keys[key]
        if not keys:
            del self._keys_by_quota[session.quota]
