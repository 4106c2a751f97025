"""Where sessions are kept beyond their sockets: in this process, or in Redis for all replicas.

A record has one owner at a time. Whoever takes it becomes the owner, and whoever lost it can't write it any more: a
replica that still holds an evicted socket does no harm, however late it notices.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Protocol

# Records of a few kilobytes each; the oldest give way.
_MOST_RECORDS: Final = 4096


@dataclass(frozen=True)
class Entry:
    """A session's record, whose session it is (the caller's identity), and who may write it."""

    caller: str
    owner: str
    data: bytes


class SessionStore(Protocol):
    """Keeps entries for a while. Raises StoreError where it can't be reached."""

    async def take(self, key: str, caller: str, owner: str) -> bytes | None:
        """The data of an entry that belongs to `caller`, now owned by `owner`; None where there is none of theirs."""
        ...

    async def save(self, key: str, entry: Entry, ttl_s: float) -> bool:
        """Keeps `entry` for `ttl_s` seconds; False, and nothing is changed, where another owner took it."""
        ...

    async def forget(self, key: str, owner: str) -> None:
        """Removes the entry, where `owner` still owns it."""
        ...

    async def close(self) -> None:
        """Lets go of connections."""
        ...


class MemoryStore:
    """Entries of this process alone. `clock` tells monotonic seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, most: int = _MOST_RECORDS) -> None:
        self._clock = clock
        self._most = most
        self._entries: OrderedDict[str, tuple[Entry, float]] = OrderedDict()

    async def take(self, key: str, caller: str, owner: str) -> bytes | None:
        """See SessionStore."""
        entry = self._alive(key)
        if entry is None or entry.caller != caller:
            return None
        self._entries[key] = replace(entry, owner=owner), self._entries[key][1]
        return entry.data

    async def save(self, key: str, entry: Entry, ttl_s: float) -> bool:
        """See SessionStore."""
        kept = self._alive(key)
        if kept is not None and kept.owner != entry.owner:
            return False
        self._entries[key] = entry, self._clock() + ttl_s
        self._entries.move_to_end(key)
        while len(self._entries) > self._most:
            self._entries.popitem(last=False)
        return True

    async def forget(self, key: str, owner: str) -> None:
        """See SessionStore."""
        kept = self._alive(key)
        if kept is not None and kept.owner == owner:
            del self._entries[key]

    async def close(self) -> None:
        """Forgets everything."""
        self._entries.clear()

    def _alive(self, key: str) -> Entry | None:
        entry, expires = self._entries.get(key, (None, 0.0))
        if entry is not None and expires <= self._clock():
            del self._entries[key]
            return None
        return entry
